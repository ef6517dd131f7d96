"""MuJoCo 4.0.0's renderer Filament on software Vulkan for ``serve.py``: draws a MuJoCo scene that is sent as files, physically based.

Runs in a separate environment, and imports nothing of advnerf. Nothing moves here: the car drives in the other process.
"""

from __future__ import annotations

from typing import Any

import mujoco
import mujoco.studio
import numpy as np
from mujoco import mjrf

SCENE = "room.xml"
NEAR_M, FAR_M = 0.02, 30.0
BACK_M, BACK_RGB = 0.005, (0.2, 0.2, 0.2)
# MuJoCo 4's default lighting for scenes whose lights have no intensities [lux]: its environment, and all lights together.
_ENVIRONMENT_LX, _LIGHTS_LX = 5000.0, 80000.0
_COLOURS, _NUMBERS = mjrf.PixelFormat.PIXEL_FORMAT_RGB8, mjrf.PixelFormat.PIXEL_FORMAT_R32F
Reply = tuple[dict[str, Any], dict[str, np.ndarray]]


def open_simulator(config: dict[str, Any], cameras: dict[str, Any], **files: np.ndarray) -> Room:
    """The scene ``room.xml`` with the pictures that it names, as bytes."""
    return Room(config, cameras, {name: data.tobytes() for name, data in files.items()})


class Room:
    """One static scene; see docs/worlds.md for the calls."""

    def __init__(self, config: dict[str, Any], cameras: dict[str, Any], files: dict[str, bytes]) -> None:
        asked = mjrf.ContextConfig()
        asked.graphics_api, asked.software_rendering = mjrf.GraphicsApi.GRAPHICS_API_VULKAN, True
        self._context = mjrf.Context(asked)
        self._context.set_clear_color(np.zeros(3, np.float32))
        self._scene = self._context.create_scene(mjrf.SceneParams())
        self._fill(_model(config, files))
        fine = config["lab"]["supersampling"]
        self._views = {
            name: FilamentView(self._context, self._scene, lens, fine) for name, lens in cameras.items()
        }
        self._added: dict[str, tuple[tuple[Any, ...], tuple[Any, ...]]] = {}

    def _fill(self, model: Any) -> None:
        """Put the model into the scene; its parts must stay referenced while it is drawn."""
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        resources = mjrf.ModelResources(self._context, model)
        self._scene.configure_from_model(model)
        lights = mjrf.ModelLights(self._scene, resources)
        solids = mjrf.ModelRenderables(self._scene, resources)
        lights.update(data)
        solids.update(data)
        self._kept = (model, data, resources, lights, solids)

    def describe(self) -> Reply:
        """Name of the renderer."""
        return {"simulator": f"Filament of MuJoCo {mujoco.mj_versionString()}"}, {}

    def render(self, camera: str, depth: bool, T_world_from_camera: np.ndarray) -> Reply:
        """A picture, and its depth if requested."""
        view = self._views[camera]
        eye = view.aimed(T_world_from_camera)
        found = {"rgb": view.rgb(eye), "T_world_from_camera": _pose_of(eye)}
        if depth:
            found["depth"] = view.depth(eye)
        return {}, found

    def add_panel(self, name: str, size_m: list[float] | None, **arrays: np.ndarray) -> Reply:
        """Put a panel with ``T_world_from_face`` and texture ``rgb`` into the scene; without a size, remove it."""
        return self._add(f"panel {name}", *(((), ()) if size_m is None else self._panel(size_m, **arrays)))

    def add_mesh(self, name: str, **arrays: np.ndarray) -> Reply:
        """Put triangles ``corners_m``, with ``normals``, ``uv`` and texture ``rgb``, into the scene; without them, take them out."""
        return self._add(f"mesh {name}", *(self._mesh(**arrays) if arrays else ((), ())))

    def _add(self, name: str, solids: tuple[Any, ...], kept: tuple[Any, ...]) -> Reply:
        """Put solids into the scene in place of those of this name; what they are drawn with must stay referenced."""
        before = self._added.pop(name, ((), ()))
        for solid in before[0]:
            self._scene.remove_renderable(solid)
        if solids:
            self._added[name] = solids, kept
        for solid in solids:
            self._scene.add_renderable(solid)
        return {}, {}

    def _mesh(self, corners_m: np.ndarray, normals: np.ndarray, uv: np.ndarray, rgb: np.ndarray) -> Any:
        """Triangles that are lit like other matte surfaces, and their mesh and texture."""
        vertices = np.concatenate([corners_m, _tangents(normals), uv], axis=2).astype(np.float32)
        count, usage, form = 3 * len(corners_m), mjrf.VertexAttributeUsage, mjrf.VertexAttributeType
        config = mjrf.MeshConfig(
            max_vertices=count,
            max_indices=count,
            attributes=[
                mjrf.VertexAttribute(
                    usage.VERTEX_ATTRIBUTE_USAGE_POSITION, form.VERTEX_ATTRIBUTE_TYPE_FLOAT3
                ),
                mjrf.VertexAttribute(
                    usage.VERTEX_ATTRIBUTE_USAGE_TANGENTS, form.VERTEX_ATTRIBUTE_TYPE_FLOAT4
                ),
                mjrf.VertexAttribute(usage.VERTEX_ATTRIBUTE_USAGE_UV, form.VERTEX_ATTRIBUTE_TYPE_FLOAT2),
            ],
            interleaved=True,
            index_type=mjrf.IndexType.INDEX_TYPE_U32,
            primitive_type=mjrf.MeshPrimitiveType.MESH_PRIMITIVE_TYPE_TRIANGLES,
        )
        low, high = (edge(corners_m, axis=(0, 1)).astype(np.float32) for edge in (np.min, np.max))
        mesh, data = self._context.create_mesh(config), mjrf.MeshData(False, low, high)
        data.set_vertices(config, vertices.tobytes())
        data.set_indices(config, np.arange(count, dtype=np.uint32).tobytes())
        mesh.upload(data)
        solid, texture = self._context.create_renderable(mjrf.RenderableParams()), self._texture(rgb)
        solid.set_mesh(mesh, 0, count)
        solid.set_material(_matte(texture))
        return (solid,), (mesh, texture)

    def _panel(self, size_m: list[float], T_world_from_face: np.ndarray, rgb: np.ndarray) -> Any:
        """A face that is lit like other matte surfaces with a plain thin box behind it, and the face's texture."""
        half_m = 0.5 * size_m[0], 0.5 * size_m[1]
        # A plane faces its z; its x is to the viewer's right, which is the face's y.
        axes, place = T_world_from_face[:3, [1, 2, 0]], T_world_from_face[:3, 3]
        face = self._solid(mujoco.mjtGeom.mjGEOM_PLANE, (*half_m, 1.0), place, axes)
        back = self._solid(
            mujoco.mjtGeom.mjGEOM_BOX, (*half_m, 0.5 * BACK_M), place - 0.6 * BACK_M * axes[:, 2], axes
        )
        texture = self._texture(rgb)
        face.set_material(_matte(texture))
        back.set_material(_matte(None))
        return (face, back), (texture,)

    def _solid(self, kind: Any, half_m: tuple[float, ...], place: np.ndarray, axes: np.ndarray) -> Any:
        quality = self._kept[0].vis.quality
        solid = self._context.create_renderable(mjrf.RenderableParams())
        solid.set_geom_mesh(kind, quality.numstacks, quality.numslices, quality.numquads)
        solid.set_size(np.array(half_m, np.float32))
        solid.set_pose(place.astype(np.float32), axes.astype(np.float32).ravel())
        return solid

    def _texture(self, rgb: np.ndarray) -> Any:
        """A picture ``[h, w, 3]`` of display values."""
        form = mjrf.TextureConfig(
            width=rgb.shape[1],
            height=rgb.shape[0],
            format=_COLOURS,
            color_space=mjrf.ColorSpace.COLORSPACE_SRGB,
            sampler_type=mjrf.SamplerType.TEXTURE_2D,
        )
        texture, data = self._context.create_texture(form), mjrf.TextureData()
        data.set_image(rgb.tobytes())
        texture.upload(data)
        return texture


