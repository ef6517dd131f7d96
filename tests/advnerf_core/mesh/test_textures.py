"""Textures of meshes: against the rasteriser of `objects`, dense matrices, finite differences, and files."""

from pathlib import Path

import numpy as np
import pytest
import torch

from advnerf_core.geometry import make_transform, rotation_x, rotation_z
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.glb import glb_bytes
from advnerf_core.objects.mesh.surface import sphere, unwrapped
from advnerf_core.objects.voxel.generators import hydrant, small_car
from advnerf_core.objects.voxel.mesh import MeshError, SurfaceMesh, part_from_colours
from advnerf_core.objects.voxel.mesh_files import load_mesh
from advnerf_core.objects.voxel.rasterise import draw_mesh
from advnerf_core.objects.voxel.views import dome, viewing_lens
from advnerf_core.scene.surrogate import Surrogate
from tests.support.glb import mesh_from_glb

from .conftest import PINHOLE, POSE

SHARED = Path(__file__).parents[4] / "shared" / "data" / "models"


def drawn(field, poses, pinhole, supersample=3):
    cast = field.cast(poses, pinhole, supersample, np.float64)
    picture = np.zeros((len(poses) * pinhole.height * pinhole.width, 4))
    picture[cast.pixels, :3] = cast.weights @ field.mesh.texture.reshape(-1, 3).astype(np.float64)
    picture[cast.pixels, 3] = cast.alpha
    return picture.reshape(len(poses), pinhole.height, pinhole.width, 4), cast


def psnr_db(a, b):
    return -10.0 * np.log10(np.mean(np.square(a - b)))


@pytest.mark.slow
def test_coverage_is_that_of_the_rasteriser_and_colours_come_near():
    for mesh, least_db in ((hydrant(), 28.0), (small_car(), 25.0)):
        poses, lens = dome(mesh.box, 3), viewing_lens(96)
        ours, _ = drawn(MeshField(unwrapped(mesh, 96), np.eye(4)), poses, lens)
        reference = draw_mesh(mesh, poses, lens)
        assert np.abs(ours[..., 3] - reference[..., 3]).max() <= 1 / 9 + 1e-6  # a ray on an edge at most
        assert np.abs(ours[..., 3] - reference[..., 3]).mean() < 1e-4
        assert psnr_db(ours[..., :3], reference[..., :3]) > least_db


def test_a_plain_sphere_has_its_colour_and_its_planar_depth():
    field = MeshField(
        unwrapped(sphere(0.4, (0.2, 0.3, 0.9), 4), 32), make_transform(np.eye(3), [0.0, 0.0, 2.0]), 0.5
    )
    pinhole = PINHOLE
    picture, cast = drawn(field, np.eye(4)[None], pinhole, 1)
    inside = picture[0, ..., 3] == 1.0
    np.testing.assert_allclose(
        picture[0][inside][:, :3], np.tile([0.2, 0.3, 0.9], (inside.sum(), 1)), atol=1e-6
    )
    # The centre of the ball is at z = 2 + 0.5 * 0.4, its radius 0.2.
    d = pinhole.directions().reshape(-1, 3)[cast.pixels]
    middle = np.array([0.0, 0.0, 2.2])
    dd, dm = (d * d).sum(1), d @ middle
    expected = (dm - np.sqrt(np.maximum(dm**2 - dd * (middle @ middle - 0.04), 0.0))) / dd
    far_from_edge = dm**2 - dd * (middle @ middle - 0.04) > 1e-2
    assert far_from_edge.sum() > 20
    np.testing.assert_allclose(cast.depth_m[far_from_edge], expected[far_from_edge], atol=2e-3)


def test_the_texture_gradient_is_exact(ball):
    generator = torch.Generator().manual_seed(1)
    rgb = torch.rand(2, 40, 80, 3, generator=generator, dtype=torch.float64)
    depth = torch.full((2, 40, 80), 1.7, dtype=torch.float64)
    poses = np.stack([np.eye(4), make_transform(rotation_z(0.2), [0.05, 0.0, -0.3])])
    scene = Surrogate(lambda p, c: (rgb, depth), PINHOLE, np.eye(4), ball, dtype=torch.float64)
    theta = torch.randn(ball.theta_shape, generator=generator, dtype=torch.float64)
    seed = torch.randn(2, 3, 40, 80, generator=generator, dtype=torch.float64)
    gradient = scene.render(poses, theta).vjp(seed)
    direction = torch.randn(ball.theta_shape, generator=generator, dtype=torch.float64)
    up, down = (scene.render(poses, theta + s * direction).images for s in (1e-5, -1e-5))
    expected = float(((up - down) * seed).sum() / 2e-5)
    assert abs(float((gradient * direction).sum()) / expected - 1.0) < 1e-7


