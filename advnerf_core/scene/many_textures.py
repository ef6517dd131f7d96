"""Several textures of the same objects rendered in one batch, so that the searches of several seeds run together.

The background, the geometry and the policy do not depend on the texture, so the frames of K searches are one batch: the
scene is rendered and the objects are cast for all of them at once, and only the last step, weights times colours, is done by texture.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from advnerf_core.geometry import Array
from advnerf_core.scene.surrogate import PoseBatch, Rendered, Surrogate


class ManyTextures:
    """A surrogate that shows ``count`` textures at once; a drop-in for it in an attack problem.

    Frames come ordered by tick, then by texture, then by start: image ``i`` of a batch shows texture
    ``(i // starts) % count``. Its ``theta`` is the textures stacked, ``[count, *surrogate.theta_shape]``.
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
        count, height, width, _ = frames.background.shape
        texture = np.arange(count) // self.starts % self.count
        chosen = [np.flatnonzero(texture == k) for k in range(self.count)]
        parts = [frames.only(some).render(theta[k]) for k, some in enumerate(chosen)]
        images = torch.empty(count, 3, height, width, dtype=frames.background.dtype)
        for some, part in zip(chosen, parts, strict=True):
            images[some] = part.images
        nbytes = images.nbytes + sum(part.nbytes - part.images.nbytes for part in parts)
        # Only these names are kept alive: the images of the parts are not, nor are the textures.
        vjps, shape = [part.vjp for part in parts], theta.shape

        def vjp(grad_images: Tensor) -> Tensor:
            rows = [part(grad_images[some]) for some, part in zip(chosen, vjps, strict=True)]
            return torch.stack(rows).reshape(shape)

        return Rendered(images, vjp, nbytes)
