"""The choice of what computes: plain torch on a GPU, or the processor's kernels. This is the only place that chooses.

A GPU is used if it gives the processor's numbers for ten rays and one gradient of each part, on a small scene with fixed random values.
A difference is relative to the largest value. Of a thousand values one may differ more: a sample at the edge of a cell falls to either side.
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advnerf_core.fields.hash_grid import HashGrid, HashGridConfig, encode_reference
from advnerf_core.fields.soft_edges import with_soft_edges
from advnerf_core.fields.voxel_grid import cube_face_object
from advnerf_core.geometry import Pinhole, make_transform, rotation_z
from advnerf_core.render.march import MarchConfig, Marcher
from advnerf_core.render.occupancy import leap_distances
from advnerf_core.render.soft_pose import placement_of, soft_layer
from advnerf_core.scene.baked import BakedScene, Voxels
from advnerf_core.scene.device import device_name, gpu, use_exact_arithmetic
from advnerf_core.scene.device_surrogate import DeviceSurrogate, background_on
from advnerf_core.scene.field import SceneField, SceneFieldConfig
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.surrogate import Surrogate
from advnerf_core.scene.torch_step import TorchStep
from advnerf_core.scene.train_step import CpuStep

TEN_RAYS = Pinhole(5, 2, 4.0, 4.0, 2.5, 1.0)
_CAMERA = np.array(
    [[0.0, 0.0, 1.0, -0.9], [-1.0, 0.0, 0.0, 0.05], [0.0, -1.0, 0.0, 0.02], [0.0, 0.0, 0.0, 1.0]]
)
_MARCH = MarchConfig(
    near_m=0.05, smallest_step_m=0.03, largest_step_m=0.06, step_growth=0.03, max_samples=128
)
_FIELD = SceneFieldConfig(
    (-1.0,) * 3,
    (1.0,) * 3,
    HashGridConfig(levels=4, features=4, log2_entries=12, finest=64),
    hidden=16,
    features=7,
)

Values = dict[str, Tensor]
Run = Callable[[], Values]


@dataclass(frozen=True)
class Comparison:
    """One part on a device and on the processor.

    Attributes:
        difference: Largest difference, relative to the largest value.
        tolerance: Difference up to which they agree.
        seconds: Time of the second run on the device [s].
        processor_seconds: The same on the processor [s].
        trouble: The error of a part that did not run.
    """

    part: str
    difference: float
    tolerance: float
    seconds: float = 0.0
    processor_seconds: float = 0.0
    trouble: str = ""

    @property
    def agrees(self) -> bool:
        """Whether the part ran with the processor's numbers."""
        return not self.trouble and self.difference <= self.tolerance


