"""A camera of our own in a scene that pyglet's OpenGL draws: depth, several samples per pixel, panels and meshes. For Duckietown's simulator."""

from __future__ import annotations

import contextlib
import ctypes
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pyglet
from gym_duckietown.graphics import create_frame_buffers
from pyglet import gl

NEAR_M, FAR_M = 0.04, 100.0  # as in Duckietown's projection
_BACK = np.full((1, 1, 3), 51, np.uint8)  # of panels


class PygletView:
    """A frame buffer with colours and depth; each pixel is the mean of ``supersampling`` squared samples."""

    def __init__(self, lens: dict[str, Any], supersampling: int) -> None:
        if (lens["cx"], lens["cy"]) != (0.5 * lens["width"], 0.5 * lens["height"]) or lens["fx"] != lens[
            "fy"
        ]:
            raise ValueError(
                f"expected square pixels and a principal point in the middle of the picture, got {lens}"
            )
        self.fine, self.size = supersampling, (lens["width"] * supersampling, lens["height"] * supersampling)
        self.fov_y_deg = math.degrees(2.0 * math.atan(0.5 * lens["height"] / lens["fy"]))
        self.drawn, self.resolved = create_frame_buffers(*self.size, 1)
        # The buffer that the colours are copied to gets a depth buffer too.
        buffer = gl.GLuint(0)
        gl.glGenRenderbuffers(1, ctypes.byref(buffer))
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self.resolved)
        gl.glBindRenderbuffer(gl.GL_RENDERBUFFER, buffer)
        gl.glRenderbufferStorage(gl.GL_RENDERBUFFER, gl.GL_DEPTH_COMPONENT, *self.size)
        gl.glFramebufferRenderbuffer(gl.GL_FRAMEBUFFER, gl.GL_DEPTH_ATTACHMENT, gl.GL_RENDERBUFFER, buffer)
        gl.glPixelStorei(gl.GL_PACK_ALIGNMENT, 1)
        self.pixels = np.zeros((self.size[1], self.size[0], 3), np.uint8)

    def mean(self, fine: np.ndarray) -> np.ndarray:
        """Colours ``[H, W, 3]`` of the finer picture."""
        n, (width, height) = self.fine, self.size
        parts = fine.reshape(height // n, n, width // n, n, 3)
        return np.rint(parts.mean(axis=(1, 3), dtype=np.float32)).astype(np.uint8)

    def depth(self) -> np.ndarray:
        """Planar depth ``[H, W]`` [m] of what was drawn last; infinite where nothing was."""
        width, height = self.size
        gl.glBindFramebuffer(gl.GL_READ_FRAMEBUFFER, self.drawn)
        gl.glBindFramebuffer(gl.GL_DRAW_FRAMEBUFFER, self.resolved)
        box = (0, 0, width, height)
        gl.glBlitFramebuffer(*box, *box, gl.GL_DEPTH_BUFFER_BIT, gl.GL_NEAREST)
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self.resolved)
        share = np.zeros((height, width), np.float32)
        gl.glReadPixels(*box, gl.GL_DEPTH_COMPONENT, gl.GL_FLOAT, share.ctypes.data_as(ctypes.c_void_p))
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, 0)
        middle = slice(self.fine // 2, None, self.fine)
        share = share[::-1][middle, middle].astype(np.float64)
        depth_m = NEAR_M * FAR_M / (FAR_M - share * (FAR_M - NEAR_M))
        return np.where(share < 1.0, depth_m, np.inf).astype(np.float32)


class PygletPanel:
    """A textured rectangle that is lit like everything else; its back is plain."""

    def __init__(self, size_m: list[float], T_world_from_face: np.ndarray, rgb: np.ndarray) -> None:
        self._front, self._back = _texture(rgb[::-1], True), _texture(_BACK, False)
        R, at, u, v = T_world_from_face[:3, :3], T_world_from_face[:3, 3], 0.5 * size_m[0], 0.5 * size_m[1]
        self._normal = to_opengl(R[:, 0])
        # For a viewer left is against the face's y; the texture's origin is at its lower left.
        self._corners = [
            (s, t, to_opengl(at + (2.0 * s - 1.0) * u * R[:, 1] + (2.0 * t - 1.0) * v * R[:, 2]))
            for s, t in ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
        ]

    def render(self, draw_bbox: bool, segment: bool, enable_leds: bool) -> None:
        """Called by Duckietown for each of its objects."""
        with _textured(self._front):
            self._draw(self._corners, self._normal)
            gl.glBindTexture(gl.GL_TEXTURE_2D, self._back)
            self._draw(self._corners[::-1], -self._normal)

    def delete(self) -> None:
        """Give its memory back."""
        for each in (self._front, self._back):
            gl.glDeleteTextures(1, ctypes.byref(each))

    def _draw(self, corners: list[Any], normal: np.ndarray) -> None:
        """Draw one side of the panel. White always: the next object's white would count as no change of a colour that differs in between."""
        gl.glColor4f(1.0, 1.0, 1.0, 1.0)
        gl.glBegin(gl.GL_QUADS)
        gl.glNormal3f(*normal)
        for s, t, corner in corners:
            gl.glTexCoord2f(s, t)
            gl.glVertex3f(*corner)
        gl.glEnd()


class PygletMesh:
    """Triangles with one texture that are lit like everything else."""

    def __init__(self, corners_m: np.ndarray, normals: np.ndarray, uv: np.ndarray, rgb: np.ndarray) -> None:
        # Without coarser copies, in which the parts of a mesh's texture would mix.
        self._texture = _texture(rgb, False)
        flat = [to_opengl(each.reshape(-1, 3)).ravel().tolist() for each in (corners_m, normals)]
        places = uv.ravel().tolist()  # the first row of pixels is at 0
        self._triangles = pyglet.graphics.vertex_list(
            3 * len(corners_m), ("v3f/static", flat[0]), ("n3f/static", flat[1]), ("t2f/static", places)
        )

    def render(self, draw_bbox: bool, segment: bool, enable_leds: bool) -> None:
        """Called by Duckietown for each of its objects."""
        with _textured(self._texture):
            gl.glColor4f(1.0, 1.0, 1.0, 1.0)
            self._triangles.draw(gl.GL_TRIANGLES)

    def delete(self) -> None:
        """Give its memory back, which pyglet and OpenGL keep otherwise."""
        self._triangles.delete()
        gl.glDeleteTextures(1, ctypes.byref(self._texture))


@contextlib.contextmanager
def _textured(texture: Any) -> Iterator[None]:
    """Draw fronts with a texture, and leave all as it was: Duckietown draws its road with the normal and texture that were set last."""
    gl.glPushAttrib(gl.GL_ALL_ATTRIB_BITS)
    gl.glEnable(gl.GL_CULL_FACE)
    gl.glEnable(gl.GL_TEXTURE_2D)
    gl.glBindTexture(gl.GL_TEXTURE_2D, texture)
    try:
        yield
    finally:
        gl.glPopAttrib()


def _texture(rgb: np.ndarray, coarser: bool) -> Any:
    """A picture ``[h, w, 3]`` of any size, its first row at 0; with coarser copies of itself for far views, or without."""
    texture, pixels = gl.GLuint(), np.ascontiguousarray(rgb)
    gl.glGenTextures(1, ctypes.byref(texture))
    gl.glBindTexture(gl.GL_TEXTURE_2D, texture)
    for key, value in (
        (gl.GL_TEXTURE_MIN_FILTER, gl.GL_LINEAR_MIPMAP_LINEAR if coarser else gl.GL_LINEAR),
        (gl.GL_TEXTURE_MAG_FILTER, gl.GL_LINEAR),
        (gl.GL_TEXTURE_WRAP_S, gl.GL_CLAMP_TO_EDGE),
        (gl.GL_TEXTURE_WRAP_T, gl.GL_CLAMP_TO_EDGE),
    ):
        gl.glTexParameteri(gl.GL_TEXTURE_2D, key, value)
    gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
    form = (gl.GL_RGB, rgb.shape[1], rgb.shape[0], 0, gl.GL_RGB, gl.GL_UNSIGNED_BYTE)
    gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, *form, pixels.ctypes.data_as(ctypes.c_void_p))
    if coarser:
        gl.glGenerateMipmap(gl.GL_TEXTURE_2D)
    return texture


def to_opengl(points: np.ndarray) -> np.ndarray:
    """Points or directions ``[..., 3]`` in axes whose y points up and whose z points to the south."""
    return points[..., [0, 2, 1]] * np.array([1.0, 1.0, -1.0])


def taken_from() -> np.ndarray:
    """``T_world_from_camera`` of the view that OpenGL drew last."""
    held = (gl.GLdouble * 16)()
    gl.glGetDoublev(gl.GL_MODELVIEW_MATRIX, held)
    T = np.linalg.inv(np.array(held).reshape(4, 4).T)  # from OpenGL's camera to its axes
    to_ours = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    taken = np.eye(4)
    taken[:3, :3] = to_ours @ T[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    taken[:3, 3] = to_ours @ T[:3, 3]
    return taken
