"""Derivatives of a picture of a mesh with respect to its vertices; imported only where needed, as it loads Mitsuba.

A picture is the mesh's texture where the mesh is nearest, and a background picture otherwise. Its derivative has two parts: inside the
silhouettes the texture moves with the surface (found by automatic differentiation of the ray's hit), and the silhouettes
themselves move (Zhang, Roussel and Jakob 2023, "Projective Sampling for Differentiable Rendering of Geometry"; the machinery is Mitsuba's
``PSIntegrator``). Both are Monte Carlo estimates. Everything is in the camera's frame: the camera never changes, so no frame compiles a
new kernel.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, Pinhole
from advnerf_core.objects.mesh.engine import engine
from advnerf_core.objects.mesh.ray_cast import floats, mitsuba_mesh

mi, dr = engine().mi, engine().dr
PSIntegrator: Any = import_module("mitsuba.python.ad.integrators.common").PSIntegrator

_NAME = "advnerf_over_background"
_VERTICES = "mesh.vertex_positions"


class OverBackground(PSIntegrator):
    """Unlit texture of the scene's one mesh, over a picture with depth that fills the film."""

    def __init__(self, props: Any) -> None:
        super().__init__(props)
        self.radiative_backprop = False
        self.sample_border_warning = False  # the film is exactly the picture, and its pixels are boxes

    def look_through(self, pinhole: Pinhole) -> None:
        """Set the camera; ``fy`` assumes square pixels."""
        self._size = (pinhole.width, pinhole.height)
        self._lens = [_opaque(value) for value in (pinhole.fx, pinhole.cx, pinhole.cy)]

    def show(self, corner_texels: Array, texture: NDArray[np.float32]) -> None:
        """Set texture ``[H, W, 3]`` and the positions of the faces' corners in it ``[F, 3, 2]``."""
        uv = np.asarray(corner_texels, np.float32) / np.array(texture.shape[1::-1], np.float32)
        self._corners = [floats(mi, uv[:, k]) for k in range(3)]
        self._texture = mi.Texture2f(
            mi.TensorXf(np.asarray(texture, np.float32)), wrap_mode=dr.WrapMode.Clamp
        )

    def stand_before(self, rgb: NDArray[np.float32], depth_m: NDArray[np.float32]) -> None:
        """Set the background ``[H, W, 3]``, and the depth ``[H, W]`` [m] beyond which it hides the mesh."""
        self._rgb = floats(mi, rgb)
        self._depth = floats(mi, np.where(np.isnan(depth_m), np.inf, depth_m))

    def sample(
        self,
        mode: Any,
        scene: Any,
        sampler: Any,
        ray: Any,
        depth: Any,
        *rest: Any,
        active: Any = True,
        **more: Any,
    ) -> Any:
        """Colour along a camera ray; see ``PSIntegrator.sample``."""
        del sampler, depth, rest, more
        with dr.resume_grad(when=mode != dr.ADMode.Primal):
            si = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True, active=active)
            colour = self._seen(si, ray.d, active)
        return colour, active, [], None

    def sample_radiance_difference(
        self, scene: Any, ss: Any, curr_depth: Any, sampler: Any, wavelengths: Any, active: Any
    ) -> Any:
        """Colour on a silhouette minus colour just beside it; see ``PSIntegrator.sample_radiance_difference``."""
        del curr_depth, sampler
        beside = self._seen(scene.ray_intersect(ss.spawn_ray(wavelengths), active=active), ss.d, active)
        hit = dr.zeros(mi.PreliminaryIntersection3f)
        hit.valid, hit.t, hit.prim_index, hit.prim_uv, hit.shape = active, 1, ss.prim_index, ss.uv, ss.shape
        ray = mi.Ray3f(ss.p - ss.d, ss.d)
        on_it = self._seen(hit.compute_surface_interaction(ray, mi.RayFlags.All, active), ss.d, active)
        difference = on_it - beside
        return difference, active & (dr.max(dr.abs(difference)) > 0)

    def _seen(self, si: Any, direction: Any, active: Any) -> Any:
        """Colour along a direction from the camera that meets the mesh at ``si``."""
        f, cx, cy = self._lens
        width, height = self._size
        column = mi.UInt32(dr.clip(dr.detach(f * direction.x / direction.z + cx), 0, width - 1))
        row = mi.UInt32(dr.clip(dr.detach(f * direction.y / direction.z + cy), 0, height - 1))
        pixel = row * width + column
        behind = dr.gather(mi.Color3f, self._rgb, pixel, active)
        mesh = active & si.is_valid() & (dr.detach(si.p.z) <= dr.gather(mi.Float, self._depth, pixel, active))
        corners = [dr.gather(mi.Point2f, corner, si.prim_index, mesh) for corner in self._corners]
        uv = corners[0] + (corners[1] - corners[0]) * si.uv.x + (corners[2] - corners[0]) * si.uv.y
        return dr.select(mesh, mi.Color3f(self._texture.eval(uv, mesh)), behind)


