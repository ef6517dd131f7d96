"""Voxels, fits and files of objects."""

import json
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
import trimesh

from advnerf_core.geometry import look_at
from advnerf_core.objects.voxel.build import (
    Agreement,
    advice,
    build_from_images,
    build_from_mesh,
    draw_object,
    mesh_views,
)
from advnerf_core.objects.voxel.fit import fit_grids
from advnerf_core.objects.voxel.generators import hydrant
from advnerf_core.objects.voxel.hull import visual_hull
from advnerf_core.objects.voxel.mesh import MeshError, SurfaceMesh, part_from_colours
from advnerf_core.objects.voxel.model import ObjectFileError, ObjectModel, load_object, save_object
from advnerf_core.objects.voxel.pictures import FitError, PosedRgba, RayBatches
from advnerf_core.objects.voxel.views import viewing_lens
from advnerf_core.objects.voxel.voxelise import OPAQUE_PER_VOXEL, voxelise
from advnerf_core.render.cast_object import cast_object, prepared


def ball(radius=0.5, hole=False):
    sphere = trimesh.creation.icosphere(4, radius=radius)
    triangles = sphere.vertices[sphere.faces]
    if hole:
        triangles = triangles[triangles[:, :, 2].max(axis=1) > -0.8 * radius]
    rgb = np.where(triangles.mean(axis=1)[:, 2:] > 0, [[0.9, 0.2, 0.1]], [[0.1, 0.3, 0.8]])
    return SurfaceMesh((part_from_colours(triangles, rgb),))


@pytest.fixture(scope="module")
def model():
    """A hydrant of 24 voxels along its height, as the mesh gives it."""
    return build_from_mesh(hydrant(), "hydrant", resolution=24, steps=0)


@pytest.mark.parametrize("hole", [False, True])
def test_density_passes_zero_at_the_surface_and_is_opaque_inside(hole):
    grids = voxelise(ball(hole=hole), 32)
    axis = grids.box_min[2] + grids.voxel * (np.arange(grids.density.shape[2]) + 0.5)
    middle = grids.density.shape[0] // 2
    places = np.linspace(axis[-1], axis[0], 4000)
    line = np.maximum(np.interp(places, axis, grids.density[middle, middle]), 0.0)
    assert places[np.argmax(line > 0.0)] == pytest.approx(0.5, abs=0.25 * grids.voxel)
    through = np.exp(-np.cumsum(line) * (axis[-1] - axis[0]) / 3999)
    assert places[np.argmax(through < 0.5)] == pytest.approx(0.5, abs=0.75 * grids.voxel)
    assert through[2000] < 1e-10
    assert grids.density[middle, middle, middle] == pytest.approx(OPAQUE_PER_VOXEL / grids.voxel)
    assert grids.density[0].max() <= 0.0


@pytest.mark.parametrize("resolution", [16, 32])
def test_the_silhouette_of_a_ball_has_its_size(resolution):
    model = ObjectModel("ball", voxelise(ball(), resolution))
    lens = viewing_lens(200)
    picture = draw_object(model, look_at(np.array([0.0, -6.0, 0.0]), np.zeros(3)), lens)[0]
    radius_px = lens.fx * np.tan(np.arcsin(0.5 / 6.0))
    voxel_px = lens.fx * model.grids.voxel / 6.0
    assert np.sqrt(picture[..., 3].sum() / np.pi) == pytest.approx(radius_px, abs=0.1 * voxel_px)


