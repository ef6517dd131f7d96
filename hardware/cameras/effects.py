"""Imperfections of a real camera: lens, moving exposure, noise, compression, lost frames.

A picture is composed of ideal ones drawn along the camera's motion while its rows were exposed. Light adds up
linearly, so blur, gain and noise act on linear values, converted by sRGB's curve (IEC 61966-2-1).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from advnerf_core.errors import ConfigError
from advnerf_core.geometry import Array, Pinhole
from advnerf_core.srgb import to_display, to_linear
from advnerf_core.strict import StrictModel
from advnerf_core.undistortion import ray_slopes

Rgb = NDArray[np.uint8]
_Linear = NDArray[np.float32]
Draw = Callable[[Array], Rgb]
"""The ideal picture ``[H, W, 3]`` from a car state ``[3]``: x [m], y [m], yaw [rad]."""

_NotNegative = Annotated[float, Field(ge=0.0)]
_Share = Annotated[float, Field(ge=0.0, lt=1.0)]
# Points in time at which the exposure of a row is sampled.
_SAMPLES = 16


class CameraEffects(StrictModel):
    """A camera's imperfections; without any, pictures pass through unchanged.

    Attributes:
        exposure_s: Time for which each row collects light [s].
        readout_s: Time from the first row's readout to the last one's: a rolling shutter [s].
        gain_sigma: Spread of the logarithm of a drive's exposure.
        colour_sigma: Spread of the logarithm of a drive's gain of red and of blue: its white balance.
        read_noise: Standard deviation of the noise of a dark pixel, of full scale 1.
        shot_noise: Variance of the additional noise of a pixel at full scale; it grows linearly with the light (EMVA 1288, linear model).
        k1: Radial distortion left by calibration, OpenCV's first coefficient.
        k2: OpenCV's second radial coefficient.
        jpeg_quality: Quality of JPEG compression, 1 to 100; None for none.
        lost: Share of frames that never arrive.
        seed: Seed of all draws.
        moments: Pictures that are drawn of each frame of a moving car, from the first row's light to the last one's. Between two of them
            the scene is assumed to fade from one to the next. Each costs a live lab as much as an ideal frame.
    """

    exposure_s: _NotNegative = 0.0
    readout_s: _NotNegative = 0.0
    gain_sigma: _NotNegative = 0.0
    colour_sigma: _NotNegative = 0.0
    read_noise: _NotNegative = 0.0
    shot_noise: _NotNegative = 0.0
    k1: float = 0.0
    k2: float = 0.0
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] | None = None
    lost: _Share = 0.0
    seed: int = 0
    moments: Annotated[int, Field(ge=2, le=33)] = 5

    @property
    def ideal(self) -> bool:
        """Whether all effects are off."""
        return self == CameraEffects(seed=self.seed, moments=self.moments)


# Typical values, not measured on one camera. A ZED 2 reads 720 rows in 22 ms at 30 Hz, if its exposure register counts rows (1,100 in a
# frame); a webcam is taken to read during its whole frame. Exposure as in a room; MJPG over USB 2.
PRESETS: Mapping[str, CameraEffects] = MappingProxyType(
    {
        "ideal": CameraEffects(),
        "webcam": CameraEffects(
            exposure_s=0.016,
            readout_s=0.033,
            gain_sigma=0.10,
            colour_sigma=0.05,
            read_noise=0.006,
            shot_noise=2.5e-4,
            k1=-0.02,
            k2=0.005,
            jpeg_quality=80,
            lost=0.01,
        ),
        "zed": CameraEffects(
            exposure_s=0.008,
            readout_s=0.022,
            gain_sigma=0.05,
            colour_sigma=0.02,
            read_noise=0.003,
            shot_noise=1.2e-4,
            k1=-0.004,
            lost=0.01,
        ),
    }
)


def _preset(given: object) -> object:
    if not isinstance(given, str):
        return given
    if given not in PRESETS:
        raise ValueError(f"expected one of {', '.join(PRESETS)}, or the effects themselves, got {given!r}")
    return PRESETS[given]


Effects = Annotated[CameraEffects, BeforeValidator(_preset)]
"""A preset's name, or `CameraEffects`, in a configuration."""


