"""Does an attack on a ROS 2 policy as a black box work on the simulated lab? ``python -m benchmarks.ros2_black_box RUN_FOLDER ATTACK_FILE ONNX_FILE``.

The policy is `examples/ros2_policy.py`, plain rclpy, in an environment of its own (`make setup-ros2`). The attack was searched by asking it:

    advnerf attack run launch/corner.experiment.yaml -o runs/black_ros2 --set victims.mine.policy=examples.ros2_black_box:factory --set 'over.method=[cem]'

Here the same program drives the simulated lab tick by tick, past the board in its plain colour and past the attack, from the same
starts. The simulated time stands still while it is asked, so a busy machine changes nothing. The row has the mean excess of the total
CTE over the starts and its 95 % interval.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from advnerf_core.attack.artifact import AttackFile, load_attack
from advnerf_core.attack.search.search import draw_start_states
from advnerf_core.documents import read_json
from advnerf_core.driving.metrics import Horizon
from advnerf_core.fields.voxel_grid import cube_face_object
from advnerf_core.policies.adapter import AdaptedPolicy
from advnerf_core.report.evidence.intervals import clustered_interval
from benchmarks.rclpy_peer import RclpyPeer
from benchmarks.results import REPOSITORY, record_row
from calibration.schema import RoomCalibration, load_calibration
from hardware.worlds.lab.lab import Lab
from nodes.experiment.show.deployed import DressedScene, SelfDriving, drive_deployed
from nodes.lab.ros2_policy import ros2_policy

COMMAND = "python -m benchmarks.ros2_black_box RUN_FOLDER ATTACK_FILE ONNX_FILE"
SPEED_MPS, SIGMA = 0.8, 0.1


def drive_starts(
    folder: Path, attack: AttackFile, policy: AdaptedPolicy, count: int, ticks: int
) -> list[tuple[float, float]]:
    """Total CTE [m] of each start, without and with the attack."""
    calibration = folder / "capture" / "calibration"
    room = load_calibration(RoomCalibration, calibration / "room.yaml")
    plain_rgb = tuple(read_json(folder / "manifest.json")["config"]["carrier"]["plain_rgb"])
    carrier, size_m = attack.face_object, attack.required_face().size_m[0]
    face = cube_face_object(size_m, carrier.theta.shape[0], plain_rgb, carrier.T_world_from_object)
    x_m, y_m, yaw_rad = room.start_pose
    starts = draw_start_states((x_m, y_m, yaw_rad), count, SIGMA, 1).numpy()
    found, horizon = [], Horizon(ticks, off_track_m=room.off_track_m)
    with Lab() as world:
        dressed = DressedScene(world, policy.contract.view, [face])
        plain = dressed.plain_theta()
        shown = plain, torch.from_numpy(np.asarray(carrier.theta)).reshape(plain.shape)
        car = SelfDriving(world, SPEED_MPS, horizon.dt_s)
        for start in starts:
            none_m, attacked_m = (
                drive_deployed(
                    dressed, policy, (), start, room.reference_path, horizon, car, theta
                ).metrics.total_cte_m
                for theta in shown
            )
            found.append((none_m, attacked_m))
            print(
                f"start {np.round(start, 2)}: {none_m:.2f} m without, {attacked_m:.2f} m with the attack",
                flush=True,
            )
    return found


def main() -> None:
    """Drive and record the row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run_folder", type=Path, help="run folder of the experiment whose scene was searched")
    parser.add_argument("attack", type=Path)
    parser.add_argument("network", help="ONNX file for the ROS 2 policy")
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--ticks", type=int, default=40)
    parser.add_argument("--domain", type=int, default=65)
    parser.add_argument("--trial", action="store_true", help="record nothing")
    options = parser.parse_args()
    calibration = options.run_folder / "capture" / "calibration"
    attack, network = load_attack(options.attack), str(Path(options.network).resolve())
    peer = RclpyPeer(options.domain, REPOSITORY / "examples" / "ros2_policy.py", network)
    try:
        policy = ros2_policy(calibration / "camera.yaml", calibration / "vehicle.yaml", options.domain)
        totals = np.array(drive_starts(options.run_folder, attack, policy, options.starts, options.ticks))
    finally:
        peer.close()
    excess_m = totals[:, 1] - totals[:, 0]
    interval = clustered_interval([excess_m])
    assert interval is not None, "expected at least two starts"
    note = (
        f"{interval.low:.2f} to {interval.high:.2f} m (95 %), {len(excess_m)} starts, {options.ticks} ticks; {totals[:, 0].mean():.2f} m without"
        f" and {totals[:, 1].mean():.2f} m with the attack, searched by {attack.method} with the same rclpy program as a black box"
    )
    print(f"excess {excess_m.mean():.2f} m: {note}")
    if not options.trial:
        record_row(
            "ROS 2: excess of total CTE on the simulated lab, an rclpy policy attacked as a black box",
            float(excess_m.mean()),
            "m",
            "interval above 0",
            interval.low > 0.0,
            COMMAND,
            note,
        )


if __name__ == "__main__":
    main()
