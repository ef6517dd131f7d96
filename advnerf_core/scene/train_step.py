"""One training step on the CPU: march, encode, networks, composite, compare, and all of it backwards, in numba kernels.

The backward pass is written out by hand; tests compare it with torch's automatic differentiation in ``torch_step``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.image_files import OPAQUE
from advnerf_core.fields.hash_grid import encode, scatter
from advnerf_core.fields.mlp_kernels import TILE
from advnerf_core.parallel import SLOTS, run_slots, slot_bounds
from advnerf_core.render.contraction import bounded_distances
from advnerf_core.render.march import Samples
from advnerf_core.render.volume_kernels import (
    accumulate,
    accumulate_backward,
    add_distortion_gradient,
    gather_columns,
    mark_visible,
)
from advnerf_core.scene.exposure import RayGains
from advnerf_core.scene.field import SceneField, SceneFieldConfig
from advnerf_core.scene.field_kernels import (
    adam,
    background_backward,
    colour_loss,
    complete_colour_inputs,
    density_network,
    exposed_loss,
    matte_loss,
    two_layers,
    two_layers_backward,
)

Array32 = NDArray[np.float32]


@dataclass(frozen=True)
class StepResult:
    """Result of a training step."""

    loss: float
    mse: float
    rays: int
    samples: int


@dataclass(frozen=True, eq=False)
class Matte:
    """Makes transparency measurable: with a random colour behind field and pixel, only the true opacity always fits.

    Attributes:
        opacities: Opacities of the pixels ``[R]`` uint8.
        behind: Colour behind each ray ``[R, 3]`` in 0..1.
    """

    opacities: NDArray[np.uint8]
    behind: Array32


def _opaque(rays: int) -> Matte:
    """The matte of photographs without alpha: nothing behind them shows."""
    return Matte(np.full(rays, OPAQUE, np.uint8), np.zeros((rays, 3), np.float32))


class CpuStep:
    """Gradients and Adam for a scene field on the CPU.

    Args:
        scene: The field; its parameters are changed in place.
        huber: Error at which the loss changes from square to linear.
        distortion: Weight of the distortion loss, with the distances of ``distortion_distances``.
        opacity: Weight of the mean transmittance of rays in the loss.
    """

    def __init__(
        self, scene: SceneField, huber: float = 0.1, distortion: float = 0.0, opacity: float = 0.0
    ) -> None:
        self.scene, self.huber = scene, np.float32(huber)
        self.distortion, self.opacity = distortion, opacity
        self.values = scene.arrays()
        self.grads = {name: np.zeros_like(value) for name, value in self.values.items()}
        self.means = {name: np.zeros_like(value) for name, value in self.values.items()}
        self.squares = {name: np.zeros_like(value) for name, value in self.values.items()}
        self._buffers: dict[str, Array32] = {}

    def step(
        self,
        rays: Array32,
        targets: NDArray[np.uint8],
        samples: Samples,
        matte: Matte | None = None,
        exposure: RayGains | None = None,
    ) -> StepResult:
        """Add the gradient of a batch over its visible samples; arguments as in ``gradients``."""
        return self.gradients(rays, targets, *self.visible(samples), matte, exposure)

    def visible(self, samples: Samples, least_weight: float = 5e-4) -> tuple[Samples, Array32]:
        """Samples that are visible in the image, and their encodings in tiles ``[tiles, K, TILE]``.

        Behind a surface, and in air that the occupancy grid is too coarse to leave out, weights and therefore gradients vanish;
        everything after the density is spared there.
        """
        v, n = self.values, len(samples.points)
        tiles, rows = -(-n // TILE), self.scene.config.grid.width
        encoded, logs = self._buffer("encoded_all", tiles, rows), self._buffer("log_density", tiles, 2)
        _clear_tail(encoded, n)
        encode(samples.points, n, v["grid.table"], self.scene.grid.levels, encoded)
        w2, b2 = (
            np.ascontiguousarray(v["density_2.weight"][:2]),
            np.ascontiguousarray(v["density_2.bias"][:2]),
        )
        bounds, ray_bounds = slot_bounds(tiles, SLOTS), slot_bounds(samples.rays, SLOTS)
        w1, b1 = v["density_1.weight"], v["density_1.bias"]
        run_slots(lambda s: two_layers(w1, b1, w2, b2, encoded, logs, *bounds[s]), SLOTS)
        keep, least = np.empty(n, np.bool_), np.float32(least_weight)
        run_slots(
            lambda s: mark_visible(logs, samples.widths, samples.begins, *ray_bounds[s], least, keep), SLOTS
        )
        kept = np.flatnonzero(keep)
        compact = self._buffer("encoded", -(-len(kept) // TILE), rows)
        columns = slot_bounds(len(kept), SLOTS, TILE)
        run_slots(lambda s: gather_columns(encoded, kept, *columns[s], compact), SLOTS)
        before = np.concatenate([[0], np.cumsum(keep)])
        return (
            Samples(
                samples.points[kept], samples.t_mid_m[kept], samples.widths[kept], before[samples.begins]
            ),
            compact,
        )

    def gradients(
        self,
        rays: Array32,
        targets: NDArray[np.uint8],
        samples: Samples,
        encoded: Array32,
        matte: Matte | None = None,
        exposure: RayGains | None = None,
    ) -> StepResult:
        """Add the gradient of the mean Huber loss of a batch to ``grads``.

        Args:
            rays: ``[R, 6]`` in box coordinates.
            targets: Pixels ``[R, 3]``.
            encoded: Their encodings ``[tiles, K, TILE]``, overwritten.
            matte: Opacities of the pixels and the colours behind them; for a field without a learned background.
            exposure: Gains on the field's colours, whose gradient is written.
        """
        v, n_rays, n = self.values, len(rays), len(samples.points)
        tiles, ray_tiles = -(-n // TILE), -(-n_rays // TILE)
        field = self._buffer("field", tiles, 1 + self.scene.config.features)
        inputs = self._buffer("inputs", ray_tiles, self.scene.config.colour_inputs)
        colours = self._buffer("colours", ray_tiles, 4)
        weights, grad_weights = np.empty(n, np.float32), np.zeros(n, np.float32)
        alpha, grad_alpha = np.empty(n_rays, np.float32), np.empty(n_rays, np.float32)
        _clear_tail(encoded, n)
        sample_slots, ray_slots = slot_bounds(tiles, SLOTS), slot_bounds(n_rays, SLOTS, TILE)
        density = (v["density_1.weight"], v["density_1.bias"], v["density_2.weight"], v["density_2.bias"])
        run_slots(lambda s: density_network(*density, encoded, field, *sample_slots[s]), SLOTS)
        slot_grads = [self._small_grads() for _ in range(SLOTS)]
        sums = np.zeros((SLOTS, 2))
        if n_rays % TILE:
            inputs[-1], colours[-1] = 0.0, 0.0

        middles, lengths = distortion_distances(samples, self.scene.config)
        pull = np.float32(self.distortion / max(n_rays, 1))

        def shade(slot: int) -> None:
            accumulate(field, samples.widths, samples.begins, *ray_slots[slot], weights, inputs, alpha)
            sums[slot] = self._shade(
                slot_grads[slot],
                rays,
                targets,
                inputs,
                colours,
                alpha,
                grad_alpha,
                ray_slots[slot],
                matte,
                exposure,
            )
            if self.distortion > 0.0:
                add_distortion_gradient(
                    weights, middles, lengths, samples.begins, *ray_slots[slot], pull, grad_weights
                )
            accumulate_backward(
                field,
                samples.widths,
                samples.begins,
                *ray_slots[slot],
                weights,
                inputs,
                grad_alpha,
                grad_weights,
            )

        run_slots(shade, SLOTS)
        self._density_backward(samples, encoded, field, slot_grads)
        loss, square = sums.sum(axis=0) / (3.0 * max(n_rays, 1))
        return StepResult(float(loss), float(square), n_rays, n)

    def _density_backward(
        self, samples: Samples, encoded: Array32, grad_field: Array32, slot_grads: list[dict[str, Array32]]
    ) -> None:
        """Propagate the gradient at the density network's outputs to its weights and the hash table, and sum over slots."""
        v, n = self.values, len(samples.points)
        bounds = slot_bounds(len(encoded), SLOTS)
        _clear_tail(grad_field, n)

        def work(slot: int) -> None:
            g = slot_grads[slot]
            two_layers_backward(
                v["density_1.weight"],
                v["density_1.bias"],
                v["density_2.weight"],
                encoded,
                grad_field,
                *bounds[slot],
                g["density_1.weight"],
                g["density_1.bias"],
                g["density_2.weight"],
                g["density_2.bias"],
            )

        run_slots(work, SLOTS)
        scatter(samples.points, n, encoded, self.scene.grid.levels, self.grads["grid.table"])
        for name in slot_grads[0]:
            for g in slot_grads:
                self.grads[name] += g[name]

    def _shade(
        self,
        grads: dict[str, Array32],
        rays: Array32,
        targets: NDArray[np.uint8],
        inputs: Array32,
        colours: Array32,
        alpha: Array32,
        grad_alpha: Array32,
        bounds: tuple[int, int],
        matte: Matte | None,
        exposure: RayGains | None,
    ) -> tuple[float, float]:
        """Decode, compare and differentiate the rays of a slot; ``inputs`` become their gradient."""
        v, (start, stop) = self.values, bounds
        tiles = (start // TILE, -(-stop // TILE))
        complete_colour_inputs(
            inputs, rays, alpha, v["background"], self.scene.config.direction_bands, start, stop
        )
        w1, b1, w2, b2 = v["colour_1.weight"], v["colour_1.bias"], v["colour_2.weight"], v["colour_2.bias"]
        two_layers(w1, b1, w2, b2, inputs, colours, *tiles)
        scale = np.float32(1.0 / (3.0 * len(rays)))
        if stop % TILE:
            colours[tiles[1] - 1, :, stop % TILE :] = 0.0  # columns without a ray have no gradient
        mixed = np.zeros(0 if matte is None and exposure is None else len(rays), np.float32)
        if exposure is not None:
            before = matte or _opaque(len(rays))
            cover = np.ones_like(alpha) if matte is None else alpha
            sums = exposed_loss(
                colours,
                targets,
                before.opacities,
                before.behind,
                cover,
                exposure.gains,
                start,
                stop,
                self.huber,
                scale,
                mixed,
                exposure.grad_log,
            )
        elif matte is None:
            sums = colour_loss(colours, targets, start, stop, self.huber, scale)
        else:
            sums = matte_loss(
                colours, targets, matte.opacities, matte.behind, alpha, start, stop, self.huber, scale, mixed
            )
        two_layers_backward(
            w1,
            b1,
            w2,
            inputs,
            colours,
            *tiles,
            grads["colour_1.weight"],
            grads["colour_1.bias"],
            grads["colour_2.weight"],
            grads["colour_2.bias"],
        )
        pull = np.float32(self.opacity / max(len(rays), 1))
        background_backward(
            inputs, alpha, v["background"], start, stop, grad_alpha, grads["background"], pull
        )
        if matte is not None:
            grad_alpha[start:stop] += mixed[start:stop]
        if not self.scene.config.learned_background:
            grads["background"][...] = 0.0
        return sums

    def update(self, step: int, rate: float) -> None:
        """Adam with the gradients gathered since the last update; ``step`` counts from 0."""
        mean_scale, square_scale = (
            np.float32(1 / (1 - 0.9 ** (step + 1))),
            np.float32(1 / (1 - 0.99 ** (step + 1))),
        )
        for name, value in self.values.items():
            flat = [a.reshape(-1) for a in (value, self.grads[name], self.means[name], self.squares[name])]
            bounds = slot_bounds(len(flat[0]), SLOTS if name == "grid.table" else 1, 16)

            def work(
                slot: int, flat: Any = flat, bounds: Any = bounds, table: bool = name == "grid.table"
            ) -> None:
                part = slice(*bounds[slot])
                adam(*(a[part] for a in flat), np.float32(rate), mean_scale, square_scale, table)

            run_slots(work, len(bounds))

    def state(self) -> dict[str, Array32]:
        """Parameters and moments by kind and name, not copied."""
        kinds = {"value": self.values, "mean": self.means, "square": self.squares}
        return {f"{kind}.{name}": array for kind, arrays in kinds.items() for name, array in arrays.items()}

    def load_state(self, state: dict[str, Array32]) -> None:
        """Take over what ``state`` gave."""
        for name, array in self.state().items():
            array[...] = state[name]

    def log_density(self, points: Array32) -> Array32:
        """Logarithm of density per box side ``[N]`` at points ``[N, 3]`` in box coordinates."""
        return log_density(self.scene, points)

    def _small_grads(self) -> dict[str, Array32]:
        return {name: np.zeros_like(value) for name, value in self.values.items() if name != "grid.table"}

    def _buffer(self, name: str, tiles: int, rows: int) -> Array32:
        held = self._buffers.get(name)
        if held is None or len(held) < tiles:
            held = self._buffers[name] = np.zeros((tiles + tiles // 8, rows, TILE), np.float32)
        return held[:tiles]


def distortion_distances(samples: Samples, config: SceneFieldConfig) -> tuple[Array32, Array32]:
    """Positions of samples along their rays, and their intervals, for the distortion loss ``[N]``.

    In box sides; in a contracted field bounded.
    """
    t = samples.t_mid_m / np.float32(config.extent_m / config.ray_unit_m)
    return bounded_distances(t, samples.widths) if config.contraction else (t, samples.widths)


def log_density(scene: SceneField, points: Array32) -> Array32:
    """Logarithm of density per box side ``[N]`` at points ``[N, 3]`` of the field (CPU kernels)."""
    v, n = scene.arrays(), len(points)
    tiles = -(-n // TILE)
    encoded = np.zeros((tiles, scene.config.grid.width, TILE), np.float32)
    out = np.empty((tiles, 2, TILE), np.float32)
    encode(np.ascontiguousarray(points, np.float32), n, v["grid.table"], scene.grid.levels, encoded)
    w2, b2 = np.ascontiguousarray(v["density_2.weight"][:2]), np.ascontiguousarray(v["density_2.bias"][:2])
    bounds = slot_bounds(tiles, SLOTS)
    run_slots(
        lambda s: two_layers(v["density_1.weight"], v["density_1.bias"], w2, b2, encoded, out, *bounds[s]),
        SLOTS,
    )
    return np.ascontiguousarray(out[:, 0]).reshape(-1)[:n]


def _clear_tail(tiles: Array32, count: int) -> None:
    """Zero the columns after ``count`` in the last tile, which the networks read but nobody wrote."""
    if count % TILE:
        tiles[-1, :, count % TILE :] = 0.0
