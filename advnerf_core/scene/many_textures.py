"""Several textures of the same objects rendered in one batch, so that the searches of several seeds run together.

The background, the geometry and the policy do not depend on the texture, so the frames of K searches are one batch: the
scene is rendered and the objects are cast for all of them at once, and only the last step, weights times colours, is done by texture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from advnerf_core.geometry import Array
from advnerf_core.scene.surrogate import PoseBatch, Rendered, Surrogate, split_theta


@dataclass(frozen=True, eq=False)
class _Share:
    """The part of a batch for one texture: rows of one object's weights, and their pixels."""

    rows: NDArray[np.int64]
    pixels: Tensor


@runtime_checkable
class ShowsMany(Protocol):
    """A sensor with its own support for several textures at once."""

    def many(self, count: int, starts: int) -> Any:
        """The sensor for ``count`` textures at once, each from ``starts`` starts; frames and theta as in `ManyTextures`."""


class ManyTextures:
    """A surrogate that shows ``count`` textures at once; a drop-in for it in an attack problem.

    Frames come ordered by tick, then by texture, then by start: image ``i`` of a batch shows texture
    ``(i // starts) % count``. Its ``theta`` is the textures stacked, ``[count, *surrogate.theta_shape]``.

    Args:
        surrogate: The scene with its objects.
        starts: Number of start poses of each.
    """

    def __init__(self, surrogate: Surrogate, count: int, starts: int) -> None:
        if count < 1 or starts < 1:
            raise ValueError(f"expected at least one texture and one start, got {count} and {starts}")
        self._surrogate, self.count, self.starts = surrogate, count, starts

    @property
    def theta_shape(self) -> tuple[int, ...]:
        """``(count, *surrogate.theta_shape)``."""
        return (self.count, *self._surrogate.theta_shape)

    def initial_theta(self, generator: torch.Generator) -> Tensor:
        """``count`` starts drawn one after the other from one generator."""
        return torch.stack([self._surrogate.initial_theta(generator) for _ in range(self.count)])

    def camera_poses(self, states: Tensor) -> Array:
        """``T_world_from_camera [B, 4, 4]`` at car states ``[B, n]``, detached."""
        return self._surrogate.camera_poses(states)

    def sense(self, states: Tensor, theta: Tensor) -> Rendered:
        """Images of the cameras from states ``[ticks * count * starts, n]``."""
        return self.render(self.camera_poses(states), theta)

    def render(self, T_world_from_camera: ArrayLike, theta: Tensor) -> Rendered:
        """Images at camera poses ``[ticks * count * starts, 4, 4]`` with their vjp to the stacked textures."""
        poses = np.asarray(T_world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
        if theta.shape != self.theta_shape or len(poses) % (self.count * self.starts):
            raise ValueError(
                f"expected theta {list(self.theta_shape)} and poses in multiples of {self.count * self.starts}, "
                f"got {list(theta.shape)} and {len(poses)}"
            )
        return self._shown(self._surrogate.prepare(poses), theta.detach())

    def _shown(self, frames: PoseBatch, theta: Tensor) -> Rendered:
        image = frames.background.numpy().copy()
        shares = [self._shares(pixels, frames.background.shape) for pixels in frames.pixels]
        values: list[list[Tensor]] = []
        for k in range(self.count):
            parts = split_theta([seen.field for seen in frames.seen], theta[k])
            values.append(
                [
                    seen.values(part.to(frames.background.dtype))
                    for seen, part in zip(frames.seen, parts, strict=True)
                ]
            )
            for seen, W, share, value in zip(frames.seen, frames.weights, shares, values[k], strict=True):
                rows, pixels = W.take(share[k].rows), share[k].pixels.numpy()
                rows.add_product(seen.colours(value).numpy(), pixels, image.reshape(-1, 3))
        images = torch.from_numpy(np.ascontiguousarray(image.transpose(0, 3, 1, 2)))
        kept = sum(value.nbytes for each in values for value in each) + sum(
            seen.nbytes for seen in frames.seen
        )
        own = sum(share.rows.nbytes + share.pixels.nbytes for each in shares for share in each)
        nbytes = int(images.nbytes + kept + own + frames.weights_nbytes)
        return Rendered(images, _vjp(frames, shares, values, theta), nbytes)

    def _shares(self, pixels: Tensor, shape: Sequence[int]) -> list[_Share]:
        """Assign an object's pixels to textures."""
        flat = pixels.numpy()
        texture = (flat // (shape[1] * shape[2]) // self.starts) % self.count
        rows = [np.flatnonzero(texture == k) for k in range(self.count)]
        return [_Share(each, pixels[torch.from_numpy(each)]) for each in rows]


def _vjp(
    frames: PoseBatch, shares: Sequence[Sequence[_Share]], values: Sequence[Sequence[Tensor]], theta: Tensor
) -> Callable[[Tensor], Tensor]:
    # Only these names are kept alive: the background is not, nor are the textures.
    weights, seen, dtype, shape = frames.weights, frames.seen, theta.dtype, theta.shape

    def vjp(grad_images: Tensor) -> Tensor:
        flat = grad_images.detach().permute(0, 2, 3, 1).reshape(-1, 3)
        gradient = []
        for k in range(shape[0]):
            rows = [
                here.gradient(
                    value,
                    torch.from_numpy(W.take(share[k].rows).transposed_product(flat[share[k].pixels].numpy())),
                )
                for here, value, W, share in zip(seen, values[k], weights, shares, strict=True)
            ]
            gradient.append(torch.cat(rows).to(dtype) if rows else torch.zeros(0, 3, dtype=dtype))
        return torch.stack(gradient).reshape(shape)

    return vjp
