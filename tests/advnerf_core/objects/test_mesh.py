"""Meshes from real files, their drawing against closed forms."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from advnerf_core.geometry import Pinhole, look_at
from advnerf_core.objects.voxel.generators import GENERATORS, hydrant, small_car
from advnerf_core.objects.voxel.mesh import (
    MeshError,
    SurfaceMesh,
    part_from_colours,
    stand,
    texture_colours,
)
from advnerf_core.objects.voxel.mesh_files import load_mesh
from advnerf_core.objects.voxel.rasterise import draw_mesh
from advnerf_core.objects.voxel.views import dome, ring, viewing_lens

MODELS = Path(__file__).parents[4] / "shared" / "data" / "models"


def textured_box(path, visual=None):
    box = trimesh.creation.box((0.4, 0.6, 1.0))
    if visual is not None:
        box.visual = visual(box)
    trimesh.Scene(box).export(path)
    return path


def test_a_mesh_without_textures_has_its_vertex_colours(tmp_path):
    def coloured(box):
        return trimesh.visual.ColorVisuals(box, vertex_colors=np.tile([200, 100, 50, 255], (8, 1)))

    mesh = load_mesh(textured_box(tmp_path / "box.ply", coloured), unit="m")
    np.testing.assert_allclose(mesh.size_m, [0.4, 0.6, 1.0], atol=1e-6)
    np.testing.assert_allclose(mesh.box[0], [-0.2, -0.3, 0.0], atol=1e-6)
    np.testing.assert_allclose(mesh.parts[0].texture[0, 0], [200 / 255, 100 / 255, 50 / 255], atol=1e-6)
    # glTF's colours are linear light: 200, 100 and 50 of 255 are displayed as 229, 168 and 122 (IEC 61966-2-1).
    linear = load_mesh(textured_box(tmp_path / "box.glb", coloured), up="z")
    np.testing.assert_allclose(255 * linear.parts[0].texture[0, 0], [229.1, 168.1, 122.4], atol=0.5)


def test_textures_are_embedded_and_scaled_meshes_stand_upright(tmp_path):
    def textured(box):
        image = Image.fromarray(np.full((4, 4, 3), (10, 200, 30), dtype=np.uint8))
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
        return trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)

    mesh = load_mesh(textured_box(tmp_path / "box.glb", textured), up="y", height_m=3.0)
    np.testing.assert_allclose(mesh.size_m, [5.0, 2.0, 3.0], atol=1e-5)
    np.testing.assert_allclose(mesh.parts[0].texture.reshape(-1, 3)[0] * 255, [10, 200, 30], atol=0.5)


def test_rows_of_a_texture_count_from_the_top_and_repeat():
    texture = np.zeros((2, 2, 3), dtype=np.float32)
    texture[0, 1] = 1.0  # top right
    got = texture_colours(texture, np.array([[0.75, 0.75], [0.25, 0.75], [0.75, 0.25], [1.75, -0.25]]))
    np.testing.assert_array_equal(got[:, 0], [1.0, 0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "found none"), (b"junk", "cannot read"), (b"", "cannot read"), ("empty", "got none")],
)
def test_what_is_not_a_mesh_is_one_error(tmp_path, content, message):
    path = tmp_path / "x.glb"
    if content == "empty":
        trimesh.Scene(trimesh.PointCloud(np.zeros((3, 3)))).export(path)
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(MeshError, match=message):
        load_mesh(path)


@pytest.mark.parametrize("scale", [np.nan, 1e9, 0.0])
def test_sizes_that_no_object_has_are_refused(scale):
    part = part_from_colours(scale * np.ones((1, 3, 3)) * np.arange(3)[None, :, None], np.ones((1, 3)))
    with pytest.raises(MeshError, match="expected"):
        stand(SurfaceMesh((part,)))
    with pytest.raises(MeshError, match="height above zero"):
        load_mesh(Path("any.glb"), height_m=scale if not np.isfinite(scale) else -1.0)


@pytest.mark.parametrize("name", GENERATORS)
def test_generated_objects_stand_on_the_floor(name):
    mesh = GENERATORS[name]()
    assert mesh.box[0][2] == pytest.approx(0.0, abs=1e-6)
    assert np.abs(mesh.box[0] + mesh.box[1])[1] < 1e-6  # left and right alike


def test_generated_objects_have_the_size_of_real_ones():
    assert hydrant().size_m[2] == pytest.approx(0.75)
    assert small_car().size_m[0] == pytest.approx(3.6, rel=0.02)


def test_a_square_covers_the_pixels_that_projection_says():
    corners = np.array(
        [[[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0]], [[-0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]]
    )
    mesh = SurfaceMesh((part_from_colours(corners, np.array([[1.0, 0.5, 0.0]] * 2)),))
    pose = np.eye(4)
    pose[2, 3] = -2.0  # two metres before it, looking along +z
    image = draw_mesh(mesh, pose[None], Pinhole(40, 30, 40.0, 40.0, 20.0, 15.0), supersample=2)[0]
    expected = np.zeros((30, 40))
    expected[5:25, 10:30] = 1.0
    np.testing.assert_array_equal(image[..., 3], expected)
    np.testing.assert_allclose(image[15, 20], [1.0, 0.5, 0.0, 1.0])


def test_drawing_leaves_the_threads_of_others_alone():
    """A kernel of OpenMP would set the thread count of every library of the process that shares it, torch's too."""
    program = (
        "import numpy as np, torch\nfrom advnerf_core.geometry import Pinhole\n"
        "from advnerf_core.objects.voxel.generators import hydrant\nfrom advnerf_core.objects.voxel.rasterise import draw_mesh\n"
        "pose = np.eye(4)[None]\npose[0, 2, 3] = -3.0\n"
        "draw_mesh(hydrant(), pose, Pinhole(40, 30, 40.0, 40.0, 20.0, 15.0))\nprint(torch.get_num_threads())"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    told = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, env=environment, check=True
    )
    assert told.stdout.split() == ["1"]


