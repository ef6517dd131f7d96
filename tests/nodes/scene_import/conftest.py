from pathlib import Path

import numpy as np
import pytest

from advnerf_core.geometry import planar_pose
from calibration.by_construction import twin_calibrations
from calibration.schema import save_calibration
from hardware.worlds.lab.config import LabConfig
from nodes.bags.writer import BagWriter
from nodes.runtime.messages import encode, image_message, pose_message

START_NS, PERIOD_NS = 1_800_000_000_000_000_000, 100_000_000
WIDTH, HEIGHT = 336, 188


def state_at(time_s: float) -> tuple[float, float, float]:
    """A circle of 1.5 m at 0.6 m/s."""
    angle = 0.4 * time_s
    return 1.5 * np.cos(angle), 1.5 * np.sin(angle), angle + 0.5 * np.pi


@pytest.fixture
def write_bag(tmp_path):
    """Writes a bag of a drive along ``state_at``: frames at 10 Hz, motion capture at 100 Hz."""

    def write(
        name="drive", seconds=3.0, gap=(), calibrated=True, size=(WIDTH, HEIGHT), state=state_at, paint=None
    ) -> Path:
        attachments = {}
        if calibrated:
            file = tmp_path / "camera.yaml"
            save_calibration(twin_calibrations(LabConfig())["camera"], file)
            attachments = {"camera.yaml": file.read_bytes()}
        folder = tmp_path / name
        with BagWriter(folder, attachments) as bag:
            # Motion capture starts before and ends after the camera; its stamps never fall on the camera's.
            for k in range(-5, round(seconds * 100) + 10):
                time_s = 0.01 * k + 0.003
                if not any(low <= time_s <= high for low, high in gap):
                    stamp = START_NS + round(1e9 * time_s)
                    bag.write(
                        "/vicon/car",
                        encode(pose_message(planar_pose(*state(time_s)), stamp)),
                        stamp,
                        stamp,
                        k + 5,
                    )
            for k in range(round(seconds * 10)):
                stamp = START_NS + k * PERIOD_NS
                image = np.full((size[1], size[0], 3), k, np.uint8) if paint is None else paint(0.1 * k)
                bag.write("/camera/image_raw", encode(image_message(image, stamp, "camera")), stamp, stamp, k)
        return folder

    return write
