"""An attack on a monitor's picture, or on a print, as the camera sees it: `advnerf_core.display` with gradients.

``DisplayedSensor`` stands before any sensor whose ``theta`` is the squash-inverse of colours. The attack then searches the colours that are
*shown*; the renderer gets the colours that are *seen*. Nothing else changes, and the result goes to the monitor unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from advnerf_core.display import DARKEST, PAIRS, DisplayModel
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.geometry import Array
from advnerf_core.scene.surrogate import Rendered

# The squash has no inverse at 0 and 1.
_MARGIN = 1e-4


def displayed(model: DisplayModel, shown: Tensor, cos_angle: float | Tensor = 1.0) -> Tensor:
    """Seen colours ``[..., 3]`` of shown colours ``[..., 3]`` in 0..1; differentiable. See `DisplayModel.forward`."""
    curves, mixing, ambient, products = (
        torch.tensor(v).to(shown) for v in (model.curves, model.mixing, model.ambient, model.products)
    )
    last = curves.shape[1] - 1
    position = shown.clamp(0.0, 1.0) * last
    below = position.detach().floor().clamp(0, last - 1)
    index = below.long()
    channel = torch.arange(3, device=shown.device).expand(shown.shape)
    low, high = curves[channel, index], curves[channel, index + 1]
    light = low + (position - below) * (high - low)
    gain = torch.as_tensor(cos_angle, dtype=shown.dtype, device=shown.device)[..., None] ** model.falloff
    mixed = light @ mixing.T
    if model.products.any():
        pairs = [light[..., a] * light[..., b] for a, b in PAIRS]
        mixed = mixed + torch.stack([*pairs, light.prod(dim=-1)], dim=-1) @ products.T
    seen = ambient + gain * mixed
    return (seen.clamp_min(DARKEST) ** (1.0 / model.response)).clamp(0.0, 1.0)


@dataclass(frozen=True, eq=False)
class DisplayedSensor:
    """A sensor whose colours are shown on a monitor, or printed.

    Attributes:
        sensor: A `Sensor` that renders ``theta`` with the last axis red, green, blue before squashing; the methods and objects beyond
            `Sensor` work if it has them (`ColouringSensor`, `PosedSensor`).
        model: The monitor, or the print, before the camera.
        cos_angle: Cosine of the camera's viewing angle to the panel, averaged over a drive.
    """

    sensor: Any
    model: DisplayModel
    cos_angle: float = field(default=1.0)

    @property
    def theta_shape(self) -> tuple[int, ...]:
        """Shape of theta, from the sensor behind it."""
        return self.sensor.theta_shape

    @property
    def objects(self) -> Sequence[ColouredObject]:
        """Objects of the sensor behind it."""
        return self.sensor.objects

    def plain_theta(self) -> Tensor:
        """Shown colours that look like the plain colours of the sensor behind it, as in `initial_theta`."""
        return self.sensor.plain_theta()

    def initial_theta(self, generator: torch.Generator) -> Tensor:
        """Initial parameters: shown colours that look like those of the sensor behind it."""
        return self.sensor.initial_theta(generator)

    def seen_theta(self, theta: Tensor) -> Tensor:
        """Squash-inverse of the seen colours; differentiable."""
        return torch.logit(displayed(self.model, torch.sigmoid(theta), self.cos_angle), eps=_MARGIN)

    def sense(self, states: Tensor, theta: Tensor) -> Rendered:
        """Images at detached states with their vjp with respect to the shown colours."""
        return self._shown(lambda seen: self.sensor.sense(states, seen), theta)

    def camera_poses(self, states: Tensor) -> Array:
        """Camera poses of the sensor behind it."""
        return self.sensor.camera_poses(states)

    def render(self, T_world_from_camera: Array, theta: Tensor) -> Rendered:
        """The same as `sense` at camera poses ``[B, 4, 4]``."""
        return self._shown(lambda seen: self.sensor.render(T_world_from_camera, seen), theta)

    def _shown(self, render: Callable[[Tensor], Rendered], theta: Tensor) -> Rendered:
        leaf = theta.detach().requires_grad_(True)
        with torch.enable_grad():
            seen = self.seen_theta(leaf)
        rendered = render(seen.detach())

        def vjp(gradient: Tensor) -> Tensor:
            (shown,) = torch.autograd.grad(seen, leaf, rendered.vjp(gradient), retain_graph=True)
            return shown

        return Rendered(rendered.images, vjp, rendered.nbytes)