def _matte(texture: Any) -> Any:
    """A matte material with a texture; without one it has the plain colour of a back."""
    matte = mjrf.Material()
    matte.specular = matte.glossiness = matte.reflectance = matte.emissive = 0.0
    if texture is None:
        matte.color = np.array([*BACK_RGB, 1.0], np.float32)
    else:
        matte.color_texture = texture
    return matte


def _tangents(normals: np.ndarray) -> np.ndarray:
    """Quaternions (x, y, z, w) ``[F, 3, 4]`` that turn the z axis to the normals: Filament takes tangent frames in place of normals."""
    w = np.maximum(1.0 + normals[..., 2], 1e-4)  # a positive w says that the frame is not mirrored
    turns = np.stack([-normals[..., 1], normals[..., 0], np.zeros_like(w), w], axis=-1)
    below = normals[..., 2] < -0.9999
    turns[below] = [1.0, 0.0, 0.0, 1e-4]
    return np.asarray(turns / np.linalg.norm(turns, axis=-1, keepdims=True))


class FilamentView:
    """A lens, with a target for colours, each the mean of ``supersampling`` squared ones, and one for depth at pixel centres."""

    def __init__(self, context: Any, scene: Any, lens: dict[str, Any], supersampling: int) -> None:
        self._context, self._scene, self._lens, self._fine = context, scene, lens, supersampling
        height, width = lens["height"], lens["width"]
        self._colours = RenderTarget(
            context, np.zeros((supersampling * height, supersampling * width, 3), np.uint8)
        )
        self._nearness = RenderTarget(context, np.zeros((height, width), np.float32))
        share = np.arange(255 * supersampling**2 + 1) / (255.0 * supersampling**2)
        curve = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1.0 / 2.4) - 0.055)
        self._display = np.rint(255.0 * curve).astype(np.uint8)

    def aimed(self, T_world_from_camera: np.ndarray) -> Any:
        """A camera at a pose, with the lens as its frustum at the near plane."""
        lens, T = self._lens, T_world_from_camera.astype(np.float32)
        across, down = NEAR_M / lens["fx"], NEAR_M / lens["fy"]
        return mjrf.Camera(
            pos=T[:3, 3],
            forward=T[:3, 2],
            up=-T[:3, 1],
            frustum_center=(0.5 * lens["width"] - lens["cx"]) * across,
            frustum_width=0.5 * lens["width"] * across,
            frustum_top=lens["cy"] * down,
            frustum_bottom=(lens["cy"] - lens["height"]) * down,
            frustum_near=NEAR_M,
            frustum_far=FAR_M,
        )

    def rgb(self, eye: Any) -> np.ndarray:
        """Colours ``[H, W, 3]``: the light of all samples of a pixel, then the curve of a display."""
        self._draw(eye, self._colours, mjrf.DrawMode.DRAW_MODE_DEFAULT)
        n, (height, width) = self._fine, self._nearness.buffer.shape
        light = self._colours.buffer.reshape(height, n, width, n, 3).sum(axis=(1, 3), dtype=np.int32)
        return self._display[light]

    def depth(self, eye: Any) -> np.ndarray:
        """Planar depth ``[H, W]`` [m]; infinite where nothing is."""
        self._draw(eye, self._nearness, mjrf.DrawMode.DRAW_MODE_DEPTH)
        # The target has 1 at the nearest and 0 at the farthest depth; between them the inverse of depth is linear.
        share = self._nearness.buffer.astype(np.float64)
        depth_m = 1.0 / (share * (1.0 / NEAR_M - 1.0 / FAR_M) + 1.0 / FAR_M)
        return np.where(share > 0.0, depth_m, np.inf).astype(np.float32)

    def _draw(self, eye: Any, target: RenderTarget, mode: Any) -> None:
        height, width = target.buffer.shape[:2]
        request = mjrf.RenderRequest(
            scene=self._scene,
            camera=eye,
            target=target.target,
            viewport=mjrf.Rect(0, 0, width, height),
            draw_mode=mode,
            post_processing=False,  # its dithering differs from frame to frame, so that no picture could be repeated
            reflections=False,
            shadows=False,
            skybox=False,
            haze=False,
            headlight=False,
        )
        self._context.wait_for_frame(self._context.render([request], [target.reading]))


