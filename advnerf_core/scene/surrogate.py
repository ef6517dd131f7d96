"""The differentiable surrogate of a deployment scene: learned background, cast objects, depth-ordered composition.

``render(poses, theta)`` gives images and their vector-Jacobian product with respect to ``theta``, the squash-inverse colours of
the objects. Scene, geometry and camera poses are frozen, so the images are linear in the squashed colours and the background
never needs a gradient: the backward pass reads only values that the forward pass of the same frames computed.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.fields.seen_rows import SeenRows, compact
from advnerf_core.fields.sparse_rows import SparseRows
from advnerf_core.geometry import Array, Pinhole, planar_poses
from advnerf_core.parallel import Work, beside
from advnerf_core.render.cast_object import ObjectCast, cast_work, made_opaque
from advnerf_core.render.composite import sparse_shares
from advnerf_core.scene.remembered import RememberedBackground

BackgroundRenderer = Callable[[Array, Pinhole], Sequence[Any]]
"""``(T_world_from_camera [B, 4, 4], pinhole) -> (rgb [B, H, W, 3] in 0..1, planar depth [B, H, W] in metres, ...)``."""


@runtime_checkable
class RendersInParts(Protocol):
    """A `BackgroundRenderer` whose work can run beside the casting of objects: no thread waits for the end of either."""

    def work(self, T_world_from_camera: Array, pinhole: Pinhole) -> Work[tuple[Tensor, Tensor, Tensor]]:
        """The computation of a call, not begun yet."""


@dataclass(frozen=True, eq=False)
class Rendered:
    """Images with their vector-Jacobian product.

    Attributes:
        images: ``[B, 3, H, W]`` RGB in 0..1, without autograd history.
        vjp: Maps the gradient of a scalar with respect to ``images``, on their device, to its gradient with respect to ``theta``, on theta's.
        nbytes: Memory that this object holds [bytes].
    """

    images: Tensor
    vjp: Callable[[Tensor], Tensor]
    nbytes: int


@dataclass(frozen=True, eq=False)
class PoseBatch:
    """A batch of camera poses with everything that does not depend on ``theta``, for rendering any number of thetas.

    Attributes:
        background: Background colours, already dimmed by the objects in front, ``[B, H, W, 3]``.
        weights: Per object, rendering weights ``[P, V]`` after occlusion, of the visible pixels and colours.
        pixels: Per object, flat indices ``[P]`` into ``[B, H, W]``.
        seen: Per object, the rows of these colours; the objects are in the order of ``weights``.
    """

    background: Tensor
    weights: tuple[SparseRows, ...]
    pixels: tuple[Tensor, ...]
    seen: tuple[SeenRows, ...]

    def render(self, theta: Tensor | None) -> Rendered:
        """Images for ``theta`` (of ``Surrogate.theta_shape``; ignored, and may be None, without objects)."""
        # NumPy: torch would wake its threads for each of these small steps.
        image = self.background.numpy().copy()
        parts = split_theta([rows.field for rows in self.seen], theta)
        values = [
            rows.values(part.to(self.background.dtype)) for rows, part in zip(self.seen, parts, strict=True)
        ]
        for rows, W, pixels, value in zip(self.seen, self.weights, self.pixels, values, strict=True):
            W.add_product(rows.colours(value).numpy(), pixels.numpy(), image.reshape(-1, 3))
        images = torch.from_numpy(image).permute(
            0, 3, 1, 2
        )  # in memory a pixel's channels stay together, as convolutions take them
        own = sum(rows.nbytes for rows in self.seen) + sum(value.nbytes for value in values)
        return Rendered(images, self._vjp(theta, values), images.nbytes + self.weights_nbytes + own)

    def only(self, images: NDArray[np.int64]) -> PoseBatch:
        """The batch of some of its images, by their numbers."""
        size = self.background[0, :, :, 0].numel()
        place = np.full(len(self.background), -1)
        place[images] = np.arange(len(images))
        places = [place[flat.numpy() // size] for flat in self.pixels]
        kept = [np.flatnonzero(found >= 0) for found in places]
        pixels = tuple(
            flat[rows] % size + size * torch.from_numpy(found[rows])
            for flat, found, rows in zip(self.pixels, places, kept, strict=True)
        )
        weights = tuple(W.take(rows) for W, rows in zip(self.weights, kept, strict=True))
        return PoseBatch(self.background[images], weights, pixels, self.seen)

    @property
    def weights_nbytes(self) -> int:
        """Memory that weights and pixels hold [bytes]."""
        return sum(W.nbytes for W in self.weights) + sum(pixels.nbytes for pixels in self.pixels)

    def _vjp(self, theta: Tensor | None, values: Sequence[Tensor]) -> Callable[[Tensor], Tensor]:
        # Only these names are kept alive: the background is not, nor is theta.
        weights, pixels, seen = self.weights, self.pixels, self.seen
        dtype, shape = (torch.float32, None) if theta is None else (theta.dtype, theta.shape)

        def vjp(grad_images: Tensor) -> Tensor:
            if shape is None or not weights:
                return torch.zeros(0, 3)
            flat = grad_images.detach().permute(0, 2, 3, 1).reshape(-1, 3)
            rows = [
                here.gradient(value, torch.from_numpy(W.transposed_product(flat[index].numpy())))
                for here, value, W, index in zip(seen, values, weights, pixels, strict=True)
            ]
            return (rows[0] if len(rows) == 1 else torch.cat(rows)).to(dtype).reshape(shape)

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
        dtype: Type of images and weights.
        opaque: Compose without blending, as some deployments do: each pixel is wholly the nearer of the object and the scene;
            an object that covers less than half of a pixel is not shown.
    """

    def __init__(
        self,
        background: BackgroundRenderer,
        camera: Pinhole,
        T_car_from_camera: ArrayLike,
        objects: Sequence[ColouredObject] | ColouredObject | None = None,
        depth_tolerance_m: float = 0.15,
        supersample: int = 2,
        dtype: torch.dtype = torch.float32,
        opaque: bool = False,
    ) -> None:
        self.background = background
        self.camera = camera
        self.T_car_from_camera = np.asarray(T_car_from_camera, dtype=np.float64)
        listed = () if objects is None else objects
        self.objects = tuple(listed) if isinstance(listed, Sequence) else (listed,)
        self.depth_tolerance_m = depth_tolerance_m
        self.supersample = supersample
        self.dtype = dtype
        self.opaque = opaque

    def in_type(self, dtype: torch.dtype) -> Surrogate:
        """The same surrogate with images and weights of another type; geometry is always float64."""
        other = copy.copy(self)
        other.dtype = dtype
        return other

    def with_background(self, background: BackgroundRenderer) -> Surrogate:
        """The same surrogate with another renderer of the scene."""
        other = copy.copy(self)
        other.background = background
        return other

    def with_objects(self, objects: Sequence[ColouredObject], opaque: bool | None = None) -> Surrogate:
        """The same surrogate with other objects, for example moved ones; ``opaque`` is unchanged if None."""
        other = copy.copy(self)
        other.objects = tuple(objects)
        other.opaque = self.opaque if opaque is None else opaque
        return other

    @property
    def theta_shape(self) -> tuple[int, ...]:
        """Shape of ``theta``: the object's own if there is one, the stacked rows ``[sum, 3]`` of several, ``(0, 3)`` of none."""
        if len(self.objects) == 1:
            return self.objects[0].theta_shape
        return (sum(field.parameter_count for field in self.objects), 3)

    def plain_theta(self, dtype: torch.dtype | None = None) -> Tensor:
        """The colours without an attack (``ColouredObject.plain_theta``); ``theta_shape``."""
        rows = [torch.zeros(0, 3, dtype=torch.float64)]
        rows += [torch.tensor(field.plain_theta) for field in self.objects]
        return torch.cat(rows).reshape(self.theta_shape).to(dtype or self.dtype)

    def initial_theta(self, generator: torch.Generator, dtype: torch.dtype | None = None) -> Tensor:
        """Initial theta of an attack: white noise of N(0, 1), so that each seed is another search; ``theta_shape``."""
        noise = torch.randn(self.theta_shape, generator=generator, dtype=torch.float64)
        return noise.to(dtype or self.dtype)

    def camera_poses(self, states: Tensor) -> Array:
        """``T_world_from_camera [B, 4, 4]`` at car states ``[B, n]``, detached."""
        return planar_poses(states.detach().cpu().numpy()) @ self.T_car_from_camera

    def remembering(self, budget_bytes: int) -> Surrogate:
        """The same surrogate, which caches as many of the last background frames as fit into a budget of memory [bytes]."""
        return self.with_background(RememberedBackground(self.background, budget_bytes))

    @torch.no_grad()
    def prepare(self, T_world_from_camera: ArrayLike) -> PoseBatch:
        """Render the background and cast the objects for camera poses ``[B, 4, 4]``."""
        poses = np.asarray(T_world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
        casts, frames = self._casts_and_scene(poses)
        return self._composed(casts, *self._checked(frames, len(poses)))

    def _casts_and_scene(self, poses: Array) -> tuple[list[ObjectCast], Sequence[Any]]:
        # In a separate method, so that the parts of the cast are freed before frames are composed.
        casting = self._cast_work(poses)
        if isinstance(self.background, RendersInParts):
            return beside(casting, self.background.work(poses, self.camera)).run()
        return casting.run(), self.background(poses, self.camera)

    @torch.no_grad()
    def overlay(
        self, rgb: ArrayLike, depth_m: ArrayLike, T_world_from_camera: ArrayLike, theta: Tensor | None
    ) -> Tensor:
        """Compose the objects over given images.

        Args:
            rgb: Images ``[B, H, W, 3]`` in 0..1.
            depth_m: Their planar depth ``[B, H, W]`` [m]; infinite or NaN if unknown.
            T_world_from_camera: Poses they were taken from ``[B, 4, 4]``.
            theta: See :meth:`render`.

        Returns:
            Images ``[B, 3, H, W]``.
        """
        poses = np.asarray(T_world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
        images, depths = (torch.as_tensor(part, device="cpu").to(self.dtype) for part in (rgb, depth_m))
        self.check_background(images, depths, len(poses))
        frames = self._composed(self._cast_work(poses).run(), images, depths)
        return frames.render(None if theta is None else theta.detach()).images

    def _cast_work(self, poses: Array) -> Work[list[ObjectCast]]:
        dtype = torch.empty(0, dtype=self.dtype).numpy().dtype
        return cast_work(self.objects, poses, self.camera, self.supersample, dtype)

    def _composed(self, casts: Sequence[ObjectCast], rgb: Tensor, depth_m: Tensor) -> PoseBatch:
        if self.opaque:
            casts = [made_opaque(cast) for cast in casts]
        return self.composed(casts, rgb, depth_m)

    def composed(self, casts: Sequence[ObjectCast], rgb: Tensor, depth_m: Tensor) -> PoseBatch:
        """Compose casts of the objects with a background, colours ``[B, H, W, 3]`` and planar depth ``[B, H, W]`` [m]."""
        background, shares = sparse_shares(
            [cast.pixels for cast in casts],
            [cast.alpha for cast in casts],
            [cast.depth_m - self.depth_tolerance_m for cast in casts],
            depth_m.reshape(-1).double().numpy(),
        )
        seen = [
            _seen(cast, share, field) for cast, share, field in zip(casts, shares, self.objects, strict=True)
        ]
        dimmed = rgb.numpy() * background.astype(rgb.numpy().dtype).reshape(depth_m.shape)[..., None]
        return PoseBatch(
            torch.from_numpy(dimmed),
            tuple(part[1] for part in seen),
            tuple(part[0] for part in seen),
            tuple(part[2] for part in seen),
        )

    def render(self, T_world_from_camera: ArrayLike, theta: Tensor | None) -> Rendered:
        """Images at camera poses ``[B, 4, 4]`` and their vjp; see :class:`Rendered`. ``theta`` is None without objects."""
        return self.prepare(T_world_from_camera).render(None if theta is None else theta.detach())

    def sense(self, states: Tensor, theta: Tensor | None) -> Rendered:
        """Images of the car's camera from states ``[B, n]``; poses are detached."""
        return self.render(self.camera_poses(states), theta)

    def observe(self, theta: Tensor | None) -> Callable[[Tensor], Tensor]:
        """The sensor of a rollout: car states ``[B, n]`` to images ``[B, 3, H, W]``."""
        return lambda states: self.sense(states, theta).images

    @torch.no_grad()
    def scene_frames(self, poses: Array) -> tuple[Tensor, Tensor]:
        """Colours ``[B, H, W, 3]`` and planar depth ``[B, H, W]`` of the scene without objects, from ``[B, 4, 4]``."""
        return self._checked(self.background(poses, self.camera), len(poses))

    def _checked(self, frames: Sequence[Any], count: int) -> tuple[Tensor, Tensor]:
        rgb, depth_m = frames[:2]
        self.check_background(rgb, depth_m, count)
        rgb, depth_m = (torch.as_tensor(part, device="cpu").to(self.dtype) for part in (rgb, depth_m))
        return rgb, depth_m

    def check_background(self, rgb: Any, depth_m: Any, count: int) -> None:
        """Check the shapes of a background of ``count`` images."""
        size = (count, self.camera.height, self.camera.width)
        if tuple(rgb.shape) != (*size, 3) or tuple(depth_m.shape) != size:
            got = f"{tuple(rgb.shape)} and {tuple(depth_m.shape)}"
            raise ValueError(f"expected a background of shapes {(*size, 3)} and {size}, got {got}")


def _seen(cast: ObjectCast, share: Array, field: ColouredObject) -> tuple[Tensor, SparseRows, SeenRows]:
    """Visible pixels, weights and colours of a cast whose pixels keep ``share [P]`` of their light."""
    kept = np.flatnonzero(share > 0.0)
    return torch.from_numpy(cast.pixels[kept]), *compact(cast.rows.scaled(kept, share[kept]), field)


def split_theta(objects: Sequence[ColouredObject], theta: Tensor | None) -> list[Tensor]:
    """Each object's part of a surrogate's ``theta``, in the object's own shape."""
    if not objects:
        return []
    if theta is None:
        raise ValueError(f"expected theta for {len(objects)} object(s), got None")
    if len(objects) == 1:
        return [theta]
    parts = theta.reshape(-1, 3).split([field.parameter_count for field in objects])
    return [part.reshape(field.theta_shape) for part, field in zip(parts, objects, strict=True)]
