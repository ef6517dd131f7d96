"""Voxels, fits and files of objects."""

import numpy as np
import pytest
import trimesh

from advnerf_core.objects.build import agreement_db, build_from_images, build_from_mesh, draw_object, mesh_views
from advnerf_core.objects.fit import FitError, PosedRgba, fit_grids
from advnerf_core.objects.generators import hydrant
from advnerf_core.objects.hull import visual_hull
from advnerf_core.objects.mesh import MeshError, SurfaceMesh, part_from_colours
from advnerf_core.objects.model import ObjectFileError, ObjectModel, load_object, save_object
from advnerf_core.objects.views import look_at, viewing_lens
from advnerf_core.objects.voxelise import OPAQUE_PER_VOXEL, voxelise
from advnerf_core.render.cast_object import cast_object


def ball(radius=0.5, hole=False):
    sphere = trimesh.creation.icosphere(4, radius=radius)
    triangles = sphere.vertices[sphere.faces]
    if hole:
        triangles = triangles[triangles[:, :, 2].max(axis=1) > -0.8 * radius]
    rgb = np.where(triangles.mean(axis=1)[:, 2:] > 0, [[0.9, 0.2, 0.1]], [[0.1, 0.3, 0.8]])
    return SurfaceMesh((part_from_colours(triangles, rgb),))


@pytest.mark.parametrize("hole", [False, True])
def test_a_ray_loses_half_its_light_at_the_surface_and_all_of_it_inside(hole):
    grids = voxelise(ball(hole=hole), 32)
    axis = grids.box_min[2] + grids.voxel * (np.arange(grids.density.shape[2]) + 0.5)
    middle = grids.density.shape[0] // 2
    line = np.interp(np.linspace(axis[-1], axis[0], 4000), axis, grids.density[middle, middle])
    through = np.exp(-np.cumsum(line) * (axis[-1] - axis[0]) / 3999)
    half = np.linspace(axis[-1], axis[0], 4000)[np.argmax(through < 0.5)]
    assert half == pytest.approx(0.5, abs=0.75 * grids.voxel)
    assert through[2000] < 1e-10
    assert grids.density[middle, middle, middle] == pytest.approx(OPAQUE_PER_VOXEL / grids.voxel)
    assert grids.density[0].max() == 0.0


def test_colours_reach_beyond_the_surface():
    grids = voxelise(ball(), 32)
    x = grids.density.shape[0] // 2
    np.testing.assert_allclose(grids.colours[x, x, -1], [0.9, 0.2, 0.1], atol=1e-6)
    np.testing.assert_allclose(grids.colours[x, x, 0], [0.1, 0.3, 0.8], atol=1e-6)
    assert grids.colours.min() >= 0.0999


@pytest.mark.parametrize("resolution", [4, 1000])
def test_resolutions_out_of_range(resolution):
    with pytest.raises(MeshError, match="8 to 128 voxels"):
        voxelise(ball(), resolution)


@pytest.mark.slow
def test_fitting_brings_the_picture_nearer_to_the_mesh():
    mesh = hydrant()
    before = build_from_mesh(mesh, "hydrant", resolution=24, steps=0)
    after = build_from_mesh(mesh, "hydrant", resolution=24, steps=40)
    held_out = mesh_views(mesh, 4, 96, phase=0.2)
    assert agreement_db(after, held_out) > agreement_db(before, held_out) + 2.0
    assert after.about["held_out_psnr_db"] > 20.0
    np.testing.assert_allclose(after.size_m, mesh.size_m, atol=3 * after.grids.voxel)


@pytest.mark.slow
def test_an_object_is_carved_out_of_its_pictures():
    views = mesh_views(ball(), 20, 64)
    hull = visual_hull(views, 24)
    volume = (hull.density > 0).sum() * hull.voxel**3
    assert (
        1.0 < volume / (4 / 3 * np.pi * 0.125) < 2.2
    )  # the hull holds the object, and a cone below, where nobody looked
    model = build_from_images(views, "ball", resolution=24, steps=100)
    assert model.about["held_out_psnr_db"] > 22.0


