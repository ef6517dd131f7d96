"""Seen colours of a monitor's shown colours, or of a printer's, and the inverse: colours to show for given seen ones. Numpy only.

``seen = (ambient + cos(angle)^falloff  M curve(shown)) ^ (1 / response)``: each channel of the monitor has its own monotone curve (its gamma), the
camera mixes the channels' light by ``M``, the room reflects in the glass, the panel dims to the side, and the camera's response is a
power. The inks of a printer filter each other's light: products of the channels' light are added, ``M c + P products(c)``, which is the
Neugebauer equation of three inks under the Yule-Nielsen power. All colours are in 0..1. `advnerf_core.attack.spaces.displayed` is the same in
torch, with gradients.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Array
from advnerf_core.plain import Numbers, PlainData

# Below this the camera's power has no finite slope.
DARKEST = 1e-6
_LEAST_DETERMINANT = 1e-3
# Red with green, green with blue, red with blue, all three.
PAIRS = ((0, 1), (1, 2), (0, 2))
_NEWTON_STEPS = 30
# A colour counts as shown if it is seen nearer than this to the wanted one: less is within the error of a fit.
_VISIBLE = 0.01


class DisplayModelError(AdvnerfError, ValueError):
    """The numbers do not describe a display."""


@dataclass(frozen=True, eq=False)
class DisplayModel(PlainData):
    """A monitor, or a print, before a camera.

    Attributes:
        curves: Light of each channel at evenly spread levels ``[3, K]``, from 0 to 1, increasing.
        mixing: ``M`` ``[3, 3]``: rows are the camera's channels, columns the monitor's; light at full drive, seen straight on.
        ambient: Reflected light by camera channel ``[3]``.
        response: Power of the camera.
        falloff: Power of the cosine of the angle to the panel's normal.
        products: ``P`` ``[3, 4]``: light by camera channel of two or three channels together, see `products_of`; 0 for a monitor.
    """

    _refusal = DisplayModelError
    curves: Numbers
    mixing: Numbers
    ambient: Numbers
    response: float = 1.0
    falloff: float = 0.0
    products: Numbers = field(default_factory=lambda: np.zeros((3, 4)))

    def __post_init__(self) -> None:
        curves, mixing, ambient, products = (
            np.array(v, np.float64) for v in (self.curves, self.mixing, self.ambient, self.products)
        )
        if (
            curves.ndim != 2
            or curves.shape[0] != 3
            or curves.shape[1] < 2
            or mixing.shape != (3, 3)
            or ambient.shape != (3,)
            or products.shape != (3, 4)
        ):
            raise DisplayModelError(
                f"expected curves [3, K >= 2], mixing [3, 3], ambient [3] and products [3, 4], got {curves.shape}, {mixing.shape}, "
                f"{ambient.shape} and {products.shape}"
            )
        everything = np.concatenate(
            [curves.ravel(), mixing.ravel(), ambient, products.ravel(), [self.response, self.falloff]]
        )
        if (
            not np.isfinite(everything).all()
            or ambient.min() < 0.0
            or self.response <= 0.0
            or self.falloff < 0.0
        ):
            raise DisplayModelError(
                "expected finite numbers, ambient light and falloff >= 0 and a response > 0"
            )
        ends = np.abs(curves[:, [0, -1]] - [0.0, 1.0]).max()
        if (np.diff(curves, axis=1) <= 0.0).any() or ends > 1e-9:
            raise DisplayModelError("expected curves that rise from 0 to 1")
        if abs(np.linalg.det(mixing)) < _LEAST_DETERMINANT * max(float(np.abs(mixing).max()), 1e-12) ** 3:
            raise DisplayModelError(
                "expected a mixing matrix that can be inverted, got channels that look alike to the camera"
            )
        for name, value in (
            ("curves", curves),
            ("mixing", mixing),
            ("ambient", ambient),
            ("products", products),
        ):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @classmethod
    def ideal(cls) -> DisplayModel:
        """A monitor whose colours the camera sees unchanged."""
        return cls(np.tile([0.0, 1.0], (3, 1)), np.eye(3), np.zeros(3))

    def light(self, shown: ArrayLike) -> Array:
        """Light of the monitor's channels ``[..., 3]`` at shown colours ``[..., 3]``."""
        colours = np.asarray(shown, np.float64)
        levels = np.linspace(0.0, 1.0, self.curves.shape[1])
        return np.stack([np.interp(colours[..., c], levels, self.curves[c]) for c in range(3)], axis=-1)

    def forward(self, shown: ArrayLike, cos_angle: ArrayLike = 1.0) -> Array:
        """Seen colours ``[..., 3]`` of shown colours ``[..., 3]``.

        Args:
            shown: Colours in 0..1; values outside are clipped.
            cos_angle: Cosine of the angle between the panel's normal and the direction to the camera ``[...]``.
        """
        gain = np.asarray(cos_angle, np.float64)[..., None] ** self.falloff
        light = self.ambient + gain * self._mixed(self.light(shown))
        return np.clip(np.maximum(light, DARKEST) ** (1.0 / self.response), 0.0, 1.0)

    def _mixed(self, light: Array) -> Array:
        return np.asarray(light @ self.mixing.T + products_of(light) @ self.products.T)

    def inverse(self, wanted: ArrayLike, cos_angle: ArrayLike = 1.0) -> tuple[Array, float]:
        """Colours to show so that the camera sees wanted colours.

        Args:
            wanted: Colours ``[..., 3]`` in 0..1.
            cos_angle: Cosine of the viewing angle ``[...]``, see :meth:`forward`.

        Returns:
            Colours ``[..., 3]`` in 0..1, and the share of them that the monitor cannot show: they were clipped channel by channel, and are seen
            more than 0.01 away from the wanted ones.
        """
        target = np.clip(np.asarray(wanted, np.float64), 0.0, 1.0) ** self.response - self.ambient
        gain = np.asarray(cos_angle, np.float64)[..., None] ** self.falloff
        light = (target / gain) @ np.linalg.inv(self.mixing).T
        if self.products.any():
            light = self._solved(target / gain, np.clip(light, 0.0, 1.0))
        levels = np.linspace(0.0, 1.0, self.curves.shape[1])
        shown = np.stack([np.interp(light[..., c], self.curves[c], levels) for c in range(3)], axis=-1)
        missed = np.abs(self.forward(shown, cos_angle) - np.clip(wanted, 0.0, 1.0)).max(axis=-1) > _VISIBLE
        return shown, float(np.mean(missed)) if missed.size else 0.0

    def _solved(self, target: Array, light: Array) -> Array:
        """Light ``[..., 3]`` in 0..1 whose mixture is nearly the target, by Newton's method within these bounds."""
        for _ in range(_NEWTON_STEPS):
            slopes = self.mixing + np.einsum("kp,...pc->...kc", self.products, _slopes_of(light))
            regular = slopes + 1e-9 * np.eye(3)
            step = np.linalg.solve(regular, (target - self._mixed(light))[..., None])[..., 0]
            light = np.clip(light + np.clip(step, -0.3, 0.3), 0.0, 1.0)
        return light


def products_of(light: Array) -> Array:
    """Products ``[..., 4]`` of the channels' light ``[..., 3]``: red green, green blue, red blue, and all three."""
    pairs = [light[..., a] * light[..., b] for a, b in PAIRS]
    return np.stack([*pairs, light[..., 0] * light[..., 1] * light[..., 2]], axis=-1)


def _slopes_of(light: Array) -> Array:
    """Derivatives ``[..., 4, 3]`` of `products_of`."""
    r, g, b = np.moveaxis(light, -1, 0)
    zero = np.zeros_like(r)
    rows = [(g, r, zero), (zero, b, g), (b, zero, r), (g * b, r * b, r * g)]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
