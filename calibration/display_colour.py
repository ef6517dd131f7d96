"""Calibrates how the camera sees the monitor's colours, from the mean image colour of each shown colour.

The model is `advnerf_core.display.DisplayModel`; all of its numbers are fitted together by least squares on the seen colours, each channel's
curve as 17 rising levels. Exposure and white balance must be locked, the monitor's night light and dynamic contrast off.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import field_validator
from scipy.optimize import least_squares

from advnerf_core.display import DisplayModel
from advnerf_core.geometry import Array
from calibration.degeneracy import DegenerateDataError, PoorFitError, require_count
from calibration.schema import Calibration

LEVELS = 17
UNCHANGED = "exposure and white balance locked"
_SMOOTH = 0.002  # against a change of the curve's slope by a factor e from level to level
# Fewer colours are refused.
_MIN_COLOURS = 60
# Every camera channel must change by this much between black and white.
_LEAST_RANGE = 0.15
# Share of the mixed colours that is held out from the fit to judge it.
_HELD_OUT = 0.3
# A larger error on them is refused.
_MOST_RMSE = 0.03
# A colour is wrong if it is farther off than this, and the others fit better by this factor without it.
_ONE_WRONG, _MUCH_BETTER = 0.04, 2.5
_CHANNELS = ("red", "green", "blue")
# A larger change of repeated colours while measuring is refused.
_MOST_DRIFT = 0.03


class DisplayCalibration(Calibration):
    """A monitor in front of a camera.

    Attributes:
        model: Output of `DisplayModel.to_dict`.
        conditions: Conditions that must not change: light, exposure, monitor settings.
    """

    kind: Literal["display"] = "display"
    model: dict[str, Any]
    conditions: str = UNCHANGED

    @field_validator("model")
    @classmethod
    def _a_model(cls, model: dict[str, Any]) -> dict[str, Any]:
        DisplayModel.from_dict(model)
        return model

    @property
    def display(self) -> DisplayModel:
        """Return the colour model."""
        return DisplayModel.from_dict(self.model)


@dataclass(frozen=True, eq=False)
class DisplayFit:
    """A fitted monitor.

    Attributes:
        model: The model.
        shown: Colours in 0..1 ``[N, 3]``.
        seen: Camera means in 0..1 ``[N, 3]``.
        cos_angle: Cosine of the viewing angle of each ``[N]``.
        held_out: ``[N]`` bool: not fitted.
        drift: Largest change of a colour that was shown more than once.
    """

    model: DisplayModel
    shown: Array
    seen: Array
    cos_angle: Array
    held_out: NDArray[np.bool_]
    drift: float

    def rmse(self, held_out: bool) -> float:
        """Root mean square error of the seen colours, of full scale, on the held-out or on the fitted colours."""
        rows = self.held_out if held_out else ~self.held_out
        predicted = self.model.forward(self.shown[rows], self.cos_angle[rows])
        return float(np.sqrt(np.mean((predicted - self.seen[rows]) ** 2)))

    def calibration(self, conditions: str = UNCHANGED) -> DisplayCalibration:
        """Make the calibration."""
        residuals = {"held_out_rmse": self.rmse(True), "fitted_rmse": self.rmse(False), "drift": self.drift}
        model = self.model
        rounded = DisplayModel(
            np.round(model.curves, 8),
            np.round(model.mixing, 8),
            np.round(model.ambient, 8),
            round(model.response, 6),
            round(model.falloff, 6),
            np.round(model.products, 8),
        )
        return DisplayCalibration(
            date=datetime.date.today(),
            method="camera in the loop: ramps, primaries and mixed colours, least squares on the seen means",
            views=len(self.shown),
            residuals={key: round(value, 6) for key, value in residuals.items()},
            model=rounded.to_dict(),
            conditions=conditions,
        )


def colours_to_show(seed: int = 0) -> NDArray[np.uint8]:
    """Make the colour sequence ``[N, 3]``: black and white, grey and primary ramps, mixed colours, black and white again."""
    ramp = np.round(np.linspace(0, 255, LEVELS)).astype(np.uint8)
    ends = np.array([[0, 0, 0], [255, 255, 255]], np.uint8)
    grey = np.repeat(ramp[1:-1, None], 3, axis=1)
    primaries = np.concatenate([ramp[1::2, None] * np.eye(3, dtype=np.uint8)[c] for c in range(3)])
    random = np.random.default_rng(seed).integers(0, 256, (48, 3)).astype(np.uint8)
    return np.concatenate([ends, grey, primaries, random, ends])


def screen_region(black: NDArray[np.uint8], white: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels ``[H, W]`` well inside the lit screen, from pictures ``[H, W, 3]`` of it black and white."""
    change = (white.astype(np.float64) - black.astype(np.float64)).mean(axis=2)
    top = float(np.percentile(change, 99.9))
    if top < 20.0:
        raise DegenerateDataError(
            f"expected a screen that brightens the image by 20 of 255 or more from black to white, got {top:.0f}; is it on, full screen, in view?"
        )
    lit = (change > 0.6 * top).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(lit, connectivity=4)
    if count < 2:
        raise DegenerateDataError("expected one lit screen in view, got none; point the camera at the screen")
    largest = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    inside = cv2.erode((labels == largest).astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=0) > 0
    if inside.sum() < 50:
        raise DegenerateDataError(
            f"expected a screen of some hundred pixels in the picture, got {int(inside.sum())} after its border was left out; go nearer"
        )
    return inside