def test_what_a_renderer_derives_from_a_model_is_shared_by_all_its_places(model):
    pose = np.eye(4)
    pose[:3, 3] = 1.0, 2.0, 0.5
    one, other = model.placed(np.eye(4)), model.placed(pose, 2.0)
    assert prepared(one, np.float64) is prepared(other, np.float64)
    np.testing.assert_array_equal(other.T_world_from_object, pose)
    assert (one.scale, other.scale) == (1.0, 2.0)


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
    # Of the object's own pixels: the background, which both leave empty, would dampen what the fit changes.
    assert Agreement.of(after, held_out).object_psnr_db > Agreement.of(before, held_out).object_psnr_db + 2.0
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
    held_out = mesh_views(ball(), 2, 64, phase=0.37)
    model = build_from_images(views, "ball", resolution=24, steps=100, held_out=held_out)
    assert model.about["held_out_psnr_db"] > 22.0
    assert model.about["held_out_psnr_db"] == round(Agreement.of(model, held_out).psnr_db, 2)
    assert model.about["held_out_object_psnr_db"] < model.about["held_out_psnr_db"]
    assert abs(model.about["train_psnr_db"] - model.about["held_out_psnr_db"]) < 3.0


def as_bytes(views):
    return PosedRgba(np.rint(255 * views.images).astype(np.uint8), views.T_object_from_camera, views.pinholes)


def test_pictures_in_bytes_give_the_same_hull_and_the_same_rays():
    views = mesh_views(ball(), 6, 64)
    real, rounded = (visual_hull(each, 24) for each in (views, as_bytes(views)))
    assert ((real.density > 0) != (rounded.density > 0)).mean() < 0.01
    np.testing.assert_allclose(real.colours, rounded.colours, atol=2 / 255)
    box = real.box_min, real.box_max
    for ours, theirs in zip(
        RayBatches(views, *box, seed=3).draw(500),
        RayBatches(as_bytes(views), *box, seed=3).draw(500),
        strict=True,
    ):
        np.testing.assert_allclose(ours, theirs, atol=0.51 / 255)


def test_rays_of_a_batch_are_those_of_their_pixels_and_meet_the_box():
    views = mesh_views(ball(), 6, 64)
    coordinates = np.stack(np.meshgrid(np.arange(64), np.arange(64)), axis=-1) / 64.0
    marked = np.zeros((6, 64, 64, 4), np.float32)
    marked[..., :2], marked[..., 2] = coordinates, np.arange(6)[:, None, None] / 6.0
    batches = RayBatches(
        PosedRgba(marked, views.T_object_from_camera, views.pinholes), np.full(3, -0.2), np.full(3, 0.2)
    )
    pixels, origins, directions = (values.numpy() for values in batches.draw(4000))
    assert len(pixels) == len(origins) == len(directions) == 4000
    index = np.rint(6 * pixels[:, 2]).astype(int)
    assert (np.bincount(index, minlength=6) > 400).all()
    poses = np.asarray(views.T_object_from_camera)[index]
    np.testing.assert_allclose(origins, poses[:, :3, 3], atol=1e-6)
    seen = np.einsum("nji,nj->ni", poses[:, :3, :3], directions)
    lens = views.pinholes[0]
    column = lens.fx * seen[:, 0] / seen[:, 2] + lens.cx
    np.testing.assert_allclose(column, 64 * pixels[:, 0] + 0.5, atol=1e-2)
    middle = origins - (origins * directions).sum(axis=1, keepdims=True) * directions
    assert np.linalg.norm(middle, axis=1).max() < 0.2 * np.sqrt(3) + 1e-6


MEMORY_SCRIPT = """
import resource, sys, tracemalloc
from pathlib import Path
from advnerf_core.objects.voxel.build import build_from_images
from advnerf_core.objects.voxel.pictures import load_pictures
from advnerf_core.data.transforms import load_transforms
listed = load_transforms(Path(sys.argv[1]))
warm = load_pictures(listed, (64, 64))
build_from_images(warm, "warm", resolution=16, steps=1)
before_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
build_from_images(load_pictures(listed), "ball", resolution=32, steps=3)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kib) / 1024)
"""