def test_a_rotated_object_equals_a_rotated_camera():
    model = build_from_mesh(hydrant(), "hydrant", resolution=24, steps=0)
    turn = np.eye(4)
    turn[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    camera = look_at(np.array([2.0, 0.3, 0.5]), np.array([0, 0, 0.4]))
    lens = viewing_lens(48)
    turned = cast_object(model.placed(turn), camera[None], lens, 2, np.float64)
    same = cast_object(model.placed(np.eye(4)), np.linalg.inv(turn)[None] @ camera, lens, 2, np.float64)
    np.testing.assert_array_equal(turned.pixels, same.pixels)
    np.testing.assert_allclose(turned.alpha, same.alpha, atol=1e-9)
    np.testing.assert_allclose((turned.weights - same.weights).toarray(), 0.0, atol=1e-9)


def test_a_scaled_object_further_away_looks_the_same():
    model = build_from_mesh(hydrant(), "hydrant", resolution=24, steps=0)
    camera = look_at(np.array([2.0, 0.0, 0.0]), np.zeros(3))
    far = look_at(np.array([6.0, 0.0, 0.0]), np.zeros(3))
    near_cast = cast_object(model.placed(np.eye(4)), camera[None], viewing_lens(40), 2, np.float64)
    far_cast = cast_object(model.placed(np.eye(4), scale=3.0), far[None], viewing_lens(40), 2, np.float64)
    np.testing.assert_array_equal(near_cast.pixels, far_cast.pixels)
    np.testing.assert_allclose(near_cast.alpha, far_cast.alpha, atol=1e-9)
    np.testing.assert_allclose(3.0 * near_cast.depth_m, far_cast.depth_m, rtol=1e-9)


def test_free_rows_are_those_that_can_be_seen():
    model = ObjectModel("ball", voxelise(ball(), 32))
    field = model.placed(np.eye(4))
    centre = tuple(n // 2 for n in field.slots.shape)
    assert field.slots[centre] == field.free_count  # deep inside: the fixed row
    assert field.slots[0, 0, 0] == field.free_count  # far outside
    images = draw_object(model, look_at(np.array([3.0, 0, 0]), np.zeros(3))[None], viewing_lens(40))
    hidden = np.array([0.5, 0.5, 0.5])
    seen = images[images[..., 3] > 0.99][:, :3]
    assert np.abs(seen - hidden).max(axis=1).min() > 0.2  # nowhere does the fixed grey show through
    recoloured = model.with_colours(np.ones((field.free_count, 3)))
    np.testing.assert_allclose(
        draw_object(recoloured, look_at(np.array([3.0, 0, 0]), np.zeros(3))[None], viewing_lens(9))[0, 4, 4],
        1.0,
        atol=1e-6,
    )


def test_a_file_keeps_everything(tmp_path):
    model = build_from_mesh(hydrant(), "hydrant", resolution=16, steps=0, source={"generator": "hydrant"})
    save_object(tmp_path / "h.object.safetensors", model)
    kept = load_object(tmp_path / "h.object.safetensors")
    assert (kept.name, kept.about) == ("hydrant", model.about)
    np.testing.assert_array_equal(kept.grids.density, model.grids.density)
    np.testing.assert_array_equal(kept.slots, model.slots)


def test_what_is_not_an_object_file_is_one_error(tmp_path):
    path = tmp_path / "x.object.safetensors"
    with pytest.raises(ObjectFileError, match="object build"):
        load_object(path)
    path.write_bytes(b"junk")
    with pytest.raises(ObjectFileError, match="cannot read"):
        load_object(path)
    model = build_from_mesh(hydrant(), "hydrant", resolution=16, steps=0)
    model.grids.density[3, 3, 3] = np.nan
    save_object(path, model)
    with pytest.raises(ObjectFileError, match="finite grids"):
        load_object(path)
    with pytest.raises(ObjectFileError, match="finite pose"):
        model.placed(np.full((4, 4), np.nan))


def test_pictures_that_no_object_fits(tmp_path):
    views = mesh_views(ball(), 6, 32)
    with pytest.raises(FitError, match="fully transparent"):
        PosedRgba(np.zeros_like(views.images), views.T_object_from_camera, views.pinholes)
    with pytest.raises(FitError, match="at least 3"):
        PosedRgba(views.images[:2], views.T_object_from_camera[:2], views.pinholes[:2])
    with pytest.raises(FitError, match="finite"):
        PosedRgba(views.images * np.nan, views.T_object_from_camera, views.pinholes)
    with pytest.raises(FitError, match="same way"):
        visual_hull(PosedRgba(views.images, np.repeat(views.T_object_from_camera[:1], 6, axis=0), views.pinholes))
    away = np.asarray(views.T_object_from_camera).copy()
    away[:, :3, 2] *= -1.0
    away[:, :3, 0] *= -1.0
    with pytest.raises(FitError, match="none of them does"):
        fit_grids(PosedRgba(views.images, away, views.pinholes), voxelise(ball(), 16), steps=1)
