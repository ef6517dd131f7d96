"""An attack on shapes: the vertices of meshes are free, their colours are fixed.

``ShapeSensor`` replaces a ``Surrogate`` in an attack: the adjoint and every search accept it unchanged. The searched parameters,
``theta``, are preconditioned (``large_steps``) and bounded::

    d = (I + lambda L)^-1 theta,    vertices = plain vertices + d / sqrt(1 + |d|^2 / bound^2),    z >= 0

Pictures come from a surrogate with the moved meshes; their gradient is the projective estimate (``projective``), whose seed depends
on camera poses and ``theta`` only, so that a resumed search gets the same numbers.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from advnerf_core.geometry import Array, invert_transform
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.large_steps import LargeSteps
from advnerf_core.scene.surrogate import Rendered, Surrogate, split_theta


@dataclass(frozen=True)
class ShapeLimits:
    """Limits of shape changes.

    Attributes:
        bound_m: Largest displacement of a vertex, in the world [m].
        samples: Rays a pixel for the gradient inside the silhouettes.
        boundary_samples: Points a pixel for the gradient of the silhouettes.
    """

    bound_m: float = 0.2
    smoothness: float = 19.0
    samples: int = 4
    boundary_samples: int = 1

    def __post_init__(self) -> None:
        if not (
            np.isfinite(self.bound_m)
            and self.bound_m > 0
            and np.isfinite(self.smoothness)
            and self.smoothness >= 0
        ):
            raise ValueError(f"expected a bound above zero and a smoothness of at least zero, got {self}")
        if self.samples < 1 or self.boundary_samples < 1:
            raise ValueError(f"expected at least one sample a pixel of each kind, got {self}")


# Noise of vertices, in units of theta: N(0, 1) would fold the surface.
_INITIAL_NOISE = 1e-4


class ShapeSensor:
    """Meshes with free shapes in a scene.

    Args:
        surrogate: Scene and camera, with the meshes in their plain shape; all objects must be meshes (`MeshField`).

    Attributes:
        colours: Plain colours of the meshes, of ``surrogate.theta_shape``.
    """

    def __init__(self, surrogate: Surrogate, limits: ShapeLimits | None = None) -> None:
        self.surrogate, self.limits = surrogate, limits or ShapeLimits()
        self.colours = surrogate.plain_theta()
        self.meshes: list[MeshField] = [field for field in surrogate.objects if isinstance(field, MeshField)]
        if not self.meshes or len(self.meshes) != len(surrogate.objects):
            raise ValueError(
                f"expected one or more meshes and nothing else, got {len(surrogate.objects)} object(s)"
            )
        self._steps = [
            LargeSteps(len(f.mesh.vertices), f.mesh.faces, self.limits.smoothness) for f in self.meshes
        ]
        self._counts = [len(field.mesh.vertices) for field in self.meshes]
        self._shaped: tuple[bytes, list[MeshField]] = (b"", [])
        self._renderer: Any = None

    @property
    def theta_shape(self) -> tuple[int, ...]:
        """One row for each vertex of all meshes."""
        return (sum(self._counts), 3)

    def initial_theta(self, generator: torch.Generator) -> Tensor:
        """The plain shapes, with noise that depends on the seed."""
        return _INITIAL_NOISE * torch.randn(self.theta_shape, generator=generator)

    @property
    def learning_rate(self) -> float:
        """A step of Adam in ``theta`` that reaches the bound in some twenty iterations [m]."""
        return 0.05 * self.limits.bound_m

    @cached_property
    def random_sigma(self) -> float:
        """Spread of a random ``theta`` whose mean displacement equals the bound, before it is bounded [m]."""
        noise = torch.randn(self.theta_shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        moved = [
            self._displaced(k, part) * field.scale
            for k, (field, part) in enumerate(zip(self.meshes, noise.split(self._counts), strict=True))
        ]
        return self.limits.bound_m / float(torch.cat(moved).norm(dim=1).square().mean().sqrt())

    def camera_poses(self, states: Tensor) -> Array:
        """``T_world_from_camera [B, 4, 4]`` at car states ``[B, n]``, detached."""
        return self.surrogate.camera_poses(states)

    def vertices(self, theta: Tensor) -> list[Tensor]:
        """Vertices of each mesh in its own frame ``[V, 3]`` float64, without history."""
        if tuple(theta.shape) != self.theta_shape:
            raise ValueError(f"expected theta of shape {self.theta_shape}, got {tuple(theta.shape)}")
        parts = theta.detach().double().split(self._counts)
        return [self._moved(k, self._displaced(k, part)) for k, part in enumerate(parts)]

    def shaped(self, theta: Tensor) -> list[MeshField]:
        """The meshes in the shape of ``theta``."""
        key = theta.detach().numpy().tobytes()
        if self._shaped[0] != key:
            made = [
                MeshField(field.mesh.with_vertices(vertices.numpy()), field.T_world_from_object, field.scale)
                for field, vertices in zip(self.meshes, self.vertices(theta), strict=True)
            ]
            self._shaped = (key, made)
        return self._shaped[1]

    def sense(self, states: Tensor, theta: Tensor) -> Rendered:
        """Images of the car's camera from states ``[B, n]``."""
        return self.render(self.camera_poses(states), theta)

    @torch.no_grad()
    def render(self, T_world_from_camera: ArrayLike, theta: Tensor) -> Rendered:
        """Images at camera poses ``[B, 4, 4]`` with their vjp with respect to ``theta``."""
        poses = np.asarray(T_world_from_camera, dtype=np.float64).reshape(-1, 4, 4)
        rgb, depth_m = self.surrogate.scene_frames(poses)
        fields, theta = self.shaped(theta), theta.detach().clone()
        images = self.surrogate.with_objects(fields).overlay(rgb, depth_m, poses, self.colours)
        seen = [
            any(field.window(pose, self.surrogate.camera) is not None for field in fields) for pose in poses
        ]

        def vjp(grad_images: Tensor) -> Tensor:
            total = torch.zeros(self.theta_shape, dtype=torch.float64)
            vertices = self.vertices(theta)
            for b in np.flatnonzero(seen):
                seed = zlib.crc32(poses[b].tobytes(), zlib.crc32(theta.numpy().tobytes()))
                slopes = grad_images[b].detach().permute(1, 2, 0).numpy()
                total += self._vertex_slopes(
                    vertices, poses[b], rgb[b].numpy(), depth_m[b].numpy(), slopes, seed
                )
            return self._pulled_back(theta, total).to(theta.dtype)

        return Rendered(images, vjp, images.nbytes + rgb.nbytes + depth_m.nbytes)

    def _displaced(self, k: int, part: Tensor) -> Tensor:
        return torch.from_numpy(self._steps[k].solve(part.numpy()))

    def _moved(self, k: int, displaced: Tensor) -> Tensor:
        """Plain vertices plus a bounded displacement, not below the ground; differentiable."""
        bound = self.limits.bound_m / self.meshes[k].scale
        bounded = displaced / torch.sqrt(1.0 + displaced.square().sum(1, keepdim=True) / bound**2)
        moved = torch.from_numpy(self.meshes[k].mesh.vertices) + bounded
        return torch.cat([moved[:, :2], moved[:, 2:].clamp_min(0.0)], dim=1)

    def _pulled_back(self, theta: Tensor, slopes: Tensor) -> Tensor:
        """Gradient with respect to ``theta``, from gradients with respect to vertices."""
        parts = zip(theta.double().split(self._counts), slopes.split(self._counts), strict=True)
        out = []
        for k, (part, slope) in enumerate(parts):
            displaced = self._displaced(k, part).requires_grad_()
            with torch.enable_grad():
                (slope,) = torch.autograd.grad(self._moved(k, displaced), displaced, slope)
            out.append(torch.from_numpy(self._steps[k].solve(slope.numpy())))
        return torch.cat(out)

    def _vertex_slopes(
        self,
        vertices: Sequence[Tensor],
        pose: Array,
        rgb: NDArray[Any],
        depth_m: NDArray[Any],
        slopes: NDArray[Any],
        seed: int,
    ) -> Tensor:
        """Gradient ``[sum V, 3]`` of one picture with respect to the vertices in the meshes' frames."""
        T = [invert_transform(pose) @ field.T_world_from_object for field in self.meshes]
        seen = [
            field.scale * part.numpy() @ t[:3, :3].T + t[:3, 3]
            for field, part, t in zip(self.meshes, vertices, T, strict=True)
        ]
        limit = depth_m.astype(np.float64) + self.surrogate.depth_tolerance_m
        found = self._projective().gradient(np.concatenate(seen), rgb, limit, slopes, seed)
        parts = np.split(found, np.cumsum(self._counts)[:-1])
        turned = [
            field.scale * part @ t[:3, :3] for field, part, t in zip(self.meshes, parts, T, strict=True)
        ]
        return torch.from_numpy(np.concatenate(turned))

    def _projective(self) -> Any:
        """The renderer of gradients, with all meshes joined and their textures stacked."""
        if self._renderer is None:
            from advnerf_core.objects.mesh.projective import ProjectiveRenderer

            textures = [
                field.texture(part)
                for field, part in zip(self.meshes, split_theta(self.meshes, self.colours), strict=True)
            ]
            firsts = np.cumsum([0, *self._counts])[:-1]
            faces = np.concatenate(
                [f.mesh.faces + first for f, first in zip(self.meshes, firsts, strict=True)]
            )
            rows = np.cumsum([0, *(len(texture) for texture in textures)])
            texels = [
                f.mesh.texels + np.array([0.0, row]) for f, row in zip(self.meshes, rows[:-1], strict=True)
            ]
            atlas = np.zeros((rows[-1], max(texture.shape[1] for texture in textures), 3), np.float32)
            for texture, row in zip(textures, rows[:-1], strict=True):
                atlas[row : row + len(texture), : texture.shape[1]] = texture
            self._renderer = ProjectiveRenderer(
                sum(self._counts),
                faces,
                np.concatenate(texels),
                atlas,
                self.surrogate.camera,
                self.limits.samples,
                self.limits.boundary_samples,
            )
        return self._renderer
