"""How exact are poses found by structure from motion? A phone's video of the lab, whose true poses are known.

All images must be placed. After the similarity that fits best, errors are root mean squares over all images, positions as a share of the
largest distance between two of them; the largest errors are in the note.
"""

from __future__ import annotations

import argparse
import math
import shutil
import time
from pathlib import Path

import numpy as np

from advnerf_core.data.similarity import align_poses
from benchmarks.lab_recordings import lab_with_phone, photograph, video_poses
from benchmarks.results import record_row
from calibration.photo_model import PhotoSource, SfmConfig
from calibration.structure_from_motion import reconstruct
from hardware.worlds.lab.lab import Lab

POSITION_PERCENT, ROTATION_DEG = 0.3, 0.3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=150, help="frames of the video")
    parser.add_argument("--width", type=int, default=960, help="width of the phone's images [px]")
    parser.add_argument(
        "--folder",
        type=Path,
        default=Path("runs/structure_from_motion"),
        help="working folder, emptied first",
    )
    parser.add_argument("--trial", action="store_true", help="print, but do not write the ledger")
    arguments = parser.parse_args()

    shutil.rmtree(arguments.folder, ignore_errors=True)
    config = lab_with_phone(arguments.width)
    poses = video_poses(config, arguments.frames)
    with Lab(config) as lab:
        files = photograph(lab, poses, arguments.folder / "images")
    truth = {file.name: pose for file, pose in zip(files, poses, strict=True)}

    began = time.perf_counter()
    source = PhotoSource("phone", tuple(truth), ordered=True)
    model = reconstruct(
        arguments.folder / "images",
        [source],
        arguments.folder / "colmap",
        SfmConfig(min_registered_share=0.1),
        say,
    )
    seconds = time.perf_counter() - began

    # Every placed image counts, however far off: nothing is thrown out here.
    aligned = align_poses(
        model.poses,
        np.stack([truth[image.name] for image in model.images]),
        math.inf,
        math.inf,
        min_inlier_share=1.0,
    )
    percent = 100.0 * aligned.rms_position_m / aligned.extent_m
    degrees = math.degrees(aligned.rms_rotation_rad)
    placed, phone = len(model.images), model.images[0].pinhole
    note = (
        f"{placed} of {len(files)} images placed, rms {1000 * aligned.rms_position_m:.1f} mm over {aligned.extent_m:.2f} m and {degrees:.2f} degrees; "
        f"largest {1000 * aligned.position_error_m.max():.0f} mm, {math.degrees(aligned.rotation_error_rad.max()):.2f} degrees; focal length "
        f"{phone.fx:.1f} px, true {config.phone.pinhole.fx:.1f}; {model.reprojection_error_px:.2f} px reprojection error; {seconds:.0f} s"
    )
    met = placed == len(files) and percent <= POSITION_PERCENT and degrees <= ROTATION_DEG
    print(f"{percent:.3f} % of the extent: {note}")
    if not arguments.trial:
        record_row(
            "structure from motion on rendered lab images",
            percent,
            "% of the extent, rms",
            "all placed, <= 0.3 %, <= 0.3 degrees",
            met,
            "python -m benchmarks.structure_from_motion",
            note,
        )


_last_s = 0.0


def say(fraction: float, text: str = "") -> None:
    """A line now and then."""
    global _last_s
    if time.monotonic() - _last_s > 10.0:
        _last_s = time.monotonic()
        print(f"{100 * fraction:3.0f} %  {text}", flush=True)


if __name__ == "__main__":
    main()
