"""Are lenses found from few photographs? Ten photographs by ten cameras, and eleven by one, with known focal lengths.

Generated sets show a painted corner of a box through cameras that differ in size, focal length and distortion. Real ones are fox
photographs: eleven as they are, and ten cropped and scaled, each to its own size. Their truth is the focal length in fox's own file,
found from all photographs. A camera is right within 5 %; one that is left out by name counts as missing, not as wrong.
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from advnerf_core.data.lens import Lens
from advnerf_core.data.transforms import load_transforms
from advnerf_core.geometry import Pinhole
from benchmarks.painted_corner import poses_of, some_camera, write_photographs
from benchmarks.results import record_row
from benchmarks.structure_from_motion import say
from calibration.photo_model import PhotoSource, ReconstructionError, SfmConfig
from calibration.structure_from_motion import reconstruct

COMMAND = "python -m benchmarks.few_photographs"
TEN_PERCENT, ELEVEN_PERCENT = 5.0, 1.0
LONGER_SIDE_PX, FOX_SIZE = 560, (540, 960)
PARTS = ("ten", "eleven", "fox")


@dataclass(frozen=True, eq=False)
class Found:
    """What structure from motion made of one set.

    Attributes:
        given: How many photographs.
        errors_percent: Focal length errors of those that were placed [%].
        left_out: Names of the others with the reason, or why the set was refused.
        models: Names of the lens models.
        seconds: Wall time [s].
    """

    given: int
    errors_percent: tuple[float, ...]
    left_out: tuple[str, ...]
    models: tuple[str, ...]
    seconds: float

    @property
    def largest_percent(self) -> float:
        """Largest error, regardless of sign [%]."""
        return max((abs(error) for error in self.errors_percent), default=float("nan"))


def find(folder: Path, focal_px: dict[str, float]) -> Found:
    """Reconstruct the photographs of a folder, whose focal lengths are known by name."""
    began = time.perf_counter()
    try:
        model = reconstruct(
            folder,
            [PhotoSource("photos", tuple(focal_px))],
            folder / "work",
            SfmConfig(min_registered_share=0.3),
            say,
        )
    except ReconstructionError as error:
        return Found(len(focal_px), (), (str(error),), (), time.perf_counter() - began)
    errors = tuple(100.0 * (image.pinhole.fx / focal_px[image.name] - 1.0) for image in model.images)
    left_out = tuple(f"{image.name}: {image.why}" for image in model.left_out)
    models = tuple(sorted({camera.model for camera in model.cameras}))
    return Found(len(focal_px), errors, left_out, models, time.perf_counter() - began)


def generated(folder: Path, seed: int, cameras: int) -> Found:
    """Photographs of the painted corner: ten by ten cameras, or eleven by one."""
    rng = np.random.default_rng(seed)
    count = 10 if cameras == 10 else 11
    start_rad = rng.uniform(0.15, 0.3)
    poses = poses_of(count, rng.uniform(2.3, 2.8), rng.uniform(1.1, 1.6), start_rad, start_rad + 1.15)
    chosen: list[tuple[Pinhole, Lens]] = [some_camera(rng, LONGER_SIDE_PX) for _ in range(cameras)]
    truth = write_photographs(folder, poses, chosen if cameras == 10 else chosen * count)
    return find(folder, {name: pinhole.fx for name, (_, pinhole) in truth.items()})


def fox(folder: Path, data: Path, step: int, ten_cameras: bool) -> Found:
    """Every ``step``-th fox photograph: eleven at one size, or ten cropped and scaled, each to its own."""
    frames = sorted(load_transforms(data).frames, key=lambda frame: frame.path.name)
    rng, truth = np.random.default_rng(step), dict[str, float]()
    folder.mkdir(parents=True)
    for index, frame in enumerate(frames[::step][: 10 if ten_cameras else 11]):
        image = cv2.imread(str(frame.path))
        if image is None:
            raise OSError(f"expected a photograph in {frame.path}, got a file that OpenCV cannot read")
        height, width = image.shape[:2]
        kept = rng.uniform(0.75, 1.0) if ten_cameras else 1.0
        size = (300 + 35 * index, round((300 + 35 * index) * height / width)) if ten_cameras else FOX_SIZE
        top, left = round(0.5 * (1.0 - kept) * height), round(0.5 * (1.0 - kept) * width)
        crop = image[top : height - top, left : width - left]
        name = frame.path.with_suffix(".png").name
        if not cv2.imwrite(str(folder / name), cv2.resize(crop, size, interpolation=cv2.INTER_AREA)):
            raise OSError(f"expected to write {folder / name}")
        truth[name] = frame.pinhole.fx * size[0] / crop.shape[1]
    return find(folder, truth)


def record(
    line: str,
    target: str,
    limit_percent: float,
    fewest: int,
    results: Sequence[Found],
    trial: bool,
    miss: str = "",
) -> None:
    """Print a row and, unless it is a trial, write it; ``miss`` is the reason to give if the target is missed."""
    largest = max(result.largest_percent for result in results)
    placed, given = (
        sum(len(result.errors_percent) for result in results),
        sum(result.given for result in results),
    )
    met = all(len(r.errors_percent) >= fewest and r.largest_percent <= limit_percent for r in results)
    typical = float(np.median([abs(error) for result in results for error in result.errors_percent]))
    models = ", ".join(sorted({model for result in results for model in result.models}))
    seconds = np.mean([result.seconds for result in results])
    note = (
        f"{len(results)} sets, {placed} of {given} photographs placed; largest error of each set "
        f"{', '.join(f'{result.largest_percent:.2f}' for result in results)} %, median over photographs {typical:.2f} %; "
        f"lenses: {models}; {seconds:.0f} s each"
    )
    reasons = [reason for result in results for reason in result.left_out]
    note += f"; left out: {'; '.join(reasons)}" if reasons else ""
    note += f"; {miss}" if miss and not met else ""
    print(f"{line}: {largest:.2f} %: {note}", flush=True)
    if not trial:
        record_row(line, largest, "% largest focal length error", target, met, COMMAND, note)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--count", type=int, default=5, help="generated sets of each kind; only 5 are written to the ledger"
    )
    parser.add_argument(
        "--data", type=Path, default=Path("../shared/data/fox"), help="folder with fox's transforms.json"
    )
    parser.add_argument("--only", choices=PARTS, nargs="+", default=list(PARTS), help="some of the parts")
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/few_photographs"), help="working folder, emptied first"
    )
    parser.add_argument("--trial", action="store_true", help="print, but do not write the ledger")
    options = parser.parse_args()
    shutil.rmtree(options.folder, ignore_errors=True)
    trial = options.trial or options.count != 5
    if "ten" in options.only:
        sets = [generated(options.folder / f"ten_{seed}", seed, cameras=10) for seed in range(options.count)]
        target = "<= 5 %, or left out by name; >= 8 of 10 placed"
        record("lenses of ten photographs by ten cameras", target, TEN_PERCENT, 8, sets, trial)
    if "eleven" in options.only:
        sets = [
            generated(options.folder / f"eleven_{seed}", seed, cameras=1) for seed in range(options.count)
        ]
        record(
            "lens of eleven photographs by one camera",
            "all placed, <= 1 %",
            ELEVEN_PERCENT,
            11,
            sets,
            trial,
        )
    if "fox" in options.only and (options.data / "transforms.json").exists():
        sets = [fox(options.folder / "fox_ten", options.data, 2, ten_cameras=True)]
        target = "<= 5 %, or left out by name; >= 8 of 10 placed"
        record("lenses of ten fox photographs, each cropped and scaled", target, TEN_PERCENT, 8, sets, trial)
        for step, words in ((4, "all round the fox"), (1, "neighbours")):
            sets = [fox(options.folder / f"fox_eleven_{step}", options.data, step, ten_cameras=False)]
            line = f"lens of eleven fox photographs, {words}"
            miss = (
                "on a short arc an error of the focal length is made up for by the distances"
                if step == 1
                else ""
            )
            record(line, "all placed, <= 1 %", ELEVEN_PERCENT, 11, sets, trial, miss)
    elif "fox" in options.only:
        print(f"left out: fox, whose photographs are not in {options.data}")


if __name__ == "__main__":
    main()