def test_the_nearer_surface_wins_and_perspective_bends_the_texture():
    near = part_from_colours(np.array([[[-9.0, -9, 1], [9, -9, 1], [0, 9, 1]]]), np.array([[1.0, 0, 0]]))
    far = part_from_colours(np.array([[[-9.0, -9, 2], [9, -9, 2], [0, 9, 2]]]), np.array([[0, 1.0, 0]]))
    lens = Pinhole(8, 8, 8.0, 8.0, 4.0, 4.0)
    for parts in ((near, far), (far, near)):
        image = draw_mesh(SurfaceMesh(parts), np.eye(4)[None], lens, 1)[0]
        np.testing.assert_array_equal(image[4, 4], [1.0, 0.0, 0.0, 1.0])
    # A floor that runs away from the camera: where a ray meets it follows from similar triangles.
    floor = np.array([[[-5.0, 1, 1], [5, 1, 1], [5, 1, 9]], [[-5.0, 1, 1], [5, 1, 9], [-5, 1, 9]]])
    uv = np.array([[[0.0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    ramp = np.repeat(np.linspace(1.0, 0.0, 800)[:, None, None], 3, axis=2).astype(np.float32)
    mesh = SurfaceMesh((type(near)(floor, uv, ramp),))
    image = draw_mesh(mesh, np.eye(4)[None], Pinhole(9, 100, 50.0, 50.0, 4.5, 20.0), 1)[0]
    for row in (40, 60, 69):
        z = 50.0 / (row + 0.5 - 20.0)
        assert image[row, 4, 0] == pytest.approx((z - 1.0) / 8.0, abs=2e-3)


def test_a_sphere_has_the_outline_of_a_sphere():
    ball = trimesh.creation.icosphere(4, radius=0.5)
    triangles = ball.vertices[ball.faces]
    mesh = SurfaceMesh((part_from_colours(triangles, np.ones((len(triangles), 3))),))
    distance, f = 2.0, 100.0
    image = draw_mesh(
        mesh, look_at(np.array([distance, 0, 0.0]), np.zeros(3))[None], Pinhole(100, 100, f, f, 50, 50), 3
    )
    radius = f * 0.5 / np.sqrt(distance**2 - 0.25)
    assert image[0, ..., 3].sum() == pytest.approx(np.pi * radius**2, rel=0.01)


def test_cameras_look_at_the_object_from_around_it():
    box = (np.array([-1.0, -1, 0]), np.array([1.0, 1, 2]))
    for poses in (ring(box, 6), dome(box, 20)):
        to_centre = np.array([0, 0, 1.0]) - poses[:, :3, 3]
        np.testing.assert_allclose(
            poses[:, :3, 2], to_centre / np.linalg.norm(to_centre, axis=1, keepdims=True), atol=1e-12
        )
        np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0)
    with pytest.raises(ValueError, match="straight above or below"):
        look_at(np.array([0, 0, 3.0]), np.zeros(3))


@pytest.mark.skipif(not MODELS.exists(), reason="the shared models are not here")
@pytest.mark.parametrize(
    ("name", "size_m"),
    [("fire_hydrant", (0.42, 0.42, 0.93)), ("hatchback_red", (2.14, 4.0, 1.57)), ("suv", (2.6, 5.0, 2.2))],
)
def test_models_from_the_world(name, size_m):
    mesh = load_mesh(MODELS / f"{name}.glb", up="z")  # these files ignore their format's convention
    np.testing.assert_allclose(mesh.size_m, size_m, atol=0.05)
    assert all(min(part.texture.shape[:2]) > 100 for part in mesh.parts)
    assert 0.05 < draw_mesh(mesh, ring(mesh.box, 1), viewing_lens(64))[0, ..., 3].mean() < 0.6
