"""The surrogate on a GPU: background, objects, images and gradients are computed and stay there.

A drop-in for `Surrogate`, and for `ManyTextures`, as the sensor of an attack. The CPU keeps the car's states and theta; per tick only
camera poses and the policy's outputs cross between the two.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from advnerf_core.errors import DeviceError
from advnerf_core.fields.coloured import ColouredObject
from advnerf_core.geometry import Array
from advnerf_core.render.cast_torch import TorchObjects
from advnerf_core.scene.baked import BakedScene
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.surrogate import BackgroundRenderer, Rendered, Surrogate, split_theta
from advnerf_core.scene.torch_background import TorchBaked, TorchField


@dataclass(frozen=True, eq=False)
class _Textures:
    """Theta in its original form, and its colours.

    Attributes:
        given: The original tensor; the reference keeps its memory from being reused for another theta.
        version: Torch's count of changes of ``given``.
        leaf: The same values on the device.
        colours: All objects' colour vectors ``[N, V, 3]``, with history to ``leaf``.
    """

    given: Tensor
    version: int
    leaf: Tensor
    colours: Tensor
    shown: Tensor

    def is_of(self, theta: Tensor) -> bool:
        """Whether these were computed from ``theta``, unchanged since."""
        same = theta.data_ptr() == self.given.data_ptr() and theta.shape == self.given.shape
        return same and theta.dtype == self.given.dtype and theta._version == self.version


@dataclass(frozen=True, eq=False)
class DeviceFrames:
    """A batch of camera poses with everything that does not depend on ``theta``.

    Attributes:
        background: Background ``[B, 3, H, W]`` on the device.
        depth_m: Planar depth of the background ``[B, H, W]`` [m].
        places: Places of the objects, from `TorchObjects.placed`; None without objects.
    """

    surrogate: DeviceSurrogate
    background: Tensor
    depth_m: Tensor
    places: tuple[Tensor, Tensor] | None

    @property
    def weights_nbytes(self) -> int:
        """Memory held beside the background [bytes]."""
        return 0 if self.places is None else sum(each.nbytes for each in self.places)

    @torch.no_grad()
    def render(self, theta: Tensor | None) -> Rendered:
        """Images for ``theta``, on the device, with their vjp, which takes slopes there and returns the gradient on theta's device."""
        image, objects, places = self.background.clone(), self.surrogate.drawn, self.places
        if objects is None or places is None:
            return Rendered(image, lambda _: torch.zeros(0, 3), image.nbytes)
        if theta is None:
            raise ValueError(f"expected theta for {len(objects.objects)} object(s), got None")
        textures = self.surrogate.textures(theta)
        texture_of = self.surrogate.texture_of(len(image))
        shares = objects.draw(places, textures.shown, texture_of, self.depth_m, image)

        def vjp(grad_images: Tensor) -> Tensor:
            slopes = objects.pull(
                places, textures.shown, texture_of, shares, grad_images.detach().to(objects.dtype)
            )
            (gradient,) = torch.autograd.grad(textures.colours, textures.leaf, slopes, retain_graph=True)
            return gradient.to(textures.given)

        return Rendered(image, vjp, image.nbytes + shares.nbytes + self.weights_nbytes)