class ProjectiveRenderer:
    """Derivatives of pictures of a mesh over a background.

    Args:
        vertex_count: Number of vertices; their positions are given with each picture.
        faces: Corners ``[F, 3]``.
        corner_texels: Positions of the corners in the texture ``[F, 3, 2]``.
        texture: Colours ``[H, W, 3]`` in 0..1.
        samples: Rays a pixel inside the silhouettes.
        boundary_samples: Points a pixel on the silhouettes.
    """

    def __init__(
        self,
        vertex_count: int,
        faces: NDArray[np.int32],
        corner_texels: Array,
        texture: NDArray[np.float32],
        pinhole: Pinhole,
        samples: int = 4,
        boundary_samples: int = 1,
    ) -> None:
        self._pinhole = pinhole
        self._square = np.array(
            [1.0, pinhole.fy / pinhole.fx, 1.0]
        )  # Mitsuba's pixels are square: the world is stretched
        self._integrator = mi.load_dict({"type": _NAME, "sppc": samples, "sppp": boundary_samples, "sppi": 0})
        self._integrator.look_through(pinhole)
        self._integrator.show(corner_texels, texture)
        mesh = mitsuba_mesh(mi, np.random.default_rng(0).random((vertex_count, 3)), faces)
        self._scene = mi.load_dict({"type": "scene", "mesh": mesh, "sensor": _sensor(pinhole)})
        self._parameters = mi.traverse(self._scene)
        self._parameters.keep([_VERTICES])

    def gradient(
        self,
        vertices: Array,
        rgb: NDArray[np.float32],
        depth_m: NDArray[np.float32],
        grad_image: NDArray[np.float32],
        seed: int,
    ) -> Array:
        """Gradient with respect to the vertices ``[V, 3]`` of a scalar with gradient ``grad_image`` with respect to the picture.

        Args:
            vertices: Vertices in the camera's frame ``[V, 3]`` [m].
            rgb: Background ``[H, W, 3]`` in 0..1.
            depth_m: Planar depth beyond which the mesh is hidden ``[H, W]`` [m]; NaN hides nothing.
            grad_image: Gradient with respect to the picture, ``[H, W, 3]``.
            seed: Seed of the samples; the same seed gives the same estimate, to the bit.
        """
        engine(in_order=True)  # many samples add to one vertex
        self._integrator.stand_before(rgb, depth_m)
        positions = floats(mi, vertices * self._square)
        dr.enable_grad(positions)
        self._parameters[_VERTICES] = positions
        self._parameters.update()
        slopes = mi.TensorXf(floats(mi, grad_image), grad_image.shape)
        self._integrator.render_backward(self._scene, None, slopes, seed=_seed(seed))
        gradient = np.array(dr.grad(positions), np.float64).reshape(-1, 3)
        return np.asarray(gradient * self._square)


def _sensor(pinhole: Pinhole) -> dict[str, Any]:
    """A camera at the origin that looks along z, y down."""
    up_is_up = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, 0, 1], up=[0, -1, 0])
    film = {
        "type": "hdrfilm",
        "width": pinhole.width,
        "height": pinhole.height,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
        "component_format": "float32",
        "sample_border": False,
    }
    return {
        "type": "perspective",
        "to_world": up_is_up,
        "fov_axis": "x",
        "near_clip": 1e-3,
        "far_clip": 1e4,
        "film": film,
        "fov": float(2.0 * np.degrees(np.arctan(0.5 * pinhole.width / pinhole.fx))),
        "principal_point_offset_x": 0.5 - pinhole.cx / pinhole.width,
        "principal_point_offset_y": 0.5 - pinhole.cy / pinhole.height,
        "sampler": {"type": "independent", "sample_count": 4},
    }


def _opaque(value: float) -> Any:
    return dr.opaque(mi.Float, value)


def _seed(seed: int) -> Any:
    # Not a literal: each value would compile another kernel.
    return dr.opaque(mi.UInt32, seed & 0xFFFFFFFF)


mi.register_integrator(_NAME, OverBackground)
