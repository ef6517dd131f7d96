"""The drive of the recorded victim: ``python -m nodes.lab.recorded_drive FOLDER`` writes pictures, a film and their description.

It is driven through live nodes on the twin. Where these cannot run, or did not get the time that a live drive needs, it is driven in the
simulated lab in this process. Neither imports torch.
"""

from __future__ import annotations

import contextlib
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.attack.artifact import load_attack
from advnerf_core.driving.metrics import DriveMetrics, Horizon
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_atomically, write_json
from advnerf_core.geometry import Array, invert_transform
from advnerf_core.policies.load import load_driver
from calibration.schema import CameraCalibration, RoomCalibration, TargetCalibration, load_calibration
from hardware.mocap.vicon import free_udp_port
from nodes.lab.recorded_victim import ABOUT, FILM, FOLDER, LABEL, NOW, RecordedVictim, find_recorded
from nodes.lab.trials.evaluation import frames, score, trajectory
from nodes.lab.trials.trial import TrialPlan
from nodes.lab.trials.trial_runner import LIVE_LOCK, TrialNodes
from nodes.runtime.bus import Bus
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import MessageError
from nodes.runtime.locks import hold
from nodes.runtime.paths import shipped
from nodes.runtime.pictures import rgb_image
from nodes.runtime.termination import ends_in_order

_SEEN = "/compositor/image"
_NODES = ("twin", "camera", "vicon", "compositor", "policy", "safety", "motor")
_HORIZON = Horizon(60)
_SPEED_MPS = 0.8
_READY_S = 30.0

Rgb = NDArray[np.uint8]
Show = Callable[[Rgb], None]


@dataclass(frozen=True, eq=False)
class Driven:
    """A finished drive.

    Attributes:
        states: States at the ticks ``[T + 1, 3]``: x [m], y [m], yaw [rad].
        pictures: What the policy saw, ``[T + 1, H, W, 3]``.
        where: What drove, in words.
    """

    states: Array
    pictures: Rgb
    metrics: DriveMetrics
    where: str


def drive_recorded(victim: RecordedVictim, folder: Path, say: Callable[[str], None]) -> Path:
    """Drive the recorded victim; pictures of the drive are written as they come.

    Args:
        folder: Folder for picture, film and description.

    Returns:
        The film.
    """
    began_s = time.monotonic()
    shutil.rmtree(folder / "drive", ignore_errors=True)
    say(f"{LABEL} It drives past the texture now.")
    _describe(folder, "It drives past the texture now.", NOW, film=False)
    show = _picture_writer(folder / NOW)
    try:
        driven = _through_nodes(victim, folder, show)
    except AdvnerfError as error:
        print(f"not driven live: {error}", file=sys.stderr)
        driven = _in_the_lab(victim, show)
    film = _film(victim, driven, folder)
    left_s = driven.metrics.time_to_leaving_s
    how = "stays in its lane" if left_s is None else f"leaves its lane after {left_s:.1f} s"
    text = f"{driven.where}, it {how}: total CTE {driven.metrics.total_cte_m:.1f} m in {_HORIZON.ticks * _HORIZON.dt_s:.0f} s."
    _describe(folder, text, film.name, film=True)
    say(f"{LABEL} {text} Film after {time.monotonic() - began_s:.0f} s: {film}")
    return film


def _describe(folder: Path, text: str, file: str, film: bool) -> None:
    write_json(folder / ABOUT, {"label": LABEL, "text": text, "file": f"{FOLDER}/{file}", "film": film})


def _picture_writer(file: Path) -> Show:
    def show(rgb: Rgb) -> None:
        _, jpeg = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        write_atomically(file, jpeg.tobytes(), synced=False)  # live nodes need the disk too

    return show


