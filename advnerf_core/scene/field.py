"""The scene field: hash grid, density network, and a colour network that decodes features accumulated along a ray.

Colours are decoded once per ray, from accumulated features and the viewing direction (deferred shading as in Hedman et al. 2021,
"Baking neural radiance fields", and Reiser et al. 2023, "MERF"), not once per sample: on a CPU the networks are the cost, and a
ray has about ten samples.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from advnerf_core.errors import AdvnerfError
from advnerf_core.fields.hash_grid import HashGrid, HashGridConfig
from advnerf_core.fields.spherical_harmonics import spherical_harmonics
from advnerf_core.files import read_tensors, write_tensors
from advnerf_core.render.volume_kernels import MAX_LOG_DENSITY

FORMAT = "advnerf-scene-2"


class SceneFileError(AdvnerfError):
    """A scene file cannot be used."""


_PLACES_M = (0.25, 1000.0)


@dataclass(frozen=True)
class SceneFieldConfig:
    """Sizes of a scene field.

    Attributes:
        box_low_m: Low corner of the scene's box, in the world [m].
        box_high_m: High corner [m].
        grid: Hash grid over a cube with the box's longest side.
        hidden: Width of the hidden layer of both networks.
        features: Features per sample, which are accumulated and decoded to a colour.
        direction_bands: Bands of spherical harmonics of the viewing direction; 1 means colours do not depend on it, as
            in a matte room: fog that looks different from every side then explains nothing, and geometry is learned sooner.
        contraction: Whether the field extends outside the box, with detail that fades with distance; the cube around the box is
            then the inner region of ``render.contraction``.
        learned_background: Whether everything behind the field is one learned colour. Otherwise the field is transparent there,
            as in images with alpha.
    """

    box_low_m: tuple[float, float, float]
    box_high_m: tuple[float, float, float]
    grid: HashGridConfig = field(default_factory=lambda: HashGridConfig(levels=8, features=4, finest=2048))
    hidden: int = 64
    features: int = 15
    direction_bands: int = 1
    contraction: bool = False
    learned_background: bool = True

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.box_low_m, self.box_high_m, strict=True)):
            raise ValueError(f"expected a box with low < high [m], got {self.box_low_m} .. {self.box_high_m}")
        if self.hidden % 4 or self.grid.width % 4 or (self.features + 1) % 4:
            raise ValueError(
                "expected a hidden width, levels * features of the grid, and 1 + features that are multiples of 4, got "
                f"{self.hidden}, {self.grid.width} and 1 + {self.features}"
            )
        if not 1 <= self.direction_bands <= 4:
            raise ValueError(f"expected 1..4 direction bands, got {self.direction_bands}")

    @property
    def ray_unit_m(self) -> float:
        """Unit of ray parameters [m]: the metre; for boxes of a size that no place has in metres, a quarter of their longest side.

        Kernels step 0.1 mm beyond the edge of a cell, which must be less than a cell and more than rounding, in any file's unit.
        """
        return 1.0 if _PLACES_M[0] <= self.extent_m <= _PLACES_M[1] else 0.25 * self.extent_m

    @property
    def extent_m(self) -> float:
        """Longest side of the box, the unit of box coordinates [m]."""
        return max(high - low for low, high in zip(self.box_low_m, self.box_high_m, strict=True))

    @property
    def origin_m(self) -> tuple[float, float, float]:
        """Origin of box coordinates in the world [m]: the low corner of the box, or of the cube around it if contracted."""
        if not self.contraction:
            return self.box_low_m
        half = 0.5 * self.extent_m
        x, y, z = (
            0.5 * (low + high) - half for low, high in zip(self.box_low_m, self.box_high_m, strict=True)
        )
        return x, y, z

    @property
    def box_high(self) -> NDArray[np.float32]:
        """High corner ``[3]`` of the grids' range: of the box in box coordinates, or of the contracted cube."""
        if self.contraction:
            return np.ones(3, np.float32)
        return ((np.array(self.box_high_m) - np.array(self.box_low_m)) / self.extent_m).astype(np.float32)

    @property
    def colour_inputs(self) -> int:
        """Inputs of the colour network: features and directions, filled up to a multiple of 4."""
        return -(-(self.features + self.direction_bands**2) // 4) * 4

    def to_dict(self) -> dict[str, Any]:
        """For JSON and hashes."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> SceneFieldConfig:
        """Inverse of ``to_dict``, from JSON."""
        low, high = tuple(values["box_low_m"]), tuple(values["box_high_m"])
        return cls(
            **{**values, "box_low_m": low, "box_high_m": high, "grid": HashGridConfig(**values["grid"])}
        )


class SceneField(nn.Module):
    """Density and colour everywhere in a box, or with a contraction everywhere.

    All points are in box coordinates, from the low corner in units of the longest side, or in the contracted cube.
    """

    def __init__(self, config: SceneFieldConfig, seed: int = 0) -> None:
        super().__init__()
        self.config = config
        generator = torch.Generator().manual_seed(seed)
        self.grid = HashGrid(config.grid, generator)
        self.density_1 = _linear(config.grid.width, config.hidden, generator)
        self.density_2 = _linear(config.hidden, 1 + config.features, generator)
        self.colour_1 = _linear(config.colour_inputs, config.hidden, generator)
        self.colour_2 = _linear(
            config.hidden, 4, generator
        )  # red, green, blue, unused: kernels need multiples of four
        self.background = nn.Parameter(torch.zeros(config.features), requires_grad=config.learned_background)

    def density_and_features(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Density per box side ``[N]`` and features ``[N, C]`` in (-1, 1) at points ``[N, 3]``."""
        hidden = torch.relu(self.density_1(self.grid(points)))
        out = self.density_2(hidden)
        return torch.exp(out[:, 0].clamp(max=MAX_LOG_DENSITY)), nn.functional.softsign(out[:, 1:])

    def decode(self, features: Tensor, directions: Tensor) -> Tensor:
        """Colours ``[N, 3]`` in 0..1 of accumulated features ``[N, C]`` seen along unit ``directions [N, 3]``."""
        inputs = torch.cat([features, spherical_harmonics(directions, self.config.direction_bands)], dim=-1)
        inputs = nn.functional.pad(inputs, (0, self.config.colour_inputs - inputs.shape[-1]))
        return torch.sigmoid(self.colour_2(torch.relu(self.colour_1(inputs)))[:, :3])

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """Parameters by name as numpy arrays that share their memory (CPU only)."""
        return {name: value.detach().numpy() for name, value in self.named_parameters()}


def _linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    bound = (6.0 / inputs) ** 0.5  # He et al. 2015 for rectifiers
    nn.init.uniform_(layer.weight, -bound, bound, generator=generator)
    nn.init.zeros_(layer.bias)
    return layer


def scene_hash(scene: SceneField, occupancy: NDArray[np.bool_]) -> str:
    """Content hash of a trained scene in its file's form: its configuration, weights and occupancy; 16 hexadecimal digits."""
    digest = hashlib.sha256(json.dumps(scene.config.to_dict(), sort_keys=True).encode())
    for name, value in sorted(scene.named_parameters()):
        digest.update(name.encode() + _as_kept(name, value).float().numpy().tobytes())
    digest.update(np.packbits(occupancy).tobytes())
    return digest.hexdigest()[:16]


def _as_kept(name: str, value: Tensor) -> Tensor:
    """A parameter in the file's form: tables of the grid in half precision, unless a feature is too large for it."""
    kept = value.detach().cpu().contiguous()
    if not name.startswith("grid.") or float(kept.abs().max()) > torch.finfo(torch.float16).max:
        return kept
    return kept.half()


def save_scene(
    path: str | Path, scene: SceneField, occupancy: NDArray[np.bool_], metadata: dict[str, Any] | None = None
) -> str:
    """Write a trained scene to one ``.safetensors`` file, atomically.

    The grid's tables, nearly all of it, are stored in half precision, as Instant-NGP trains them: a loaded scene differs by at most
    one part in 2048 in each feature.

    Args:
        occupancy: Occupied cells ``[X, Y, Z]``.
        metadata: JSON values: how it was trained, figures.

    Returns:
        The scene's hash.
    """
    tensors = {name: _as_kept(name, value) for name, value in scene.named_parameters()}
    content = scene_hash(scene, occupancy)
    tensors["occupancy_bits"] = torch.from_numpy(np.packbits(occupancy))
    header = {
        "format": FORMAT,
        "config": json.dumps(scene.config.to_dict()),
        "occupancy_shape": json.dumps(list(occupancy.shape)),
        "scene_hash": content,
        "metadata": json.dumps(metadata or {}),
    }
    write_tensors(path, "torch", tensors, header)
    return content


def load_scene_config(path: str | Path) -> SceneFieldConfig:
    """Read the sizes of a scene file.

    Raises:
        SceneFileError: The file is missing, damaged, or of another kind.
    """
    return _read(Path(path), with_tensors=False)[1]


def load_scene(path: str | Path) -> tuple[SceneField, NDArray[np.bool_], dict[str, Any]]:
    """Read a scene file: field, occupancy ``[X, Y, Z]``, metadata (with ``scene_hash``).

    Raises:
        SceneFileError: The file is missing, damaged, or of another kind.
    """
    path = Path(path)
    header, config, tensors = _read(path)
    scene = SceneField(config)
    shape = tuple(json.loads(header["occupancy_shape"]))
    occupancy = (
        np.unpackbits(tensors.pop("occupancy_bits").numpy(), count=int(np.prod(shape)))
        .reshape(shape)
        .astype(bool)
    )
    try:
        scene.load_state_dict(tensors)
    except RuntimeError as error:
        raise SceneFileError(
            f"expected weights that fit the configuration in {path}, got: {error}"
        ) from error
    metadata = {**json.loads(header["metadata"]), "scene_hash": header["scene_hash"]}
    return scene, occupancy, metadata


def _read(
    path: Path, with_tensors: bool = True
) -> tuple[dict[str, str], SceneFieldConfig, dict[str, Tensor]]:
    """Header, sizes and tensors of a scene file."""
    try:
        header, tensors = read_tensors(path, "torch", None if with_tensors else ())
    except (OSError, ValueError) as error:
        raise SceneFileError(
            f"expected a scene file at {path}, got: {error}; train the scene again"
        ) from error
    if header.get("format") != FORMAT:
        raise SceneFileError(
            f"expected format {FORMAT} in {path}, got {header.get('format')}; train the scene again"
        )
    return header, SceneFieldConfig.from_dict(json.loads(header["config"])), tensors