@pytest.mark.slow
def test_a_hundred_large_pictures_fit_into_memory(tmp_path):
    """The pictures' own bytes, and not as much again for everything else: float32 pictures with their rays took 6 GiB."""
    count, side = 100, 800
    views = mesh_views(ball(), count, 64)
    frames = []
    for k, (image, pose) in enumerate(zip(views.images, views.T_object_from_camera, strict=True)):
        large = cv2.resize(np.rint(255 * image).astype(np.uint8), (side, side))
        cv2.imwrite(str(tmp_path / f"{k:03d}.png"), large, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        frames.append(
            {"file_path": f"{k:03d}.png", "transform_matrix": (pose @ np.diag([1, -1, -1, 1.0])).tolist()}
        )
    content = {"fl_x": views.pinholes[0].fx * side / 64, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    done = subprocess.run(
        [sys.executable, "-c", MEMORY_SCRIPT, str(tmp_path)], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    pictures_mib = count * side * side * 4 / 2**20
    print(f"{float(done.stdout):.0f} MiB of {pictures_mib:.0f} MiB of pictures")
    assert float(done.stdout) < 2 * pictures_mib


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, []),
        ({"train_object_psnr_db": 18.0, "gain_db": 0.9}, ["18.0 dB", "not finished", "--steps"]),
        ({"held_out_object_psnr_db": 17.0}, ["17.0 dB", "more pictures"]),
        ({"train_object_psnr_db": 18.0, "held_out_object_psnr_db": 17.5}, ["17.5 dB", "--resolution"]),
        ({"gain_db": 1.0}, ["still fell by 1.0 dB"]),
    ],
)
def test_advice_names_what_is_wrong(changes, words):
    about = {
        "train_object_psnr_db": 26.0,
        "held_out_object_psnr_db": 24.0,
        "gain_db": 0.1,
        "steps": 600,
        **changes,
    }
    text = "; ".join(advice(about))
    assert bool(text) == bool(words)
    for word in words:
        assert word in text


def test_a_fit_stops_in_time_and_says_that_it_is_not_finished():
    views = mesh_views(ball(), 8, 48)
    began = time.monotonic()
    fit = fit_grids(views, visual_hull(views, 16), steps=1_000_000, rays=256, max_seconds=1.0)
    assert time.monotonic() - began > 0.9
    assert 5 < fit.steps < 1_000_000
    short = build_from_images(views, "ball", resolution=16, steps=10)
    assert short.about["steps"] == 10
    assert any("not finished" in text for text in advice(short.about))


def test_a_rotated_object_equals_a_rotated_camera(model):
    turn = np.eye(4)
    turn[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    camera = look_at(np.array([2.0, 0.3, 0.5]), np.array([0, 0, 0.4]))
    lens = viewing_lens(48)
    turned = cast_object(model.placed(turn), camera[None], lens, 2, np.float64)
    same = cast_object(model.placed(np.eye(4)), np.linalg.inv(turn)[None] @ camera, lens, 2, np.float64)
    np.testing.assert_array_equal(turned.pixels, same.pixels)
    np.testing.assert_allclose(turned.alpha, same.alpha, atol=1e-9)
    np.testing.assert_allclose((turned.weights - same.weights).toarray(), 0.0, atol=1e-9)


def test_a_scaled_object_further_away_looks_the_same(model):
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
        visual_hull(PosedRgba(np.zeros_like(views.images), views.T_object_from_camera, views.pinholes))
    with pytest.raises(FitError, match="at least 3"):
        visual_hull(views.chosen([0, 1]))
    with pytest.raises(FitError, match="finite"):
        PosedRgba(views.images * np.nan, views.T_object_from_camera, views.pinholes)
    with pytest.raises(FitError, match="same way"):
        visual_hull(
            PosedRgba(views.images, np.repeat(views.T_object_from_camera[:1], 6, axis=0), views.pinholes)
        )
    away = np.asarray(views.T_object_from_camera).copy()
    away[:, :3, 2] *= -1.0
    away[:, :3, 0] *= -1.0
    with pytest.raises(FitError, match="none of them does"):
        fit_grids(PosedRgba(views.images, away, views.pinholes), voxelise(ball(), 16), steps=1)
