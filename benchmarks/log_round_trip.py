"""Row: a policy learned from a bag that went through LeRobot, against one learned from the bag itself, on the same held-out frames.

The expert drives in the simulated lab from starts beside its path. Its drives become a bag, and the bag a LeRobot data set (version 3, with
video). Policies learn from both, with several seeds. The bag and the policies from it are kept. Run as ``python -m benchmarks.log_round_trip [--trial] [--seeds N]``.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np

from advnerf_core.data.logs.choice import LogChoice, LogRequest
from advnerf_core.data.logs.lerobot_write import write_lerobot
from advnerf_core.driving.expert import Expert, ExpertConfig
from advnerf_core.learning.recipe import ImitationConfig, recovery_states
from advnerf_core.policies.load import load_any_policy
from benchmarks.results import record_row
from calibration.schema import RoomCalibration, load_calibration
from hardware.worlds.lab.lab import Lab
from nodes.bags.parts import METADATA_FILE
from nodes.bags.writer import BagWriter
from nodes.lab.policy_data.evaluate import compared, predict
from nodes.lab.policy_data.frames import HOLDOUT_EVERY
from nodes.lab.policy_data.logs import OpenLog, open_log, open_logs
from nodes.lab.policy_data.recordings import policy_view, recorded_frames
from nodes.lab.policy_data.train import train_from_recordings
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.messages import encode, header, image_message, pose_message, types

_ROOT = Path(__file__).parents[1]
_CALIBRATION = _ROOT / "calibration" / "twin"
_START_NS, _TICK_S, _PAUSE_S, _SPEED_MPS = 1_800_000_000 * NS_PER_S, 0.1, 5.0, 0.8
_TARGET = 0.02


def write_drives(folder: Path, drives: int, ticks: int, seed: int = 0) -> Path:
    """Write a bag of the expert's drives from starts beside the path, with images, poses and what was sent."""
    room = load_calibration(RoomCalibration, _CALIBRATION / "room.yaml")
    expert = Expert(room.reference_path, ExpertConfig(speed_mps=_SPEED_MPS))
    starts = recovery_states(room.reference_path, drives, np.random.default_rng(seed), 0.25, 0.3)
    attached = {name: (_CALIBRATION / name).read_bytes() for name in ("camera.yaml", "room.yaml")}
    stamp_ns = _START_NS
    with BagWriter(folder, attached, compressed=True) as bag, Lab() as lab:
        for start in starts:
            x_m, y_m, yaw_rad = (float(value) for value in start)
            state = lab.reset(x_m, y_m, yaw_rad, _SPEED_MPS)
            for _ in range(ticks):
                steering_rad = float(expert.steer(state.x_m, state.y_m, state.yaw_rad))
                _write(bag, stamp_ns, lab.observe(depth=False)[0], state.T_world_from_car, steering_rad)
                state = lab.step(steering_rad, _SPEED_MPS, _TICK_S)
                stamp_ns += round(_TICK_S * NS_PER_S)
            stamp_ns += round(_PAUSE_S * NS_PER_S)
    return folder


def _write(bag: BagWriter, stamp_ns: int, rgb: np.ndarray, T: np.ndarray, steering_rad: float) -> None:
    sent = types.MotorSent(
        header=header(stamp_ns, "car"),
        serial_write_mono_ns=stamp_ns,
        serial_write_real_ns=stamp_ns,
        speed_mps=_SPEED_MPS,
        steering_rad=steering_rad,
        erpm=0.0,
        servo=0.5,
        brake_current_a=0.0,
        braking=False,
        reason="",
        peer="lab",
    )
    messages = {
        "/camera/image_raw": image_message(rgb, stamp_ns, "camera"),
        "/vicon/car": pose_message(T, stamp_ns),
        "/motor/sent": sent,
    }
    for topic, message in messages.items():
        bag.write(topic, encode(message), stamp_ns, stamp_ns, 0)


def held_out_error_rad(learned: OpenLog, judged: OpenLog, out: Path, steps: int, seed: int) -> float:
    """Mean absolute error on the held-out frames of one log [rad], of a policy that learned from the other frames of the same or another."""
    view = policy_view(None, [learned])
    room = load_calibration(RoomCalibration, _CALIBRATION / "room.yaml")
    expert = Expert(room.reference_path, ExpertConfig(speed_mps=_SPEED_MPS))
    config = ImitationConfig(seed=seed, dagger_rounds=0, first_steps=steps, holdout_every=HOLDOUT_EVERY)
    done = train_from_recordings([learned], view, expert, config, out)
    policy = load_any_policy(str(done.path)).policy
    recording = recorded_frames(judged, view, expert)
    return compared(recording, predict(policy, recording.frames.images), "recorded", True)[
        "recorded"
    ].mean_abs_rad


def main() -> None:
    """Write the bag, export it, train on both, and record the row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trial", action="store_true", help="a small size; records nothing")
    parser.add_argument("--folder", type=Path, default=None, help="working folder")
    parser.add_argument("--seeds", type=int, default=4, help="pairs of policies")
    options = parser.parse_args()
    trial = options.trial
    drives, ticks, steps, seeds = (6, 40, 60, 1) if trial else (24, 80, 800, options.seeds)
    folder = options.folder or _ROOT / "runs" / ("log_round_trip_trial" if trial else "log_round_trip")
    bag = folder / "bag"
    if not (bag / METADATA_FILE).is_file():
        shutil.rmtree(folder, ignore_errors=True)
        write_drives(bag, drives, ticks)
    shutil.rmtree(folder / "lerobot", ignore_errors=True)
    done = write_lerobot(open_log(bag), folder / "lerobot")
    logs = open_logs(map(LogRequest, (bag, folder / "lerobot")), LogChoice(), "recorded")
    errors = np.array(
        [
            [
                held_out_error_rad(log, logs[0], folder / f"{log.log.path.name}{seed}", steps, seed)
                for log in logs
            ]
            for seed in range(seeds)
        ]
    )
    change = errors[:, 1].mean() / errors[:, 0].mean() - 1.0
    spread = errors[:, 0].std(ddof=1) / errors[:, 0].mean() if seeds > 1 else np.nan
    changes = (errors[:, 1] - errors[:, 0]) / errors[:, 0].mean()
    unsure = changes.std(ddof=1) / np.sqrt(seeds) if seeds > 1 else np.nan
    said = f"{1e3 * errors[:, 0].mean():.2f} mrad from the bag, {1e3 * errors[:, 1].mean():.2f} mrad through LeRobot"
    note = f"{said}; {done.frames} frames, {seeds} seeds, whose standard deviation is {100 * spread:.0f} %; standard error of the change {100 * unsure:.1f} %"
    print(f"{100 * change:+.1f} %: {note}\n{1e3 * errors}")
    if not trial:
        record_row(
            "policy from a bag through a LeRobot data set against the bag itself, error on held-out frames",
            round(100 * change, 1),
            "%",
            f"<= {100 * _TARGET:g} %",
            bool(change <= _TARGET),
            f"python -m benchmarks.log_round_trip --seeds {seeds}",
            note,
        )


if __name__ == "__main__":
    main()
