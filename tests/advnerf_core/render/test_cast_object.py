import dataclasses

import cv2
import numpy as np
import pytest
import torch

from advnerf_core.fields.voxel_grid import VoxelGridObject, cube_face_object, squash
from advnerf_core.geometry import Pinhole, invert_transform, look_at, make_transform, rotation_z
from advnerf_core.render.cast_object import cast_object, cast_work, made_opaque, windows

PINHOLE = Pinhole(80, 60, 60.0, 61.0, 40.0, 29.0)


def face_toward_camera(resolution=6, **options):
    # The face's normal is its x axis; the camera sits at positive x and looks back.
    return cube_face_object(
        0.8, resolution, T_world_from_object=make_transform(rotation_z(0.2), [1, 2, 0.5]), **options
    )


def camera(distance_m=1.5, side_m=0.4):
    return look_at([1 + distance_m, 2 + side_m, 0.7], [1, 2, 0.5])[None]


def dense(cast, colours, pinhole=PINHOLE, batch=1):
    image = np.zeros((batch * pinhole.height * pinhole.width, 3))
    image[cast.pixels] = cast.weights @ colours
    return image.reshape(batch, pinhole.height, pinhole.width, 3)


def test_the_face_shows_exactly_the_bilinear_texture():
    face = face_toward_camera()
    theta = torch.randn(6, 6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    T = camera()
    cast = cast_object(face, T, PINHOLE, supersample=1, dtype=np.float64)
    rendered = cast.weights @ face.colours(theta).numpy()
    # Independent: intersect each ray with the face's plane and sample the texture with OpenCV's convention.
    rays = PINHOLE.directions().reshape(-1, 3)[cast.pixels] @ T[0, :3, :3].T
    R, t = face.T_world_from_object[:3, :3], face.T_world_from_object[:3, 3]
    depth = ((t - T[0, :3, 3]) @ R[:, 0]) / (rays @ R[:, 0])
    local = (T[0, :3, 3] + depth[:, None] * rays - t) @ R
    columns = (local[:, 1] + 0.4) / 0.8 * 6 - 0.5
    rows = (0.4 - local[:, 2]) / 0.8 * 6 - 0.5
    expected = bilinear(squash(theta).numpy(), rows, columns)
    np.testing.assert_allclose(rendered, expected, atol=1e-12)
    np.testing.assert_allclose(cast.depth_m, depth, atol=1e-12)
    np.testing.assert_allclose(cast.alpha, 1.0)
    assert len(cast.pixels) > 500


def bilinear(texture, rows, columns):
    n = len(texture)
    rows, columns = np.clip(rows, 0, n - 1), np.clip(columns, 0, n - 1)
    r, c = np.minimum(rows.astype(int), n - 2), np.minimum(columns.astype(int), n - 2)
    fr, fc = (rows - r)[:, None], (columns - c)[:, None]
    top = texture[r, c] * (1 - fc) + texture[r, c + 1] * fc
    bottom = texture[r + 1, c] * (1 - fc) + texture[r + 1, c + 1] * fc
    return top * (1 - fr) + bottom * fr


def test_viewer_sees_row_0_on_top_and_column_0_on_the_left():
    face = cube_face_object(0.8, 2, one_sided=True)
    colours = np.eye(5)[:, :4]  # one channel per texture cell
    cast = cast_object(face, look_at([2.0, 0.0, 0.01], [0, 0, 0])[None], PINHOLE, dtype=np.float64)
    image = np.zeros((60 * 80, 4))
    image[cast.pixels] = cast.weights @ colours
    image = image.reshape(60, 80, 4)
    centre = [(np.argwhere(image[..., k] > 0.9)).mean(axis=0) for k in range(4)]
    assert centre[0][0] < centre[2][0]  # cell (0, 0) above (1, 0)
    assert centre[0][1] < centre[1][1]  # cell (0, 0) left of (0, 1)


def test_supersampling_is_the_area_average_of_a_finer_image():
    face, T = face_toward_camera(), camera()
    colours = face.colours(torch.randn(6, 6, 3, dtype=torch.float64)).numpy()
    fine = PINHOLE.resized(160, 120)
    coarse = dense(cast_object(face, T, PINHOLE, supersample=2, dtype=np.float64), colours)[0]
    finer = dense(cast_object(face, T, fine, supersample=1, dtype=np.float64), colours, fine)[0]
    np.testing.assert_allclose(coarse, cv2.resize(finer, (80, 60), interpolation=cv2.INTER_AREA), atol=1e-12)


def test_a_dense_medium_converges_to_the_opaque_solid_and_a_thin_one_obeys_beer_lambert():
    face, T = face_toward_camera(), camera(side_m=0.0)
    solid = cast_object(face, T, PINHOLE, 1, np.float64)
    medium = dataclasses.replace(face, density=np.full(face.slots.shape, 1e5), step_units=2e-5)
    thick = cast_object(medium, T, PINHOLE, 1, np.float64)
    colours = face.colours(torch.randn(6, 6, 3, dtype=torch.float64)).numpy()
    np.testing.assert_allclose(dense(thick, colours), dense(solid, colours), atol=2e-3)
    # A cube of constant extinction 2 per unit at scale 0.5, looked at along its axis: alpha = 1 - exp(-2 * 1).
    cube = VoxelGridObject(
        np.zeros((4, 4, 4), np.int32),
        (1, 3),
        np.zeros((0, 3)),
        -0.5 * np.ones(3),
        0.5 * np.ones(3),
        np.eye(4),
        scale=0.5,
        density=np.full((4, 4, 4), 2.0),
        step_units=0.001,
    )
    narrow = Pinhole(1, 1, 1e6, 1e6, 0.5, 0.5)
    cast = cast_object(cube, look_at([3.0, 0, 1e-6], [0, 0, 0])[None], narrow, 1, np.float64)
    np.testing.assert_allclose(cast.alpha, [1 - np.exp(-2.0)], rtol=1e-6)
    length_m, sigma = 0.5, 4.0  # the same medium in metres
    mean = 2.75 + 1 / sigma - length_m / (np.exp(sigma * length_m) - 1)  # mean depth of absorption
    np.testing.assert_allclose(cast.depth_m, [mean], rtol=1e-5)


def test_one_sided_faces_are_invisible_from_behind_and_from_the_side():
    front, behind = look_at([2.0, 0, 0.1], [0, 0, 0]), look_at([-2.0, 0, 0.1], [0, 0, 0])
    beside = look_at([-0.005, 2.0, 0.1], [-0.005, 0, 0])
    poses = np.stack([front, behind, beside])
    cast = cast_object(cube_face_object(0.8, 4, depth_m=0.2), poses, PINHOLE)
    assert set(np.unique(cast.pixels // (80 * 60))) == {0}
    both = cast_object(cube_face_object(0.8, 4, depth_m=0.2, one_sided=False), poses, PINHOLE)
    assert set(np.unique(both.pixels // (80 * 60))) == {0, 1, 2}


def test_windows_lose_nothing_when_the_object_straddles_the_camera_plane():
    face = cube_face_object(0.8, 4)
    close = make_transform(look_at([1, 0, 0], [0, 0, 0])[:3, :3] @ rotation_z(0), [0.05, 0.3, 0.0])
    turned = look_at([0.1, 0.35, 0.0], [0.0, 1.0, 0.0])  # looks along the face, part of it behind the camera
    poses = np.stack([close, turned])
    cast = cast_object(face, poses, PINHOLE, 1, np.float64)
    for b in range(2):
        rays = PINHOLE.directions().reshape(-1, 3) @ poses[b, :3, :3].T
        with np.errstate(divide="ignore"):
            depth = -poses[b, 0, 3] / rays[:, 0]
        hit = poses[b, :3, 3] + depth[:, None] * rays
        inside = (depth > 0.02) & (np.abs(hit[:, 1]) < 0.4) & (np.abs(hit[:, 2]) < 0.4)
        assert set(np.flatnonzero(inside)) == {p - b * 4800 for p in cast.pixels if p // 4800 == b}
    first, last, left, right = windows(face, invert_transform(poses), PINHOLE)[1]
    assert (last - first) * (right - left) < 4800 / 2  # the part behind the camera is not searched for


def test_weights_sum_to_alpha_and_edges_are_antialiased():
    cast = cast_object(face_toward_camera(), camera(), PINHOLE, 3)
    np.testing.assert_allclose(np.asarray(cast.weights.sum(axis=1)).ravel(), cast.alpha, atol=1e-6)
    assert cast.weights.dtype == np.float32
    assert ((cast.alpha > 0.05) & (cast.alpha < 0.95)).any()
    # int64 pixels, float64 alpha and depth; CSR of float32 with int32 indices.
    covered, weights = len(cast.pixels), cast.weights.nnz
    assert cast.nbytes == covered * (8 + 8 + 8) + weights * (4 + 4) + (covered + 1) * 4


def test_an_object_out_of_view_gives_an_empty_cast():
    cast = cast_object(cube_face_object(0.8, 4), look_at([2.0, 0, 0.1], [4.0, 0, 0])[None], PINHOLE)
    assert cast.weights.shape == (0, 17)
    with pytest.raises(ValueError, match="at least 1 ray"):
        cast_object(cube_face_object(0.8, 4), camera(), PINHOLE, supersample=0)


@pytest.mark.parametrize("least", [0.0, -3.0], ids=["positive", "signed"])
def test_a_thin_cloud_equals_a_ray_march_written_out(least):
    generator = np.random.default_rng(0)
    shape, step = (5, 6, 7), 0.01
    density = generator.uniform(least, 3.0, shape)
    cloud = VoxelGridObject(
        np.arange(210, dtype=np.int32).reshape(shape),
        (210, 3),
        np.zeros((0, 3)),
        -0.5 * np.ones(3),
        0.5 * np.ones(3),
        make_transform(rotation_z(0.3), [0.1, 0, 0]),
        scale=0.8,
        density=density,
        step_units=step,
    )
    pinhole, T = Pinhole(3, 2, 8.0, 8.0, 1.5, 1.0), look_at([2.0, 0.2, 0.3], [0, 0, 0])
    colours = generator.uniform(size=(210, 3))
    cast = cast_object(cloud, T[None], pinhole, 1, np.float64)
    assert cast.weights.nnz > 6 * 4 + 64  # more than the caster makes room for at first
    rendered = cast.weights @ colours
    origin, rotation = (T[:3, 3] - [0.1, 0, 0]) @ rotation_z(0.3) / 0.8, rotation_z(-0.3) @ T[:3, :3] / 0.8
    for pixel, got, alpha in zip(cast.pixels, rendered, cast.alpha, strict=True):
        d = rotation @ pinhole.directions().reshape(-1, 3)[pixel]
        near, far = np.sort([(-0.5 - origin) / d, (0.5 - origin) / d], axis=0)
        t_in, t_out = near.max(), far.min()
        count = int(np.ceil((t_out - t_in) * np.linalg.norm(d) / step))
        dt = (t_out - t_in) / count
        light, total = 1.0, np.zeros(3)
        for t in t_in + (np.arange(count) + 0.5) * dt:
            g = np.clip((origin + t * d + 0.5) * shape - 0.5, 0, np.array(shape) - 1)
            sigma, colour = (trilinear(grid, g) for grid in (density, colours.reshape(*shape, 3)))
            opacity = 1 - np.exp(-max(sigma, 0.0) * dt * np.linalg.norm(d))
            total += light * opacity * colour
            light *= 1 - opacity
        np.testing.assert_allclose(got, total, atol=1e-10)
        np.testing.assert_allclose(alpha, 1 - light, atol=1e-10)


@pytest.mark.parametrize("edge", [3.0, 3.3, 3.5, 3.9])
def test_negative_density_puts_an_edge_anywhere_between_voxel_centres(edge):
    # A wall that ends at voxel coordinate `edge` along y, seen head on: a ray at y meets the same density all the way through.
    count, pinhole = 8, Pinhole(400, 1, 400.0, 400.0, 200.0, 0.5)
    beyond = np.arange(count) - edge
    density = np.broadcast_to(50.0 * np.clip(-beyond, -1.0, 1.0)[None, :, None], (count,) * 3).copy()
    wall = VoxelGridObject(
        np.zeros((count,) * 3, np.int32), (1, 3), np.zeros((0, 3)), np.zeros(3), np.full(3, float(count)), np.eye(4),
        density=density, step_units=0.5,
    )  # fmt: skip
    T = look_at([104.0, 4.0, 4.0], [0.0, 4.0, 4.0])
    cast = cast_object(wall, T[None], pinhole, 1, np.float64)
    # Columns show y = 4 m (camera) plus or minus; the wall is opaque up to its edge within a hundredth of a voxel.
    columns = np.arange(400)
    y = T[1, 3] + 100.0 * (columns + 0.5 - 200.0) / 400.0 * T[1, 0]
    seen = np.zeros(400)
    seen[cast.pixels] = cast.alpha
    inside = (y > 0.3) & (y - 0.5 < edge - 0.3)
    outside = y - 0.5 > edge + 0.05
    assert inside.any()
    assert outside.any()
    assert seen[inside].min() > 0.999
    assert seen[outside].max() == 0.0


def trilinear(grid, g):
    first = np.minimum(g.astype(int), np.array(grid.shape[:3]) - 2)
    f = g - first
    total = 0.0
    for corner in np.ndindex(2, 2, 2):
        share = np.prod(np.where(corner, f, 1 - f))
        total = total + share * grid[tuple(first + corner)]
    return total


def sparse_blob(T_world_from_object=None, scale=1.0):
    """A ball of fog, a thick plate and a lonely voxel in a box that is mostly empty."""
    generator = np.random.default_rng(5)
    shape = (24, 20, 16)
    i, j, k = np.indices(shape)
    density = np.where((i - 6) ** 2 + (j - 6) ** 2 + (k - 8) ** 2 < 9, 4.0, 0.0) * generator.uniform(
        0.5, 1.0, shape
    )
    density[18:20, 3:17, 2:14] = 60.0
    density[12, 18, 12] = 9.0
    pose = (
        make_transform(rotation_z(0.4), [0.2, -0.1, 0.3])
        if T_world_from_object is None
        else T_world_from_object
    )
    return VoxelGridObject(
        np.arange(density.size, dtype=np.int32).reshape(shape),
        (density.size, 3),
        np.zeros((0, 3)),
        np.array([-0.6, -0.5, -0.4]),
        np.array([0.6, 0.5, 0.4]),
        pose,
        scale=scale,
        density=density,
        step_units=0.02,
    )


def test_leaping_over_empty_space_changes_nothing():
    field, poses = sparse_blob(), np.stack([camera_toward(azimuth) for azimuth in (0.3, 1.7, 3.1, 4.5)])
    leaping = cast_object(field, poses, PINHOLE, 2, np.float64)
    plodding = dataclasses.replace(field, density=field.density + 1e-300)  # no cell is empty
    everywhere = cast_object(plodding, poses, PINHOLE, 2, np.float64)
    colours = np.random.default_rng(0).uniform(size=(field.slot_count, 3))
    np.testing.assert_allclose(
        dense(leaping, colours, batch=4), dense(everywhere, colours, batch=4), atol=1e-10
    )
    assert len(leaping.pixels) > 1000


def camera_toward(azimuth_rad):
    return look_at([0.2 + 2.0 * np.cos(azimuth_rad), -0.1 + 2.0 * np.sin(azimuth_rad), 0.9], [0.2, -0.1, 0.3])


def test_a_turned_object_looks_like_a_turned_camera():
    turn = make_transform(rotation_z(0.7), [0.4, 0.2, 0.1])
    field, T = sparse_blob(), camera_toward(0.4)
    colours = np.random.default_rng(0).uniform(size=(field.slot_count, 3))
    moved = dense(
        cast_object(field.moved(turn @ field.T_world_from_object), (turn @ T)[None], PINHOLE, 2, np.float64),
        colours,
    )
    np.testing.assert_allclose(
        moved, dense(cast_object(field, T[None], PINHOLE, 2, np.float64), colours), atol=1e-9
    )
    # Twice as large and twice as far is the same picture.
    large = make_transform(rotation_z(0.4), 2 * field.T_world_from_object[:3, 3])
    far = T.copy()
    far[:3, 3] *= 2
    cast = cast_object(field.moved(large, 2.0), far[None], PINHOLE, 2, np.float64)
    np.testing.assert_allclose(dense(cast, colours), moved, atol=1e-9)


def test_a_ball_of_fog_has_the_transmittance_and_depth_of_its_chords():
    count, radius_m, sigma = 64, 0.4, 3.0
    axis = (np.arange(count) + 0.5) / count - 0.5
    away = np.sqrt(axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + axis[None, None, :] ** 2)
    # The share of a voxel inside the ball, nearly: a ramp of one voxel across the surface.
    density = sigma * np.clip((radius_m - away) * count + 0.5, 0.0, 1.0)
    ball = VoxelGridObject(
        np.zeros((count,) * 3, np.int32),
        (1, 3),
        np.zeros((0, 3)),
        -0.5 * np.ones(3),
        0.5 * np.ones(3),
        np.eye(4),
        density=density,
        step_units=0.004,
    )
    T = look_at([2.0, 0.0, 0.001], [0, 0, 0])
    cast = cast_object(ball, T[None], PINHOLE, 1, np.float64)
    rays = PINHOLE.directions().reshape(-1, 3)[cast.pixels]
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ T[:3, :3].T
    along = -(T[:3, 3] @ unit.T)
    impact2 = T[:3, 3] @ T[:3, 3] - along**2
    half = np.sqrt(np.maximum(radius_m**2 - impact2, 0.0))
    middle = impact2 < (radius_m - 0.05) ** 2
    assert middle.sum() > 200
    length = 2 * half[middle]
    np.testing.assert_allclose(cast.alpha[middle], 1 - np.exp(-sigma * length), atol=6e-3)  # of voxels
    mean = along[middle] - half[middle] + 1 / sigma - length / np.expm1(sigma * length)
    np.testing.assert_allclose(cast.depth_m[middle], mean / np.linalg.norm(rays[middle], axis=1), atol=3e-3)


def test_several_objects_and_threads_give_what_each_gives_alone():
    fields = [
        sparse_blob(),
        face_toward_camera(),
        sparse_blob(make_transform(rotation_z(2.0), [-0.4, 0.5, 0.1]), 0.5),
    ]
    poses = np.stack([camera_toward(azimuth) for azimuth in (0.3, 1.7)])
    for dtype in (np.float32, np.float64):
        together = cast_work(fields, poses, PINHOLE, 2, dtype).run()
        for field, cast in zip(fields, together, strict=True):
            for b in range(2):
                single = cast_object(field, poses[b : b + 1], PINHOLE, 2, dtype)
                mine = cast.pixels // (80 * 60) == b
                np.testing.assert_array_equal(cast.pixels[mine] - b * 80 * 60, single.pixels)
                np.testing.assert_array_equal(cast.depth_m[mine], single.depth_m)
                assert (cast.weights[np.flatnonzero(mine)] != single.weights).nnz == 0


def test_an_opaque_cast_is_there_or_not():
    cast = cast_object(sparse_blob(), camera_toward(0.3)[None], PINHOLE, 2, np.float64)
    solid = made_opaque(cast)
    assert 0 < len(solid.pixels) == (cast.alpha >= 0.5).sum() < len(cast.pixels)
    np.testing.assert_allclose(np.asarray(solid.weights.sum(axis=1)).ravel(), 1.0)


def test_a_camera_without_a_pose_sees_nothing_and_an_object_without_one_is_refused():
    poses = np.stack([camera_toward(0.3), np.full((4, 4), np.nan)])
    assert set(cast_object(sparse_blob(), poses, PINHOLE).pixels // (80 * 60)) == {0}
    with pytest.raises(ValueError, match="expected a finite pose"):
        sparse_blob(np.full((4, 4), np.nan))
    with pytest.raises(ValueError, match="expected a rigid pose"):
        sparse_blob(np.diag([2.0, 2.0, 2.0, 1.0]))
    with pytest.raises(ValueError, match="expected a finite pose"):
        sparse_blob(scale=np.inf)
