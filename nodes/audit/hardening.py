"""Frames for hardening a policy that was driven off: its images past the object, labelled with the steering that keeps the path."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from advnerf_core.data.image_files import write_image
from advnerf_core.files import write_atomically
from nodes.audit.drives import FOUND
from nodes.audit.judging import Judged, open_world, seen_on
from nodes.audit.question import RETURNS_IN

FOLDER, LABELS = "harden", "labels.csv"
_COLUMNS = ("image", "steering", "unit", "x_m", "y_m", "yaw_rad", "cte_m")
# Number of drives whose frames are exported, those with the largest effect.
_DRIVES = 5


def export_frames(judged: Judged, folder: Path) -> Path:
    """Write ``images`` and ``labels.csv``, whose path is returned; the user's policy is not trained.

    Steering is positive to the left, in the unit of the car's control.
    """
    experiment, drives = judged.experiment, judged.drives[FOUND]
    scenario = experiment.config.paths[0]
    # A world of a user's own has no teacher that was made for its lane, and the usual one is for lanes of metres.
    expert = experiment.expert(scenario, 1.0 / (RETURNS_IN * judged.limit_m))
    rows: list[tuple[str | float, ...]] = []
    worst = np.argsort(-drives.largest_m, kind="stable")[:_DRIVES]
    with open_world(experiment, judged.evidence) as world:
        for number in worst.tolist():
            states = drives.states[number][: 1 + int(drives.driven_ticks[number])]
            pictures = seen_on(experiment, judged.arms[FOUND], states, world)
            steering = expert.steer_states(states)
            ctes_m = experiment.paths[scenario].project(states[:, :2]).cte_m
            for tick, rgb in enumerate(pictures):
                name = f"images/{number:02d}_{tick:03d}.png"
                write_image(folder / name, rgb)
                labels = (
                    float(steering[tick]),
                    experiment.car.control_unit,
                    *states[tick].tolist(),
                    float(ctes_m[tick]),
                )
                rows.append((name, *labels))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_COLUMNS)
    table.writerows(rows)
    write_atomically(folder / LABELS, text.getvalue())
    return folder / LABELS