@dataclass
class ImperfectCamera:
    """A camera on one drive.

    Args:
        drive: Number of the drive; equal numbers give the same draws.
    """

    effects: CameraEffects
    pinhole: Pinhole
    drive: int = 0
    _tick: int = field(default=0, init=False)
    _before: Array | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        e, normal = self.effects, self._generator(0).standard_normal(3)
        tint = e.colour_sigma * np.array([normal[1], 0.0, normal[2]])
        self._gain: _Linear = np.exp(e.gain_sigma * normal[0] + tint).astype(np.float32)
        self._maps = _distortion(self.pinhole, e.k1, e.k2) if e.k1 or e.k2 else None

    def see(self, draw: Draw, state: Array, dt_s: float) -> Rgb | None:
        """The picture ``[H, W, 3]`` of a tick, None if it is lost; the first one never is. Call it once for each tick, in order.

        Args:
            state: Current state of the car ``[3]``; the exposure of the last row ends there.
            dt_s: Time since the call before [s].
        """
        now = np.array(state[:3], dtype=np.float64)
        before = now if self._before is None else self._before
        self._before, self._tick = now, self._tick + 1
        if self.effects.ideal:
            return draw(now)
        generator = self._generator(self._tick)
        if generator.random() < self.effects.lost and self._tick > 1:
            return None
        light = self._noisy(self._exposed(draw, before, now, dt_s) * self._gain, generator)
        return self._compressed(_encoded(light))

    def _exposed(self, draw: Draw, before: Array, now: Array, dt_s: float) -> _Linear:
        """Light ``[H, W, 3]`` that each row collected while the car moved from ``before`` to ``now``."""
        span_s = self.effects.exposure_s + self.effects.readout_s
        change = now - before
        change[2] = np.arctan2(np.sin(change[2]), np.cos(change[2]))
        if span_s == 0.0 or dt_s <= 0.0 or not change.any():
            return self._lens(_decoded(draw(now)))
        back = change * (span_s / dt_s)  # over the whole span, at the speed since the last tick
        times = np.linspace(-1.0, 0.0, self.effects.moments)
        drawn = [self._lens(_decoded(draw(now + back * time))) for time in times]
        weights = _row_weights(self.pinhole.height, self.effects)
        light = np.zeros_like(drawn[0])
        for picture, share in zip(drawn, weights.T, strict=True):
            light += share[:, None, None] * picture
        return light

    def _lens(self, picture: _Linear) -> _Linear:
        if self._maps is None:
            return picture
        return np.asarray(
            cv2.remap(picture, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
        )

    def _noisy(self, light: _Linear, generator: np.random.Generator) -> _Linear:
        e = self.effects
        if not (e.read_noise or e.shot_noise):
            return light
        sigma = np.sqrt(e.read_noise**2 + e.shot_noise * np.clip(light, 0.0, 1.0))
        return light + sigma * generator.standard_normal(light.shape, dtype=np.float32)

    def _compressed(self, picture: Rgb) -> Rgb:
        if self.effects.jpeg_quality is None:
            return picture
        quality = [cv2.IMWRITE_JPEG_QUALITY, self.effects.jpeg_quality]
        _, data = cv2.imencode(".jpg", picture[..., ::-1], quality)
        decoded = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
        return np.ascontiguousarray(decoded[..., ::-1])

    def _generator(self, tick: int) -> np.random.Generator:
        return np.random.default_rng([self.effects.seed, self.drive, tick])


def _row_weights(rows: int, effects: CameraEffects) -> Array:
    """Share of each moment in the light of each row ``[rows, moments]``; each row sums to one.

    Row r ends its exposure ``readout (rows - 1 - r) / (rows - 1)`` before the last row does.
    """
    span_s, last = effects.exposure_s + effects.readout_s, effects.moments - 1
    ends_s = -effects.readout_s * (rows - 1 - np.arange(rows)) / max(1, rows - 1)
    inside = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 1.0
    times = (ends_s[:, None] + effects.exposure_s * inside) / span_s  # -1 is the first moment, 0 the last
    places = np.clip((times + 1.0) * last, 0.0, last)
    hats = np.maximum(0.0, 1.0 - np.abs(places[..., None] - np.arange(effects.moments)))
    return np.asarray(hats.mean(axis=1), np.float64)


def _distortion(pinhole: Pinhole, k1: float, k2: float) -> tuple[_Linear, _Linear]:
    """Position of each pixel of the distorted picture in the ideal one [px]."""
    K = np.array([[pinhole.fx, 0.0, pinhole.cx], [0.0, pinhole.fy, pinhole.cy], [0.0, 0.0, 1.0]])
    # OpenCV's pixel centres are at whole numbers, a pinhole's at halves.
    K[:2, 2] -= 0.5
    columns, rows = np.meshgrid(np.arange(pinhole.width), np.arange(pinhole.height))
    points = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    slopes = ray_slopes(points, K, (k1, k2, 0.0, 0.0, 0.0))
    if not np.isfinite(slopes).all():
        raise ConfigError(
            f"expected k1 and k2 of a lens that draws the whole picture, got {k1:g} and {k2:g}, which fold it over itself; make them smaller"
        )
    ideal = slopes @ K[:2, :2].T + K[:2, 2]
    where = ideal.reshape(pinhole.height, pinhole.width, 2).astype(np.float32)
    return where[..., 0], where[..., 1]


def _decoded(picture: Rgb) -> _Linear:
    return _LINEAR[picture]


def _encoded(light: _Linear) -> Rgb:
    return np.rint(255.0 * to_display(np.clip(light, 0.0, 1.0))).astype(np.uint8)


_LINEAR: _Linear = to_linear(np.arange(256) / 255.0).astype(np.float32)
