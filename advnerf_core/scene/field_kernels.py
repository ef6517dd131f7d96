"""CPU kernels of the scene field: its two small networks on tiles, forward and backward.

The density network runs on tiles of samples, the colour network on tiles of rays (it decodes accumulated features once per ray).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from advnerf_core.fields.mlp_kernels import TILE, add_outer, dense, dense_transposed
from advnerf_core.fields.spherical_harmonics import write_spherical_harmonics
from advnerf_core.parallel import KERNEL_OPTIONS
from advnerf_core.render.volume_kernels import squash_features

Array32 = NDArray[np.float32]

_f = np.float32
_ONE = np.float32(1.0)


@njit(**KERNEL_OPTIONS)
def density_network(
    w1: Array32, b1: Array32, w2: Array32, b2: Array32, x: Array32, y: Array32, first: int, stop: int
) -> None:
    """``two_layers`` whose outputs from the second on are squashed."""
    hidden = np.empty((w1.shape[0], TILE), np.float32)
    for tile in range(first, stop):
        dense(w1, b1, x[tile], hidden, True)
        dense(w2, b2, hidden, y[tile], False)
        squash_features(y[tile])


@njit(**KERNEL_OPTIONS)
def two_layers(
    w1: Array32, b1: Array32, w2: Array32, b2: Array32, x: Array32, y: Array32, first: int, stop: int
) -> None:
    """``y = w2 relu(w1 x + b1) + b2`` for tiles ``first..stop`` of ``x [tiles, K, TILE]`` and ``y [tiles, J, TILE]``."""
    hidden = np.empty((w1.shape[0], TILE), np.float32)
    for tile in range(first, stop):
        dense(w1, b1, x[tile], hidden, True)
        dense(w2, b2, hidden, y[tile], False)


@njit(**KERNEL_OPTIONS)
def two_layers_backward(
    w1: Array32, b1: Array32, w2: Array32, x: Array32, grad_y: Array32, first: int, stop: int,
    grad_w1: Array32, grad_b1: Array32, grad_w2: Array32, grad_b2: Array32,
) -> None:  # fmt: skip
    """Add the weight gradients of ``two_layers`` and replace ``x`` by its gradient, for tiles ``first..stop``."""
    w1_t, w2_t = np.ascontiguousarray(w1.T), np.ascontiguousarray(w2.T)
    hidden = np.empty((w1.shape[0], TILE), np.float32)
    grad_hidden = np.empty((w1.shape[0], TILE), np.float32)
    for tile in range(first, stop):
        dense(w1, b1, x[tile], hidden, True)
        add_outer(grad_y[tile], hidden, grad_w2, grad_b2)
        dense_transposed(w2_t, grad_y[tile], hidden, grad_hidden, True)
        add_outer(grad_hidden, x[tile], grad_w1, grad_b1)
        dense_transposed(w1_t, grad_hidden, hidden, x[tile], False)


@njit(**KERNEL_OPTIONS)
def complete_colour_inputs(
    inputs: Array32, rays: Array32, alpha: Array32, background: Array32, bands: int, first: int, stop: int
) -> None:
    """Complete accumulated features to colour network inputs: background where light comes through, then directions.

    Args:
        inputs: ``[ray tiles, K, TILE]``; rows ``0..C`` hold accumulated features, the rest is written.
        rays: ``[R, 6]``.
        alpha: ``[R]``.
        background: Features of the far background ``[C]``.
        bands: Bands of spherical harmonics.
        first: First ray.
        stop: One past the last ray.
    """
    channels, used = background.shape[0], background.shape[0] + bands * bands
    for r in range(first, stop):
        block, column = r // TILE, r % TILE
        for c in range(channels):
            inputs[block, c, column] += (_ONE - alpha[r]) * background[c]
        x, y, z = rays[r, 3], rays[r, 4], rays[r, 5]
        scale = _ONE / np.sqrt(x * x + y * y + z * z)
        write_spherical_harmonics(x * scale, y * scale, z * scale, bands, inputs[block], channels, column)
        for c in range(used, inputs.shape[1]):
            inputs[block, c, column] = _f(0.0)


@njit(**KERNEL_OPTIONS)
def colour_loss(
    raw: Array32, targets: NDArray[np.uint8], first: int, stop: int, huber: np.float32, scale: np.float32
) -> tuple[float, float]:
    """Squash network outputs, compare with pixels, and replace ``raw`` by the gradient of the loss.

    Args:
        raw: Network outputs ``[ray tiles, 4, TILE]``, overwritten; the fourth row is unused.
        targets: Pixels ``[R, 3]``.
        first: First ray.
        stop: One past the last ray.
        huber: Error at which the loss changes from square to linear.
        scale: Factor on the gradient: 1 / number of values.

    Returns:
        Sum of the Huber losses and sum of the squared errors.
    """
    loss, square = 0.0, 0.0
    for r in range(first, stop):
        block, column = r // TILE, r % TILE
        for c in range(3):
            value = _ONE / (_ONE + np.exp(-raw[block, c, column]))
            error = value - _f(targets[r, c]) * _f(1.0 / 255.0)
            size = abs(error)
            square += error * error
            loss += 0.5 * error * error if size <= huber else huber * (size - _f(0.5) * huber)
            slope = min(max(error, -huber), huber)
            raw[block, c, column] = slope * value * (_ONE - value) * scale
        raw[block, 3, column] = _f(0.0)
    return loss, square


@njit(**KERNEL_OPTIONS)
def matte_loss(
    raw: Array32, targets: NDArray[np.uint8], opacities: NDArray[np.uint8], behind: Array32, alpha: Array32,
    first: int, stop: int, huber: np.float32, scale: np.float32, grad_alpha: Array32,
) -> tuple[float, float]:  # fmt: skip
    """``colour_loss`` for transparent rays: field and pixel are compared before the same colour.

    Args:
        raw: Network outputs ``[ray tiles, 4, TILE]``, overwritten by the gradient; the fourth row is unused.
        targets: Pixels ``[R, 3]``, not premultiplied.
        opacities: Opacities of the pixels ``[R]``.
        behind: Colour behind both ``[R, 3]`` in 0..1.
        alpha: Opacity of the field ``[R]``.
        first: First ray.
        stop: One past the last ray.
        huber: Error at which the loss changes from square to linear.
        scale: Factor on the gradient: 1 / number of values.
        grad_alpha: ``[R]``, written: gradient to ``alpha`` where it mixes the two colours.

    Returns:
        Sum of the Huber losses and sum of the squared errors.
    """
    loss, square = 0.0, 0.0
    for r in range(first, stop):
        block, column = r // TILE, r % TILE
        opacity, total = _f(opacities[r]) * _f(1.0 / 255.0), _f(0.0)
        for c in range(3):
            value = _ONE / (_ONE + np.exp(-raw[block, c, column]))
            real = opacity * (_f(targets[r, c]) * _f(1.0 / 255.0)) + (_ONE - opacity) * behind[r, c]
            error = alpha[r] * value + (_ONE - alpha[r]) * behind[r, c] - real
            size = abs(error)
            square += error * error
            loss += 0.5 * error * error if size <= huber else huber * (size - _f(0.5) * huber)
            slope = min(max(error, -huber), huber) * scale
            total += slope * (value - behind[r, c])
            raw[block, c, column] = slope * alpha[r] * value * (_ONE - value)
        raw[block, 3, column] = _f(0.0)
        grad_alpha[r] = total
    return loss, square


@njit(**KERNEL_OPTIONS)
def exposed_loss(
    raw: Array32, targets: NDArray[np.uint8], opacities: NDArray[np.uint8], behind: Array32, alpha: Array32,
    gains: Array32, first: int, stop: int, huber: np.float32, scale: np.float32, grad_alpha: Array32,
    grad_log_gains: Array32,
) -> tuple[float, float]:  # fmt: skip
    """``matte_loss`` where the field's colours are first multiplied by the gain of each ray's photograph.

    A pixel at 255 only gives a lower bound of the light: a brighter colour has no error there.

    Args:
        raw: Network outputs ``[ray tiles, 4, TILE]``, overwritten by the gradient; the fourth row is unused.
        targets: Pixels ``[R, 3]``, not premultiplied.
        opacities: Opacities of the pixels ``[R]``; 255 for photographs without alpha.
        behind: Colour behind both ``[R, 3]`` in 0..1.
        alpha: Opacity of the field ``[R]``; 1 for a field with a learned background, whose colours include it.
        gains: Factors on the colours ``[R, 3]``.
        first: First ray.
        stop: One past the last ray.
        huber: Error at which the loss changes from square to linear.
        scale: Factor on the gradient: 1 / number of values.
        grad_alpha: ``[R]``, written: gradient to ``alpha`` where it mixes the two colours.
        grad_log_gains: ``[R, 3]``, written: gradient to the logarithms of the gains.

    Returns:
        Sum of the Huber losses and sum of the squared errors.
    """
    loss, square = 0.0, 0.0
    for r in range(first, stop):
        block, column = r // TILE, r % TILE
        opacity, total = _f(opacities[r]) * _f(1.0 / 255.0), _f(0.0)
        for c in range(3):
            value = _ONE / (_ONE + np.exp(-raw[block, c, column]))
            shown, target = gains[r, c] * value, _f(targets[r, c]) * _f(1.0 / 255.0)
            saturated = targets[r, c] == 255 and shown > _ONE
            shown = min(shown, _ONE) if saturated else shown
            real = opacity * target + (_ONE - opacity) * behind[r, c]
            error = alpha[r] * shown + (_ONE - alpha[r]) * behind[r, c] - real
            size = abs(error)
            square += error * error
            loss += 0.5 * error * error if size <= huber else huber * (size - _f(0.5) * huber)
            slope = min(max(error, -huber), huber) * scale
            total += slope * (shown - behind[r, c])
            to_log = _f(0.0) if saturated else slope * alpha[r] * shown
            grad_log_gains[r, c] = to_log
            raw[block, c, column] = to_log * (_ONE - value)
        raw[block, 3, column] = _f(0.0)
        grad_alpha[r] = total
    return loss, square


@njit(**KERNEL_OPTIONS)
def background_backward(
    grad_inputs: Array32, alpha: Array32, background: Array32, first: int, stop: int, grad_alpha: Array32,
    grad: Array32, pull: np.float32,
) -> None:  # fmt: skip
    """Gradients of ``complete_colour_inputs``: ``grad_alpha [R]`` written, less ``pull``; ``grad [C]`` of the background added to."""
    channels = background.shape[0]
    for r in range(first, stop):
        block, column = r // TILE, r % TILE
        total = _f(0.0)
        for c in range(channels):
            g = grad_inputs[block, c, column]
            total += g * background[c]
            grad[c] += g * (_ONE - alpha[r])
        grad_alpha[r] = -total - pull


@njit(**KERNEL_OPTIONS)
def adam(
    values: Array32, grad: Array32, mean: Array32, square: Array32, rate: np.float32, mean_scale: np.float32,
    square_scale: np.float32, skip_zero: bool,
) -> None:  # fmt: skip
    """One step of Adam (Kingma and Ba 2015) with beta 0.9 and 0.99 on flat arrays; clears ``grad``.

    Args:
        values: Parameters ``[N]``.
        grad: Gradient ``[N]``, set to zero.
        mean: First moment ``[N]``.
        square: Second moment ``[N]``.
        rate: Learning rate.
        mean_scale: Bias correction of the first moment.
        square_scale: Bias correction of the second moment.
        skip_zero: Leave entries with gradient zero unchanged, including moments: a hash entry without samples has not
            been measured (Müller et al. 2022, section 4).
    """
    tiny = _f(1e-15)
    for n in range(values.shape[0]):
        g = grad[n]
        if skip_zero and g == _f(0.0):
            continue
        grad[n] = _f(0.0)
        m = _f(0.9) * mean[n] + _f(0.1) * g
        v = _f(0.99) * square[n] + _f(0.01) * g * g
        mean[n], square[n] = m, v
        values[n] -= rate * (m * mean_scale) / (np.sqrt(v * square_scale) + tiny)