class DeviceSurrogate:
    """A surrogate on a GPU; the images of its renders are tensors there, theta may be anywhere.

    Baked scenes and fields are copied to the device. Another background is rendered on the CPU, and then copied.

    Args:
        surrogate: The scene with its objects, all voxel grids.

    Raises:
        DeviceError: The objects are not all voxel grids, or composed opaque.
    """

    def __init__(self, surrogate: Surrogate, device: torch.device) -> None:
        if surrogate.opaque:
            raise DeviceError(
                "expected a surrogate that blends on a GPU, got one that composes opaque pixels as a deployment does"
            )
        self.surrogate = surrogate
        self.count: int | None = (
            None  # number of textures at once; None is one, with theta of the surrogate's own shape
        )
        self.starts = 1
        self.device = device
        self.drawn = (
            TorchObjects(
                surrogate.objects,
                surrogate.camera,
                surrogate.supersample,
                surrogate.dtype,
                surrogate.depth_tolerance_m,
                device,
            )
            if surrogate.objects
            else None
        )
        self._background = background_on(device, surrogate.background)
        self._textures: _Textures | None = None

    def many(self, count: int, starts: int) -> DeviceSurrogate:
        """The same for several textures at once, sharing data on the device; frames and theta as in `ManyTextures`."""
        if count < 1 or starts < 1:
            raise ValueError(f"expected at least one texture and one start, got {count} and {starts}")
        other = copy.copy(self)
        other.count, other.starts, other._textures = count, starts, None
        return other

    @property
    def objects(self) -> tuple[ColouredObject, ...]:
        """Objects of the surrogate."""
        return self.surrogate.objects

    @property
    def theta_shape(self) -> tuple[int, ...]:
        """Theta's shape in the surrogate; for several textures ``(count, *surrogate.theta_shape)``."""
        own = self.surrogate.theta_shape
        return own if self.count is None else (self.count, *own)

    def plain_theta(self) -> Tensor:
        """Plain theta of the surrogate."""
        return self.surrogate.plain_theta()

    def initial_theta(self, generator: torch.Generator) -> Tensor:
        """Initial theta of the surrogate; several textures are drawn in order from one generator."""
        drawn = [self.surrogate.initial_theta(generator) for _ in range(self.count or 1)]
        return drawn[0] if self.count is None else torch.stack(drawn)

    def camera_poses(self, states: Tensor) -> Array:
        """``T_world_from_camera [B, 4, 4]`` at car states ``[B, n]``, detached."""
        return self.surrogate.camera_poses(states)

    def sense(self, states: Tensor, theta: Tensor | None) -> Rendered:
        """Images of the car's camera from states ``[B, n]``; poses are detached."""
        return self.render(self.camera_poses(states), theta)

    def render(self, T_world_from_camera: ArrayLike, theta: Tensor | None) -> Rendered:
        """Images at camera poses ``[B, 4, 4]`` and their vjp; see `DeviceFrames.render`."""
        return self.prepare(T_world_from_camera).render(None if theta is None else theta.detach())

    @torch.no_grad()
    def prepare(self, T_world_from_camera: ArrayLike) -> DeviceFrames:
        """Render the background for camera poses ``[B, 4, 4]``, and compute the places of the objects."""
        poses = np.asarray(T_world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
        if self.count is not None and len(poses) % (self.count * self.starts):
            raise ValueError(f"expected poses in multiples of {self.count * self.starts}, got {len(poses)}")
        frames = self._background(poses, self.surrogate.camera)[:2]
        rgb, depth_m = (torch.as_tensor(each).to(self.device, self.surrogate.dtype) for each in frames)
        self.surrogate.check_background(rgb, depth_m, len(poses))
        places = None if self.drawn is None else self.drawn.placed(poses)
        return DeviceFrames(self, rgb.permute(0, 3, 1, 2).contiguous(), depth_m.contiguous(), places)

    def texture_of(self, images: int) -> Tensor:
        """Index of the texture that each of a batch of images shows ``[B]`` int32."""
        return (torch.arange(images, device=self.device) // self.starts % (self.count or 1)).to(torch.int32)

    def textures(self, theta: Tensor) -> _Textures:
        """The colours of a theta; cached for the last one, as all ticks of a drive share it."""
        if self._textures is None or not self._textures.is_of(theta):
            if theta.shape != self.theta_shape:
                raise ValueError(f"expected theta {list(self.theta_shape)}, got {list(theta.shape)}")
            self._textures = self._made(theta)
        return self._textures

    def _made(self, theta: Tensor) -> _Textures:
        given = theta.detach()
        leaf = given.to(self.device, self.surrogate.dtype, copy=True).requires_grad_()
        with torch.enable_grad():
            several = leaf[None] if self.count is None else leaf
            colours = torch.stack([self._colours(each) for each in several])
        return _Textures(given, given._version, leaf, colours, colours.detach())

    def _colours(self, theta: Tensor) -> Tensor:
        assert self.drawn is not None
        grids = self.drawn.objects
        return torch.cat(
            [field.colours(part) for field, part in zip(grids, split_theta(grids, theta), strict=True)]
        )


def background_on(device: torch.device, background: BackgroundRenderer) -> BackgroundRenderer:
    """A renderer of backgrounds on a device; one that no device can render stays on the CPU."""
    if isinstance(background, BakedScene | FieldRenderer) and background.config.contraction:
        return background
    if isinstance(background, BakedScene):
        return TorchBaked(background, device)
    return TorchField(background, device) if isinstance(background, FieldRenderer) else background
