"""A camera of our own in a Panda3D scene: any pose, colours and metric depth, several samples per pixel, panels and meshes. For simulators on Panda3D."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from panda3d.core import (
    Camera,
    CardMaker,
    FrameBufferProperties,
    Geom,
    GeomNode,
    GeomTriangles,
    GeomVertexData,
    GeomVertexFormat,
    GraphicsOutput,
    GraphicsPipe,
    LMatrix4f,
    NodePath,
    PerspectiveLens,
    Texture,
    WindowProperties,
)

NEAR_M, SKY_M, FAR_M = 0.2, 30_000.0, 1000.0


class PandaView:
    """One camera: each pixel is the mean of ``supersampling`` squared samples; its depth is the middle sample's."""

    def __init__(self, engine: Any, name: str, lens: dict[str, Any], supersampling: int, mask: Any) -> None:
        width, height, self._fine = lens["width"], lens["height"], supersampling
        if (lens["cx"], lens["cy"]) != (0.5 * width, 0.5 * height):
            raise ValueError(f"expected a principal point in the middle of the picture, got {lens}")
        properties, size = FrameBufferProperties(), (width * supersampling, height * supersampling)
        properties.setRgbaBits(8, 8, 8, 8)
        properties.setDepthBits(24)
        self.buffer = engine.graphicsEngine.makeOutput(
            engine.pipe, name, -2, properties, WindowProperties.size(*size), GraphicsPipe.BFRefuseWindow, engine.win.getGsg(), engine.win
        )  # fmt: skip
        self._colour, self._depth = Texture(), Texture()
        self.buffer.addRenderTexture(self._colour, GraphicsOutput.RTMCopyRam, GraphicsOutput.RTPColor)
        self.buffer.addRenderTexture(self._depth, GraphicsOutput.RTMCopyRam, GraphicsOutput.RTPDepth)
        self.buffer.setClearColor((0.5, 0.7, 1.0, 1.0))
        film = PerspectiveLens()
        film.setFov(
            *(
                math.degrees(2.0 * math.atan(0.5 * n / f))
                for n, f in ((width, lens["fx"]), (height, lens["fy"]))
            )
        )
        film.setNearFar(NEAR_M, SKY_M)
        self.node = engine.render.attachNewNode(Camera(name, film))
        self.node.node().setCameraMask(mask)
        self.buffer.makeDisplayRegion().setCamera(self.node)
        self.buffer.setActive(False)
        self._size, self._tones = size, _tone_table(255 * supersampling**2)

    def aim(self, T: np.ndarray) -> np.ndarray:
        """Put the camera at ``T_world_from_camera``; returns its pose afterwards."""
        right, forward, up, at = T[:3, 0], T[:3, 2], -T[:3, 1], T[:3, 3]
        self.node.setMat(_matrix(right, forward, up, at))
        found = np.array(self.node.getMat(self.node.getTop())).reshape(4, 4)
        taken = np.eye(4)
        taken[:3] = np.column_stack([found[0, :3], -found[2, :3], found[1, :3], found[3, :3]])
        return taken

    def picture(self) -> np.ndarray:
        """Colours ``[H, W, 3]`` of the last frame, through MetaDrive's tone curve."""
        width, height = self._size
        bgra = np.frombuffer(self._colour.getRamImage(), np.uint8).reshape(height, width, -1)[::-1]
        fine, total = self._fine, np.zeros((height // self._fine, width // self._fine, 3), np.uint16)
        for row in range(fine):
            for column in range(fine):
                total += bgra[row::fine, column::fine, 2::-1]
        return self._tones[total]

    def depth(self) -> np.ndarray:
        """Planar depth ``[H, W]`` [m] of the last frame; infinite from `FAR_M` on."""
        width, height = self._size
        if self._depth.getComponentType() == Texture.T_float:
            share = np.frombuffer(self._depth.getRamImage(), np.float32).astype(np.float64)
        else:
            share = np.frombuffer(self._depth.getRamImage(), np.uint32) / (2.0**32 - 1.0)
        middle = slice(self._fine // 2, None, self._fine)
        share = share.reshape(height, width)[::-1][middle, middle]
        depth_m = NEAR_M * SKY_M / (SKY_M - share * (SKY_M - NEAR_M))
        return np.where(depth_m < FAR_M, depth_m, np.inf).astype(np.float32)


def panel_card(name: str, size_m: list[float], T_world_from_face: np.ndarray, rgb: np.ndarray) -> Any:
    """A card of this size and texture, lit like everything else in linear light; its back is plain."""
    root, maker = NodePath(name), CardMaker(name)
    maker.setFrame(-0.5 * size_m[0], 0.5 * size_m[0], -0.5 * size_m[1], 0.5 * size_m[1])
    maker.setHasNormals(True)
    root.attachNewNode(maker.generate()).setTexture(_texture(name, rgb))
    back = root.attachNewNode(maker.generate())
    back.setH(180.0)
    back.setColor(0.2, 0.2, 0.2, 1.0)
    # For a viewer who looks along a card's y, its x is to the right and its z is up: against the face's x.
    R = T_world_from_face[:3, :3]
    root.setMat(_matrix(R[:, 1], -R[:, 0], R[:, 2], T_world_from_face[:3, 3]))
    return root


def mesh_node(name: str, corners_m: np.ndarray, normals: np.ndarray, uv: np.ndarray, rgb: np.ndarray) -> Any:
    """Triangles in the world with one texture, lit like everything else in linear light."""
    # Panda3D counts a texture's rows from below.
    vertices = np.concatenate([corners_m, normals, uv * [1.0, -1.0] + [0.0, 1.0]], axis=2)
    vertices = vertices.reshape(-1, 8).astype(np.float32)
    data = GeomVertexData(name, GeomVertexFormat.getV3n3t2(), Geom.UHStatic)
    data.unclean_set_num_rows(len(vertices))
    memoryview(data.modify_array(0)).cast("B")[:] = vertices.tobytes()
    triangles = GeomTriangles(Geom.UHStatic)
    triangles.add_next_vertices(len(vertices))
    geometry, node = Geom(data), GeomNode(name)
    geometry.add_primitive(triangles)
    node.add_geom(geometry)
    root = NodePath(node)
    texture = _texture(name, rgb)
    texture.setMinfilter(Texture.FTLinear)  # coarser copies would mix the parts of its texture
    root.setTexture(texture)
    return root


def _texture(name: str, rgb: np.ndarray) -> Texture:
    """A picture ``[h, w, 3]`` of display values."""
    texture = Texture(name)
    texture.setup2dTexture(rgb.shape[1], rgb.shape[0], Texture.T_unsigned_byte, Texture.F_srgb)
    texture.setRamImage(np.ascontiguousarray(rgb[::-1, :, ::-1]).tobytes())
    texture.setMinfilter(Texture.FTLinearMipmapLinear)
    texture.setWrapU(Texture.WMClamp)
    texture.setWrapV(Texture.WMClamp)
    return texture


def _matrix(x: np.ndarray, y: np.ndarray, z: np.ndarray, origin: np.ndarray) -> Any:
    """Panda3D's matrix of a frame: axes and origin are its rows."""
    return LMatrix4f(*np.column_stack([[x, y, z, origin], [0.0, 0.0, 0.0, 1.0]]).ravel().tolist())


def _tone_table(largest: int) -> np.ndarray:
    """The tone curve of MetaDrive's renderer (simplepbr's, after Hejl and Burgess-Dawson), for sums of linear samples up to ``largest``."""
    x = np.maximum(np.arange(largest + 1) / largest - 0.004, 0.0)
    return np.rint(255.0 * (x * (6.2 * x + 0.5)) / (x * (6.2 * x + 1.7) + 0.06)).astype(np.uint8)
