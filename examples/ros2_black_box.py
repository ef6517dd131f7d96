"""A policy that runs in ROS 2 as a black box: the factory to name wherever advnerf asks for a policy.

    .venv-ros2/bin/python examples/ros2_policy.py policy.onnx
    .venv/bin/python examples/ros2_black_box.py

Leave the first line running in another terminal; the second one asks it for its steering. Then attack it, with images of a learned scene:

    .venv/bin/advnerf attack run launch/corner.experiment.yaml -o runs/black_ros2 \\
        --set victims.mine.policy=examples.ros2_black_box:factory --set 'over.method=[cem]' --set attack.evaluations=50
"""

from __future__ import annotations

import torch

from advnerf_core.errors import AdvnerfError
from advnerf_core.policies.adapter import AdaptedPolicy
from nodes.lab.ros2_policy import ros2_policy
from nodes.runtime.paths import shipped


def factory() -> AdaptedPolicy:
    """The program on domain 0 that drives the simulated lab's car."""
    twin = shipped("calibration/twin")
    return ros2_policy(twin / "camera.yaml", twin / "vehicle.yaml", domain_id=0)


def show() -> None:
    """What the program answers to plain images."""
    policy = factory()
    camera = policy.contract.view.camera
    for name, value in (("black", 0.0), ("grey", 0.5), ("white", 1.0)):
        image = torch.full((1, 3, camera.height, camera.width), value)
        print(f"{name:5s} image: {float(policy(image)):+.4f} rad")


if __name__ == "__main__":
    try:
        show()
    except AdvnerfError as error:
        raise SystemExit(f"error: {error}") from None