def mean_colour(frames: Sequence[NDArray[np.uint8]], region: NDArray[np.bool_]) -> Array:
    """Mean colour ``[3]`` in 0..1 of a region over frames ``[H, W, 3]``."""
    return np.asarray(np.mean([frame[region].mean(axis=0) for frame in frames], axis=0) / 255.0, np.float64)


def fit_display(
    shown: Array,
    seen: Array,
    cos_angle: Array | float = 1.0,
    least_free: float = 0.6,
    inks: bool = False,
) -> DisplayFit:
    """Fit a monitor, or a printer.

    Args:
        shown: Colours in 0..1 ``[N, 3]``.
        seen: Camera means of them in 0..1 ``[N, 3]``.
        cos_angle: Cosine of the viewing angle of each, or of all; with a spread of it the falloff is fitted too.
        least_free: Smallest share of colours without a saturated channel.
        inks: Fit the products of channels too, as a printer's inks filter each other's light.

    Raises:
        DegenerateDataError: Too few colours, too many saturated, no change from black to white, a drift.
        PoorFitError: The held-out colours are predicted badly.
    """
    shown, seen = np.asarray(shown, np.float64), np.asarray(seen, np.float64)
    angles = np.broadcast_to(np.asarray(cos_angle, np.float64), (len(shown),)).copy()
    if shown.shape != seen.shape or shown.shape[1:] != (3,):
        raise DegenerateDataError(
            f"expected one seen for every shown colour, got {seen.shape} and {shown.shape}"
        )
    if (wrong := angles[~((angles > 0.0) & (angles <= 1.0))]).size:
        raise DegenerateDataError(
            f"expected a cos_angle above 0 and up to 1, of a camera before the screen, got {wrong[0]:g}; if it is an angle, write its cosine"
        )
    require_count(
        len(shown), _MIN_COLOURS, "colours", "show the whole sequence: ramps, primaries, mixed colours"
    )
    drift = _require_usable(shown, seen, angles, least_free)
    held_out = _choose_held_out(shown)
    fitted = ~held_out
    model = _fit(shown[fitted], seen[fitted], angles[fitted], inks)
    fit = DisplayFit(model, shown, seen, angles, held_out, drift)
    _refuse_one_wrong(fit, inks)
    if fit.rmse(True) > _MOST_RMSE:
        raise PoorFitError(
            f"expected held-out colours within {100 * _MOST_RMSE:.1f} %, got {100 * fit.rmse(True):.1f} %: are exposure and white balance locked, "
            "night light, dynamic contrast and local dimming off, and was every colour shown long enough?"
        )
    _refuse_exchanged(fit)
    return fit


def _refuse_exchanged(fit: DisplayFit) -> None:
    """Refuse pictures whose channels are in another order than those of the shown colours.

    Raises:
        PoorFitError: Each channel of the camera sees another one of the display most.
    """
    sees = [int(channel) for channel in np.abs(fit.model.mixing).argmax(axis=1)]
    if sorted(sees) == [0, 1, 2] != sees:
        pairs = ", ".join(
            f"{_CHANNELS[shown]} as {_CHANNELS[seen]}" for seen, shown in enumerate(sees) if seen != shown
        )
        raise PoorFitError(
            f"expected pictures in which each shown colour is seen as itself, got {pairs}: save the pictures as RGB, not BGR, and show the colours of "
            "this sequence"
        )


def _refuse_one_wrong(fit: DisplayFit, inks: bool) -> None:
    """Refuse a colour without which all others fit much better: a picture that was taken before the screen changed bends the model for other colours too.

    Raises:
        PoorFitError: A colour is wrong.
    """
    errors = np.abs(fit.model.forward(fit.shown, fit.cos_angle) - fit.seen).max(axis=1)
    worst = int(errors.argmax())
    if errors[worst] < _ONE_WRONG:
        return
    others = np.arange(len(errors)) != worst
    rows = others & ~fit.held_out
    model = _fit(fit.shown[rows], fit.seen[rows], fit.cos_angle[rows], inks)
    after = np.abs(model.forward(fit.shown, fit.cos_angle) - fit.seen).max(axis=1)
    without, with_it = (float(np.sqrt(np.mean(each**2))) for each in (after[others], errors))
    if _MUCH_BETTER * without < with_it:
        raise PoorFitError(
            f"expected a picture of every colour that was shown, got one of colour {worst}, counted from 0, that is {100 * after[worst]:.0f} % off where "
            f"the others, which fit to {100 * without:.1f} %, put it: was it taken before the screen changed? Take it again"
        )


