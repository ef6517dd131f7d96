"""Stage capture: photograph the lab with the phone, and with the driving camera for comparison."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.posed_images import write_posed_images
from advnerf_core.geometry import Array, planar_pose
from calibration.by_construction import write_twin_calibrations
from calibration.schema import save_calibration
from hardware.worlds.lab.lab import Lab
from hardware.worlds.lab.phone import car_mounted_poses, walk_around_poses
from nodes.experiment.config import CaptureConfig
from nodes.experiment.context import CALIBRATION, DISPLAY, Experiment
from nodes.experiment.learned_scene import HELD_OUT
from nodes.experiment.screen import measure_display, plain_picture
from nodes.runtime.progress import Report, counted

PHONE, COLOUR_PAIRS = "phone", "colour_pairs"


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write three posed image sets: ``phone`` (learned from), ``colour_pairs`` and ``held_out`` (driving camera)."""
    capture, lab_config = experiment.config.capture, experiment.lab_config
    write_twin_calibrations(lab_config, folder / CALIBRATION)
    rng = np.random.default_rng(capture.seed)
    phone_poses = [
        *walk_around_poses(lab_config, capture.walk_around, rng),
        *car_mounted_poses(lab_config, capture.car_mounted, rng),
    ]
    car_states = driving_states(experiment, capture.colour_pairs + capture.held_out, rng)
    driving_poses = [planar_pose(*state) @ experiment.camera.mount for state in car_states]
    total = len(phone_poses) + len(driving_poses)
    with Lab(lab_config) as lab:
        if experiment.shown_on_monitor:
            report(0.0, "measuring the monitor's colours")
            fit = measure_display(lab, capture.seed)
            save_calibration(fit.calibration(), folder / CALIBRATION / f"{DISPLAY}.yaml")
            lab.set_monitor_image(plain_picture(experiment))

        def photograph(
            name: str, poses: list[Array], take: Callable[[int], NDArray[np.uint8]], done: int
        ) -> None:
            phone = name == PHONE
            write_posed_images(
                folder / name,
                poses,
                (lab_config.phone if phone else lab_config.camera).pinhole,
                take,
                "jpg" if phone else "png",
                told=counted(report, name, len(poses), done, total),
            )

        photograph(PHONE, phone_poses, lambda i: lab.photograph(phone_poses[i]), 0)
        # Interleaved, so that both sets cover the whole track.
        held_out = _held_out_indices(capture)
        pairs = [i for i in range(len(driving_poses)) if i not in held_out]
        for name, chosen, done in ((COLOUR_PAIRS, pairs, 0), (HELD_OUT, sorted(held_out), len(pairs))):
            poses = [driving_poses[i] for i in chosen]
            states = [car_states[i] for i in chosen]
            photograph(name, poses, lambda i, s=states: lab.observe_at(*s[i])[0], len(phone_poses) + done)  # type: ignore[misc]


def driving_states(experiment: Experiment, count: int, rng: np.random.Generator) -> Array:
    """Car states ``[count, 3]`` spread evenly over the path, with the offsets that driving shows."""
    path = experiment.path
    s_m = (np.arange(count) + rng.uniform(0.0, 1.0, count)) / count * path.length_m
    poses = path.pose_at(s_m)
    lateral_m = rng.uniform(-0.15, 0.15, count)
    states = poses.copy()
    states[:, 0] -= np.sin(poses[:, 2]) * lateral_m
    states[:, 1] += np.cos(poses[:, 2]) * lateral_m
    states[:, 2] += rng.uniform(-0.15, 0.15, count)
    return states


def _held_out_indices(capture: CaptureConfig) -> set[int]:
    total = capture.colour_pairs + capture.held_out
    return {int(i) for i in np.linspace(0, total - 1, capture.held_out).round()}