class RenderTarget:
    """The target of a frame, and the array that it is read into."""

    def __init__(self, context: Any, buffer: np.ndarray) -> None:
        self.buffer = buffer
        height, width = buffer.shape[:2]
        form = _COLOURS if buffer.dtype == np.uint8 else _NUMBERS
        self.target = context.create_render_target(
            mjrf.RenderTargetConfig(width=width, height=height, color_format=form)
        )
        self.target.resize(width, height)
        self.reading = mjrf.ReadRequest(target=self.target)
        self.reading.set_buffer(buffer)


def _model(config: dict[str, Any], files: dict[str, bytes]) -> Any:
    """The scene with the settings for Filament."""
    spec = mujoco.MjSpec.from_string(files[SCENE].decode(), assets=files)
    for texture in spec.textures:
        # Pictures of the scene are display values; Filament computes with light.
        texture.colorspace = mujoco.mjtColorSpace.mjCOLORSPACE_SRGB
    for name, value in {
        "ao.enabled": float(config["ambient_occlusion"]),
        "fallback.environment_light_intensity": _ENVIRONMENT_LX * config["brightness"],
        "fallback.scene_light_intensity": _LIGHTS_LX * config["brightness"],
        # The scene's emission corrects the lighting of another renderer; here it would be white light.
        "phong.emissive_multiplier": 0.0,
    }.items():
        spec.add_numeric(name=f"filament.{name}", data=[value])
    return spec.compile()


def _pose_of(eye: Any) -> np.ndarray:
    """``T_world_from_camera`` of a camera, with axes x right, y down, z forward."""
    T, forward, up = np.eye(4), np.asarray(eye.forward, np.float64), np.asarray(eye.up, np.float64)
    T[:3, :3] = np.stack([np.cross(forward, up), -up, forward], axis=1)
    T[:3, 3] = eye.pos
    return T
