"""Pictures of a MuJoCo model from any pinhole camera: one OpenGL context, planar depth in metres, no moving lights."""

from __future__ import annotations

import atexit
import weakref
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, Pinhole
from hardware.worlds.lab import textures
from hardware.worlds.lab.gl import create_context, load_mujoco

NEAR_M, FAR_M = 0.02, 30.0


class Renderer:
    """Draws one static model off-screen. Use it, and close it, in the thread that made it.

    Colour is drawn at ``supersampling`` times the size and averaged, which is what a real pixel does to the floor at a
    grazing angle; depth is taken at the pixel centre.

    Args:
        model: A ``mujoco.MjModel``.
        supersampling: Factor per axis.
        hidden_groups: Geom groups that are not drawn unless asked for.
        range_m: Nearest and farthest planar depth that is drawn [m].
    """

    def __init__(
        self,
        model: Any,
        supersampling: int,
        hidden_groups: tuple[int, ...] = (),
        range_m: tuple[float, float] = (NEAR_M, FAR_M),
    ) -> None:
        if not 0.0 < range_m[0] < range_m[1]:
            raise ValueError(f"expected 0 < nearest < farthest distance to draw, got {range_m} m")
        self._mujoco = load_mujoco()
        mujoco = self._mujoco
        self._range_m = range_m
        self._model, self._scale = model, supersampling
        self._gl = create_context(64, 64)
        # Shadows are switched off below: no 64 MiB for a map of them, which a software rasteriser also has to clear.
        model.vis.quality.shadowsize = 0
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        # Runs at exit too, and there before MuJoCo's own handler, registered earlier, ends the display.
        self._free = weakref.finalize(self, _free, self._gl, self._context)
        self._free.atexit = False
        atexit.register(self._free)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._size = (0, 0)
        self._data = mujoco.MjData(model)
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SKYBOX] = False
        self._hidden = hidden_groups
        self._update_scene(hidden_groups)

    def render_rgb(self, T_world_from_camera: Array, pinhole: Pinhole) -> NDArray[np.uint8]:
        """Colour image ``[H, W, 3]`` of a camera with OpenCV axes."""
        width, height = pinhole.width * self._scale, pinhole.height * self._scale
        rgb = np.empty((height, width, 3), dtype=np.uint8)
        self._draw(T_world_from_camera, pinhole, width, height, rgb=rgb)
        upright = rgb[::-1]
        if self._scale == 1:
            return np.ascontiguousarray(upright)
        size = (pinhole.width, pinhole.height)
        return np.asarray(cv2.resize(upright, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def render_depth(self, T_world_from_camera: Array, pinhole: Pinhole) -> NDArray[np.float32]:
        """Distance along the optical axis ``[H, W]`` [m] at pixel centres; ``inf`` where nothing is hit."""
        depth = np.empty((pinhole.height, pinhole.width), dtype=np.float32)
        flags = self._scene.flags.copy()
        # Drawing colours that name the geoms switches multisampling off, so depth is taken at pixel centres.
        self._scene.flags[self._mujoco.mjtRndFlag.mjRND_SEGMENT] = True
        self._scene.flags[self._mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        try:
            self._draw(T_world_from_camera, pinhole, pinhole.width, pinhole.height, depth=depth)
        finally:
            np.copyto(self._scene.flags, flags)
        # Reversed depth buffer d in 0 (far) .. 1 (near): 1 / z is linear in d.
        d = depth[::-1].astype(np.float64)
        near, far = self._range_m
        inverse = d * (1.0 / near - 1.0 / far) + 1.0 / far
        return np.where(d > 0.0, 1.0 / inverse, np.inf).astype(np.float32)

    def set_texture(self, name: str, rgb: NDArray[np.uint8]) -> None:
        """Replace a 2D texture by a picture ``[h, w, 3]``, resampled to the texture's size."""
        mujoco, model = self._mujoco, self._model
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXTURE, name)
        if index < 0:
            raise ValueError(f"expected the name of a texture of the model, got {name!r}")
        width, height, start = (
            int(model.tex_width[index]),
            int(model.tex_height[index]),
            int(model.tex_adr[index]),
        )
        model.tex_data[start : start + 3 * width * height] = textures.fit(rgb, width, height).ravel()
        self._gl.make_current()
        mujoco.mjr_uploadTexture(model, self._context, index)

    def place(self, body: str, T_world_from_body: Array, hidden_groups: tuple[int, ...]) -> None:
        """Move a mocap body and choose which geom groups are hidden from now on."""
        index = int(self._model.body(body).mocapid[0])
        self._data.mocap_pos[index] = T_world_from_body[:3, 3]
        self._mujoco.mju_mat2Quat(
            self._data.mocap_quat[index], np.ascontiguousarray(T_world_from_body[:3, :3]).ravel()
        )
        self._update_scene(hidden_groups)

    def close(self) -> None:
        """Free the OpenGL resources; safe to call twice."""
        atexit.unregister(self._free)
        self._free()

    def _update_scene(self, hidden_groups: tuple[int, ...]) -> None:
        mujoco = self._mujoco
        option = mujoco.MjvOption()
        option.geomgroup[:] = [0 if group in hidden_groups else 1 for group in range(len(option.geomgroup))]
        mujoco.mj_forward(self._model, self._data)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self._model, self._data, option, None, mujoco.MjvCamera(), everything, self._scene
        )

    def _draw(
        self,
        T_world_from_camera: Array,
        pinhole: Pinhole,
        width: int,
        height: int,
        rgb: NDArray[np.uint8] | None = None,
        depth: NDArray[np.float32] | None = None,
    ) -> None:
        if not self._free.alive:
            raise RuntimeError("this renderer is closed; make a new Lab")
        mujoco = self._mujoco
        self._gl.make_current()
        if self._size != (width, height):
            mujoco.mjr_resizeOffscreen(width, height, self._context)
            self._size = (width, height)
        _aim(self._scene, T_world_from_camera, pinhole, self._range_m)
        viewport = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(viewport, self._scene, self._context)
        mujoco.mjr_readPixels(rgb, depth, viewport, self._context)


def _free(gl: Any, context: Any) -> None:
    gl.make_current()
    context.free()
    gl.free()


def _aim(scene: Any, T_world_from_camera: Array, pinhole: Pinhole, range_m: tuple[float, float]) -> None:
    """Set both eyes of the scene to a pinhole camera by its frustum at the near plane."""
    near, far = range_m
    for eye in scene.camera:
        eye.pos = T_world_from_camera[:3, 3]
        eye.forward = T_world_from_camera[:3, 2]
        eye.up = -T_world_from_camera[:3, 1]
        eye.orthographic = 0
        eye.frustum_near, eye.frustum_far = near, far
        eye.frustum_center = (0.5 * pinhole.width - pinhole.cx) / pinhole.fx * near
        eye.frustum_width = 0.5 * pinhole.width / pinhole.fx * near
        eye.frustum_top = pinhole.cy / pinhole.fy * near
        eye.frustum_bottom = -(pinhole.height - pinhole.cy) / pinhole.fy * near