def test_the_scene_hides_what_is_behind_it(ball):
    rgb, depth = torch.zeros(1, 40, 80, 3), torch.full((1, 40, 80), 5.0)
    depth[:, :, :43] = 0.5
    scene = Surrogate(lambda p, c: (rgb, depth), PINHOLE, np.eye(4), ball, depth_tolerance_m=0.0)
    image = scene.render(np.eye(4)[None], scene.plain_theta()).images[0]
    assert image[:, :, :43].abs().max() == 0.0
    assert image[:, :, 43:].abs().max() > 0.1


def test_texels_of_a_chart_never_mix_with_another(ball):
    cast = ball.cast(np.eye(4)[None], PINHOLE, 4, np.float64)
    charts = ball.mesh.charts.reshape(-1)
    assert (charts[cast.weights.indices[cast.weights.data > 0]] >= 0).all()
    pairs = ball.neighbours()
    assert (charts[pairs[:, 0]] == charts[pairs[:, 1]]).all()
    assert (pairs[:, 0] < pairs[:, 1]).all()


def test_out_of_sight_and_impossible_poses_see_nothing(ball):
    behind = make_transform(np.eye(3), [0.0, 0.0, 9.0])
    nowhere = np.full((4, 4), np.nan)
    aside = make_transform(np.eye(3), [50.0, 0.0, 0.0])
    cast = ball.cast(np.stack([behind, nowhere, aside, np.eye(4)]), PINHOLE, 2, np.float32)
    assert len(cast.pixels) > 20
    assert cast.pixels.min() >= 3 * 40 * 80


def test_a_moved_and_scaled_mesh_is_the_same_mesh_elsewhere(ball):
    move = make_transform(rotation_x(0.3), [0.1, -0.4, 0.7])
    here, _ = drawn(ball, np.eye(4)[None], PINHOLE)
    there, _ = drawn(ball.moved(move @ POSE), move[None], PINHOLE)
    assert np.abs(here - there).mean() < 1e-4
    stretched = make_transform(POSE[:3, :3], 2.0 * POSE[:3, 3])
    twice, _ = drawn(ball.moved(stretched, 2.0), np.eye(4)[None], PINHOLE)
    assert np.abs(here - twice).mean() < 1e-4
    assert ball.sha256 != ball.moved(stretched, 2.0).sha256


def test_a_glb_is_read_again_and_looks_the_same(ball, tmp_path):
    file = tmp_path / "found.glb"
    file.write_bytes(glb_bytes(ball.mesh))
    again = mesh_from_glb(file.read_bytes())
    assert len(again.vertices) == len(ball.mesh.vertices)  # welded, as it was
    here, first = drawn(ball, np.eye(4)[None], PINHOLE)
    there, second = drawn(MeshField(again, POSE), np.eye(4)[None], PINHOLE)
    assert np.array_equal(first.pixels, second.pixels)
    assert np.abs(here - there).max() < 0.6 / 255
    # Any other reader of meshes sees it too: upright, as large, of the same colours.
    strangers = load_mesh(file)
    np.testing.assert_allclose(
        strangers.size_m, ball.mesh.vertices.max(0) - ball.mesh.vertices.min(0), atol=1e-5
    )


def test_bad_meshes_are_refused():
    flat = part_from_colours(np.zeros((2, 3, 3)), np.ones((2, 3)))
    solid = sphere(0.3, (1.0, 0.0, 0.0), 0)
    with pytest.raises(MeshError, match="have an area"):
        unwrapped(SurfaceMesh((flat, part_from_colours(np.ones((1, 3, 3)), np.ones((1, 3))))))
    with pytest.raises(MeshError, match="2 to 512 texels"):
        unwrapped(solid, 1)
    with pytest.raises(MeshError, match="radius above zero"):
        sphere(-1.0, (0, 0, 0))
    mesh = unwrapped(solid)
    with pytest.raises(MeshError, match="expected a texture"):
        mesh.with_texture(np.zeros((2, 2, 3), np.float32))
    with pytest.raises(ValueError, match="rigid pose"):
        MeshField(mesh, 2.0 * np.eye(4))
    with pytest.raises(ValueError, match="theta of shape"):
        MeshField(mesh, np.eye(4)).check_theta(torch.zeros(3, 3))


@pytest.mark.parametrize("name", ["fire_hydrant", "hatchback_red", "suv"])
@pytest.mark.slow
def test_meshes_of_others_are_unwrapped(name):
    file = SHARED / f"{name}.glb"
    if not file.exists():
        pytest.skip(f"no {file}")
    mesh = load_mesh(file, up="z")  # these files ignore their format's convention
    poses, lens = dome(mesh.box, 2), viewing_lens(96)
    ours, _ = drawn(MeshField(unwrapped(mesh, 96), np.eye(4)), poses, lens)
    reference = draw_mesh(mesh, poses, lens)
    assert np.abs(ours[..., 3] - reference[..., 3]).mean() < 2e-3
    assert psnr_db(ours[..., :3], reference[..., :3]) > 25.0