def _require_usable(shown: Array, seen: Array, angles: Array, least_free: float) -> float:
    free = ((seen > 0.01) & (seen < 0.98)).all(axis=1)
    if free.mean() < least_free:
        over = float((seen >= 0.98).any(axis=1).mean())
        cure = (
            "shorten the exposure or dim the monitor"
            if over > 0.5 * (1.0 - free.mean())
            else "lengthen the exposure"
        )
        raise DegenerateDataError(
            f"expected at least {100 * least_free:.0f} % of the colours without a saturated channel, got {100 * free.mean():.0f} %: {cure}"
        )
    spread = np.ptp(seen, axis=0)
    if spread.min() < _LEAST_RANGE:
        raise DegenerateDataError(
            f"expected every camera channel to change by {_LEAST_RANGE} or more over the colours, got {np.round(spread, 3).tolist()}: is this the screen?"
        )
    if (
        len(np.unique(np.round(shown, 3), axis=0)) < _MIN_COLOURS
        or np.linalg.matrix_rank(shown - shown.mean(axis=0), tol=0.5) < 3
    ):
        raise DegenerateDataError(
            "expected colours that differ in all three channels, got a line or a plane of them, such as greys only"
        )
    drift = 0.0
    keys = np.round(np.concatenate([shown, angles[:, None]], axis=1), 4)
    for key in np.unique(keys, axis=0):
        same = seen[(keys == key).all(axis=1)]
        drift = max(drift, float(np.ptp(same, axis=0).max()))
    if drift > _MOST_DRIFT:
        raise DegenerateDataError(
            f"expected the same colour to look the same at the start and at the end within {_MOST_DRIFT}, got {drift:.3f}: lock exposure and white "
            "balance, let the monitor warm up, keep the room's light constant"
        )
    return drift


def _choose_held_out(shown: Array) -> NDArray[np.bool_]:
    """Select held-out colours among the mixed ones. The fit needs the ramps and primaries."""
    mixed = (np.ptp(shown, axis=1) > 1e-6) & ((shown > 1e-6).sum(axis=1) == 3)
    rows = np.flatnonzero(mixed)
    held_out: NDArray[np.bool_] = np.zeros(len(shown), np.bool_)
    if len(rows):
        every = max(2, round(1.0 / _HELD_OUT))
        held_out[rows[::every]] = True
    if held_out.sum() < 8:
        raise DegenerateDataError(
            f"expected at least {8 * max(2, round(1.0 / _HELD_OUT))} mixed colours, got {len(rows)}: show random colours too"
        )
    return held_out


def _fit(shown: Array, seen: Array, angles: Array, inks: bool) -> DisplayModel:
    with_falloff = bool(np.ptp(angles) >= 0.1)
    steps = LEVELS - 1
    start_curve = np.log(np.diff(np.linspace(0.0, 1.0, LEVELS) ** 2.2) + 1e-4)
    response = 2.2
    light = np.maximum(seen, 0.0) ** response
    rows = np.concatenate([shown**2.2, np.ones((len(shown), 1))], axis=1)
    linear = np.linalg.lstsq(rows, light, rcond=None)[0]
    start = np.concatenate(
        [
            np.tile(start_curve, 3),
            linear[:3].T.ravel(),
            np.sqrt(np.maximum(linear[3], 1e-4)),
            [np.log(response)],
            [0.5] if with_falloff else [],
            np.zeros(12 if inks else 0),
        ]
    )

    def residuals(p: Array) -> Array:
        bends = np.diff(p[: 3 * steps].reshape(3, steps), n=2, axis=1).ravel()
        error = _unpack(p, with_falloff).forward(shown, angles) - seen
        return np.concatenate([error.ravel(), _SMOOTH * bends])

    lower, upper = np.full(len(start), -np.inf), np.full(len(start), np.inf)
    lower[: 3 * steps], upper[: 3 * steps] = -12.0, 3.0
    at = 3 * steps + 12
    lower[at], upper[at] = np.log(0.4), np.log(4.0)
    if with_falloff:
        lower[at + 1], upper[at + 1] = 0.0, 8.0
    found = least_squares(
        residuals, np.clip(start, lower + 1e-9, upper - 1e-9), bounds=(lower, upper), max_nfev=60
    )
    return _unpack(found.x, with_falloff)


def _unpack(p: Array, with_falloff: bool) -> DisplayModel:
    steps = LEVELS - 1
    rise = np.exp(p[: 3 * steps].reshape(3, steps))
    curves = np.concatenate([np.zeros((3, 1)), np.cumsum(rise, axis=1)], axis=1)
    total = curves[:, -1:]
    curves = curves / total
    curves[:, -1] = 1.0
    at = 3 * steps
    # The mixing takes the normalisation of the curves; that keeps the search's directions apart.
    return DisplayModel(
        curves,
        p[at : at + 9].reshape(3, 3),
        p[at + 9 : at + 12] ** 2,
        float(np.exp(p[at + 12])),
        float(p[at + 13]) if with_falloff else 0.0,
        p[-12:].reshape(3, 4) if len(p) > at + 13 + with_falloff else np.zeros((3, 4)),
    )