def _through_nodes(victim: RecordedVictim, folder: Path, show: Show) -> Driven:
    room, calibration = _room(), shipped("calibration/twin")
    overrides = [
        f"params.calibration={calibration}",
        f"params.policy={victim.policy}",
        f"params.attack={victim.attack}",
        f"params.vicon_port={free_udp_port()}",
    ]
    run_dir, drive_dir = folder / "nodes", folder / "drive"
    plan = TrialPlan(room.start_pose, _HORIZON.ticks * _HORIZON.dt_s + 0.2, _NODES)
    launch = shipped("launch/green_screen.launch.yaml")
    # Another experiment may be measuring.
    with hold(LIVE_LOCK), TrialNodes(launch, run_dir, _READY_S) as nodes, _shown(run_dir, show):
        outcome = nodes.drive(overrides, plan, drive_dir)
    states = trajectory(drive_dir / "bag", outcome.start_real_ns, _HORIZON)
    stopped_s = (outcome.end_real_ns - outcome.start_real_ns) / NS_PER_S if outcome.stopped_early else None
    metrics, held = score(states, room.reference_path, _HORIZON, stopped_s)
    pictures = frames(drive_dir / "bag", outcome.start_real_ns, len(held))
    return Driven(held, pictures, metrics, "Through live nodes on the twin")


@contextmanager
def _shown(run_dir: Path, show: Show) -> Iterator[None]:
    """Show what the policy of live nodes sees, until the context ends."""
    ended = threading.Event()

    def watch() -> None:
        with Bus(run_dir) as bus:
            bus.subscribe(_SEEN)
            while not ended.is_set():
                bus.wait(0.1)
                for received in bus.receive():
                    with contextlib.suppress(MessageError):
                        show(rgb_image(received.message(), _SEEN))

    watching = threading.Thread(target=watch, daemon=True)
    watching.start()
    try:
        yield
    finally:
        ended.set()
        watching.join()


def _in_the_lab(victim: RecordedVictim, show: Show) -> Driven:
    from hardware.worlds.lab.lab import Lab
    from nodes.compositor import show as prepared

    calibration, room = shipped("calibration/twin"), _room()
    camera = load_calibration(CameraCalibration, calibration / "camera.yaml")
    target = load_calibration(TargetCalibration, calibration / "board.yaml")
    overlay = prepared(load_attack(victim.attack), camera, target).overlay
    driver = load_driver(str(victim.policy))
    states, pictures = [], []
    with Lab() as lab:
        state, T_world_from_face = lab.reset(*room.start_pose), lab.config.board.T_world_from_face
        for _ in range(_HORIZON.ticks + 1):
            T_camera_from_face = invert_transform(state.T_world_from_car @ camera.mount) @ T_world_from_face
            picture, _ = overlay.draw(lab.observe(depth=False)[0], T_camera_from_face)
            show(picture)
            states.append((state.x_m, state.y_m, state.yaw_rad))
            pictures.append(picture)
            steering_rad = driver.steer(driver.view.image(picture), ())
            state = lab.step(steering_rad, _SPEED_MPS, _HORIZON.dt_s)
    metrics, held = score(np.array(states), room.reference_path, _HORIZON, None)
    return Driven(held, np.stack(pictures), metrics, "In the simulated lab")


def _film(victim: RecordedVictim, driven: Driven, folder: Path) -> Path:
    from advnerf_core.report.clips import ClipTrack, write_clip

    cte_m = _room().reference_path.project(driven.states[:, :2]).cte_m
    attack_id = load_attack(victim.attack).attack_id
    track = ClipTrack("recorded victim, not of this run", "gradient", driven.pictures, cte_m, attack_id)
    return write_clip(folder / f"{FILM}.mp4", [track], 1.0 / _HORIZON.dt_s, _room().off_track_m)


def _room() -> RoomCalibration:
    return load_calibration(RoomCalibration, shipped("calibration/twin") / "room.yaml")


def main() -> None:
    """Drive the recorded victim that comes with advnerf."""
    cv2.setNumThreads(1)
    victim = find_recorded()
    if victim is None:
        raise SystemExit("expected a recorded victim in the reference build, found none")
    with ends_in_order():
        drive_recorded(victim, Path(sys.argv[1]), lambda text: print(text, flush=True))


if __name__ == "__main__":
    main()