def _random(seed: int, *shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def _encoding(device: torch.device | None, lens: Pinhole) -> Run:
    grid = HashGrid(_FIELD.grid, torch.Generator().manual_seed(1))
    points = _random(2, lens.width * lens.height, 3).sigmoid()
    if device is None:
        return lambda: {"features": grid(points)}
    table, there = grid.table.to(device), points.to(device)
    return lambda: {"features": encode_reference(there, table, grid.levels)}


def _some_field() -> SceneField:
    scene, generator = SceneField(_FIELD), torch.Generator().manual_seed(3)
    with torch.no_grad():
        for parameter in scene.parameters():
            parameter.normal_(0.0, 0.3, generator=generator)
    return scene


def _leaps() -> Any:
    return leap_distances(_random(4, 16, 16, 16).numpy() > 0.3, np.full(3, 16.0, np.float32))


def _background(device: torch.device | None, lens: Pinhole, here: Any) -> Run:
    render = here if device is None else background_on(device, here)
    return lambda: dict(zip(("colours", "depths"), render(_CAMERA[None], lens)[:2], strict=True))


def _field(device: torch.device | None, lens: Pinhole) -> Run:
    return _background(device, lens, FieldRenderer(_some_field(), _leaps().distance == 0, _MARCH))


def _baked(device: torch.device | None, lens: Pinhole) -> Run:
    leaps, rng = _leaps(), np.random.default_rng(5)
    bricks = np.full((16, 16, 16), -1, np.int32)
    bricks[8, 4:12, 4:12] = 17**3 + 27 * np.arange(64).reshape(8, 8)
    values = rng.integers(60, 130, (17**3 + 27 * 64, 4)).astype(np.uint8)
    voxels = Voxels(values, bricks, (bricks >= 0).astype(np.uint8), rng.random(3, np.float32))
    return _background(device, lens, BakedScene(_FIELD, _MARCH, leaps, 5e-3, voxels))


def _objects() -> list[Any]:
    behind, before = (
        make_transform(rotation_z(np.pi + 0.3), [0.5, 0.0, 0.0]),
        make_transform(rotation_z(np.pi), [0.2, 0.3, 0.1]),
    )
    cloud = cube_face_object(0.9, 8, T_world_from_object=behind, depth_m=0.4, one_sided=False)
    return [with_soft_edges(cloud), cube_face_object(0.5, 6, T_world_from_object=before)]


def _wall(poses: Any, lens: Pinhole) -> tuple[Tensor, Tensor]:
    shape = (len(poses), lens.height, lens.width)
    return torch.full((*shape, 3), 0.4), torch.full(shape, 3.0)


def _drawn(device: torch.device | None, lens: Pinhole) -> Run:
    here = Surrogate(_wall, lens, np.eye(4), _objects())
    sensor = here if device is None else DeviceSurrogate(here, device)
    theta, slopes = _random(6, *here.theta_shape), _random(7, 1, 3, lens.height, lens.width)

    def run() -> Values:
        rendered = sensor.render(_CAMERA[None], theta)
        return {"images": rendered.images, "gradient": rendered.vjp(slopes.to(rendered.images.device))}

    return run


def _placed(device: torch.device | None, lens: Pinhole) -> Run:
    cloud = _objects()[0]
    colours = _random(8, cloud.slot_count, 3).sigmoid().double().numpy()

    def run() -> Values:
        layer = soft_layer(cloud, placement_of(cloud), colours, _CAMERA[None], lens, 1, device=device)
        by_place, by_colour = layer.pull(np.cos(np.arange(4.0 * len(layer.pixels))).reshape(-1, 4))
        found = {"colour": layer.colour, "by place": by_place, "by colour": by_colour}
        return {name: torch.from_numpy(each) for name, each in found.items()}

    return run


def _training(device: torch.device | None, lens: Pinhole) -> Run:
    count = lens.width * lens.height
    directions = torch.nn.functional.normalize(_random(9, count, 3), dim=1) / _FIELD.extent_m
    rays = torch.cat([_random(10, count, 3).sigmoid(), directions], 1).numpy()
    samples, kept = Marcher(1 << 18, _MARCH, _FIELD.box_high)(rays, np.full(count, 0.5, np.float32), _leaps())
    targets = np.random.default_rng(11).integers(0, 256, (len(kept), 3)).astype(np.uint8)

    def run() -> Values:
        step = CpuStep(_some_field()) if device is None else TorchStep(_some_field().to(device))
        loss = step.step(rays[kept], targets, samples).loss
        grads = {name: torch.as_tensor(grad) for name, grad in step.grads.items()}
        return {"loss": torch.tensor([loss]), **grads}

    return run


def _policy(device: torch.device | None, lens: Pinhole) -> Run:
    weights = _random(12, 4, 3, 2, 2).to(device or "cpu")
    images = _random(13, 4, 3, lens.height, lens.width).to(device or "cpu")

    def run() -> Values:
        with torch.enable_grad():
            steering = torch.conv2d(images.requires_grad_(), weights).tanh().mean((1, 2, 3))
            (gradient,) = torch.autograd.grad(steering.sum(), images)
        return {"steering": steering, "gradient": gradient}

    return run


# Sums of single precision in other orders, and in a training step the samples whose weight is at the threshold of what counts.
_PARTS: dict[str, tuple[Callable[[torch.device | None, Pinhole], Run], float]] = {
    "hash encoding": (_encoding, 1e-5),
    "field": (_field, 1e-3),
    "baked scene": (_baked, 1e-3),
    "objects and colours": (_drawn, 1e-5),
    "placements": (_placed, 1e-8),
    "policy": (_policy, 1e-4),
    "training step": (_training, 2e-3),
}
PARTS = tuple(_PARTS)
TRAINING_PARTS = ("hash encoding", "training step")
SEARCH_PARTS = tuple(part for part in PARTS if part != "training step")


@torch.no_grad()
def compare(part: str, device: torch.device, lens: Pinhole = TEN_RAYS) -> Comparison:
    """Run a part on a device and on the processor, twice each: the second run is timed."""
    make, tolerance = _PARTS[part]
    use_exact_arithmetic()
    try:
        with torch.random.fork_rng(devices=[]):  # what follows must not depend on this check
            theirs, seconds = _timed(make(device, lens))
            ours, processor_seconds = _timed(make(None, lens))
    except Exception as error:  # whatever a driver, a compiler or a library raises
        trouble = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Comparison(part, float("nan"), tolerance, trouble=trouble)
    difference = max(_difference(theirs[name], ours[name]) for name in ours)
    return Comparison(part, difference, tolerance, seconds, processor_seconds)


def disagreement(device: torch.device, parts: Sequence[str]) -> str:
    """Why a device is not used, in words; empty if all parts give the processor's numbers."""
    for part in parts:
        found = compare(part, device)
        if found.trouble:
            return f"{part} failed, {found.trouble}"
        if not found.agrees:
            return f"{part} differ from the processor's by {found.difference:.1e}, at most {found.tolerance:.0e} is expected"
    return ""


@functools.cache
def search_device() -> torch.device | None:
    """The GPU that searches use in this process; None is the processor, as the GPU does not give its numbers.

    Raises:
        DeviceError: There is no GPU.
    """
    return gpu() if is_right(gpu()) else None


@functools.cache
def training_device() -> torch.device:
    """Where scenes are trained in this process: a GPU, if there is one and its training step gives the processor's numbers."""
    there = torch.cuda.is_available() and is_right(gpu(), TRAINING_PARTS)
    return gpu() if there else torch.device("cpu")


def is_right(device: torch.device, parts: Sequence[str] = SEARCH_PARTS) -> bool:
    """Whether a device gives the processor's numbers for the named parts; if not, it prints why."""
    trouble = disagreement(device, parts)
    if trouble:
        _print(f"not computing with {device_name(device)}: {trouble}")
        _print("computing with the processor; `advnerf doctor --gpu` prints a report to send us")
    return not trouble


def _print(line: str) -> None:
    print(f"advnerf: {line}", file=sys.stderr, flush=True)


def _timed(run: Run) -> tuple[Values, float]:
    for _ in range(2):
        began = time.perf_counter()
        values = {
            name: value.detach().cpu().double() for name, value in run().items()
        }  # waits for the device
    return values, time.perf_counter() - began


def _difference(found: Tensor, wanted: Tensor) -> float:
    if found.shape != wanted.shape:
        return float("inf")
    same = (found == wanted) | (found.isnan() & wanted.isnan())
    differences = torch.where(same, 0.0, (found - wanted).abs().nan_to_num(torch.inf)).flatten().sort().values
    largest = wanted.nan_to_num(0.0, 0.0, 0.0).abs().max().clamp(min=1e-12)
    return float(differences[-1 - len(differences) // 1000] / largest)
