"""The differentiable surrogate of a deployment scene: learned background, cast objects, depth-ordered composition.

``render(poses, theta)`` gives images and their vector-Jacobian product with respect to ``theta``, the squash-inverse colours of
the objects. Scene, geometry and camera poses are frozen, so the images are linear in the squashed colours and the background
never needs a gradient: what the forward pass computed is all that the backward pass of the same frames reads.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy import sparse
from torch import Tensor

from advnerf_core.fields.voxel_grid import INITIAL_NOISE, VoxelGridObject, squash_derivative
from advnerf_core.geometry import Array, Pinhole, planar_poses
from advnerf_core.render.cast_object import ObjectCast, cast_object
from advnerf_core.render.composite import visible_shares

BackgroundRenderer = Callable[[Array, Pinhole], Sequence[Any]]
"""``(T_world_from_camera [B, 4, 4], pinhole) -> (rgb [B, H, W, 3] in 0..1, planar depth [B, H, W] in metres, ...)``."""


@dataclass(frozen=True, eq=False)
class Rendered:
    """Images with their vector-Jacobian product.

    Attributes:
        images: ``[B, 3, H, W]`` RGB in 0..1, without autograd history.
        vjp: Takes the gradient of a scalar with respect to ``images`` to its gradient with respect to ``theta``.
        nbytes: Memory that keeping this object holds [bytes].
    """

    images: Tensor
    vjp: Callable[[Tensor], Tensor]
    nbytes: int


@dataclass(frozen=True, eq=False)
class Frames:
    """A batch of camera poses with everything that does not depend on ``theta``; render it with as many as you like.

    Attributes:
        background: What is seen where no object is, already dimmed by the objects in front, ``[B, H, W, 3]``.
        weights: Per object, rendering weights ``[P, slots]`` after occlusion.
        pixels: Per object, flat indices ``[P]`` into ``[B, H, W]``.
        objects: The objects, in the order of ``weights``.
    """

    background: Tensor
    weights: tuple[sparse.csr_matrix, ...]
    pixels: tuple[Tensor, ...]
    objects: tuple[VoxelGridObject, ...]

    def render(self, theta: Tensor | None) -> Rendered:
        """Images for ``theta`` (of ``Surrogate.theta_shape``; ignored, and may be None, without objects)."""
        flat = self.background.reshape(-1, 3).clone()
        parts = split_theta(self.objects, theta)
        for field, W, pixels, part in zip(self.objects, self.weights, self.pixels, parts, strict=True):
            colours = field.colours(part.to(flat.dtype)).numpy()
            flat.index_add_(0, pixels, torch.from_numpy(W @ colours))
        images = flat.reshape(self.background.shape).permute(0, 3, 1, 2).contiguous()
        return Rendered(images, self._vjp(theta, parts), images.nbytes + self._weight_bytes())

    def _weight_bytes(self) -> int:
        matrices = sum(W.data.nbytes + W.indices.nbytes + W.indptr.nbytes for W in self.weights)
        return int(matrices + sum(pixels.nbytes for pixels in self.pixels))

    def _vjp(self, theta: Tensor | None, parts: Sequence[Tensor]) -> Callable[[Tensor], Tensor]:
        # Only these names are kept alive: the background is not.
        weights, pixels, free = self.weights, self.pixels, [field.free_count for field in self.objects]

        def vjp(grad_images: Tensor) -> Tensor:
            if theta is None or not weights:
                return torch.zeros(0, 3)
            flat = grad_images.detach().permute(0, 2, 3, 1).reshape(-1, 3)
            rows = [
                torch.from_numpy(W.T @ flat[index].numpy())[:count].to(theta.dtype)
                for W, index, count in zip(weights, pixels, free, strict=True)
            ]
            slopes = [squash_derivative(part).reshape(-1, 3) for part in parts]
            return torch.cat([r * s for r, s in zip(rows, slopes, strict=True)]).reshape(theta.shape)

        return vjp


class Surrogate:
    """A scene with objects, seen from a camera on the car.

    Args:
        background: Renders the scene without objects; no gradients are taken.
        camera: Intrinsics of the images the policy sees.
        T_car_from_camera: Mount of the camera ``[4, 4]``.
        objects: Objects with free colours; none, one or several.
        depth_tolerance_m: An object is hidden only by a scene surface nearer than this much in front of it [m]. A learned
            scene's depth is not exact, and a face a centimetre in front of its board must win.
        supersample: Rays along each side of a pixel for the objects; 2 imitates the area filter of the policy's view.
        background_colour: Optional map of background colours ``[B, H, W, 3]``, for a scene learned by another camera than the
            one that drives.
        dtype: Type of images and weights.
    """

    def __init__(
        self,
        background: BackgroundRenderer,
        camera: Pinhole,
        T_car_from_camera: ArrayLike,
        objects: Sequence[VoxelGridObject] | VoxelGridObject | None = None,
        depth_tolerance_m: float = 0.15,
        supersample: int = 2,
        background_colour: Callable[[Tensor], Tensor] | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self._background = background
        self.camera = camera
        self.T_car_from_camera = np.asarray(T_car_from_camera, dtype=np.float64)
        self.objects = (objects,) if isinstance(objects, VoxelGridObject) else tuple(objects or ())
        self._tolerance_m = depth_tolerance_m
        self._supersample = supersample
        self._background_colour = background_colour
        self.dtype = dtype

    def in_type(self, dtype: torch.dtype) -> Surrogate:
        """The same surrogate with images and weights of another type; geometry is float64 in any case."""
        other = copy.copy(self)
        other.dtype = dtype
        return other

    @property
    def theta_shape(self) -> tuple[int, ...]:
        """Shape of ``theta``: the object's own if there is one, the stacked rows ``[sum, 3]`` of several, ``(0, 3)`` of none."""
        if len(self.objects) == 1:
            return self.objects[0].theta_shape
        return (sum(field.free_count for field in self.objects), 3)

    def plain_theta(self, dtype: torch.dtype | None = None) -> Tensor:
        """The colours without an attack (``VoxelGridObject.plain_theta``); ``theta_shape``."""
        rows = [torch.zeros(0, 3, dtype=torch.float64)]
        rows += [torch.tensor(field.plain_theta) for field in self.objects]
        return torch.cat(rows).reshape(self.theta_shape).to(dtype or self.dtype)

    def initial_theta(self, generator: torch.Generator, dtype: torch.dtype | None = None) -> Tensor:
        """Where an attack starts: plain colours with noise of 1e-4, which is what differs between seeds; ``theta_shape``."""
        plain = self.plain_theta(torch.float64)
        noise = torch.randn(plain.shape, generator=generator, dtype=torch.float64)
        return (plain + INITIAL_NOISE * noise).to(dtype or self.dtype)

    def camera_poses(self, states: Tensor) -> Array:
        """``T_world_from_camera [B, 4, 4]`` at car states ``[B, n]``, detached."""
        return planar_poses(states.detach().cpu().numpy()) @ self.T_car_from_camera

    @torch.no_grad()
    def prepare(self, T_world_from_camera: ArrayLike) -> Frames:
        """Render the background and cast the objects for camera poses ``[B, 4, 4]``."""
        poses = np.asarray(T_world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
        rgb, depth_m = (torch.as_tensor(part, device="cpu").to(self.dtype) for part in self._render_background(poses))
        if self._background_colour is not None:
            rgb = self._background_colour(rgb)
        numpy_dtype = np.float64 if self.dtype == torch.float64 else np.float32
        casts = [cast_object(f, poses, self.camera, self._supersample, numpy_dtype) for f in self.objects]
        background_share, shares = self._visible(casts, depth_m)
        weights = []
        for cast, share in zip(casts, shares, strict=True):
            scale = sparse.diags(share.astype(numpy_dtype), dtype=numpy_dtype)
            weights.append(sparse.csr_matrix(scale @ cast.weights))
        pixels = tuple(torch.from_numpy(cast.pixels) for cast in casts)
        return Frames(rgb * background_share[..., None], tuple(weights), pixels, self.objects)

    def render(self, T_world_from_camera: ArrayLike, theta: Tensor | None) -> Rendered:
        """Images at camera poses ``[B, 4, 4]`` and their vjp; see :class:`Rendered`. ``theta`` is None without objects."""
        return self.prepare(T_world_from_camera).render(None if theta is None else theta.detach())

    def sense(self, states: Tensor, theta: Tensor | None) -> Rendered:
        """What the car's camera sees from states ``[B, n]``; poses are detached."""
        return self.render(self.camera_poses(states), theta)

    def observe(self, theta: Tensor | None) -> Callable[[Tensor], Tensor]:
        """The sensor of a rollout: car states ``[B, n]`` to images ``[B, 3, H, W]``."""
        return lambda states: self.sense(states, theta).images

    def _render_background(self, poses: Array) -> tuple[Any, Any]:
        rgb, depth_m = self._background(poses, self.camera)[:2]
        size = (len(poses), self.camera.height, self.camera.width)
        if tuple(rgb.shape) != (*size, 3) or tuple(depth_m.shape) != size:
            got = f"{tuple(rgb.shape)} and {tuple(depth_m.shape)}"
            raise ValueError(f"expected a background of shapes {(*size, 3)} and {size}, got {got}")
        return rgb, depth_m

    def _visible(self, casts: Sequence[ObjectCast], depth_m: Tensor) -> tuple[Tensor, list[Array]]:
        """Shares of light that reach the camera: of the background ``[B, H, W]``, and of each object at its pixels ``[P]``."""
        covered = np.unique(np.concatenate([np.zeros(0, np.int64), *(cast.pixels for cast in casts)]))
        alphas = torch.zeros(len(casts) + 1, len(covered), dtype=torch.float64)
        depths = torch.full_like(alphas, torch.inf)
        places = [torch.from_numpy(np.searchsorted(covered, cast.pixels)) for cast in casts]
        for k, (cast, place) in enumerate(zip(casts, places, strict=True)):
            alphas[k, place] = torch.from_numpy(cast.alpha)
            depths[k, place] = torch.from_numpy(cast.depth_m) - self._tolerance_m
        index = torch.from_numpy(covered)
        alphas[-1] = 1.0
        depths[-1] = torch.nan_to_num(depth_m.reshape(-1)[index].double(), nan=torch.inf)
        shares = visible_shares(alphas, depths)
        background = torch.ones(depth_m.numel(), dtype=depth_m.dtype)
        background[index] = shares[-1].to(depth_m.dtype)
        return background.reshape(depth_m.shape), [shares[k, place].numpy() for k, place in enumerate(places)]


def split_theta(objects: Sequence[VoxelGridObject], theta: Tensor | None) -> list[Tensor]:
    """Each object's part of a surrogate's ``theta``, in the object's own shape."""
    if not objects:
        return []
    if theta is None:
        raise ValueError(f"expected theta for {len(objects)} object(s), got None")
    if len(objects) == 1:
        return [theta]
    parts = theta.reshape(-1, 3).split([field.free_count for field in objects])
    return [part.reshape(field.theta_shape) for part, field in zip(parts, objects, strict=True)]
