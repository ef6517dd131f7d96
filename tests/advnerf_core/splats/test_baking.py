"""A splat baked to voxels looks like the splat, and its scene file comes back."""

import numpy as np
import pytest
import torch

from advnerf_core.geometry import Pinhole, look_at
from advnerf_core.scene.bake import NotBakedError
from advnerf_core.scene.field import SceneFileError
from advnerf_core.scene.metrics import psnr
from advnerf_core.splats.bake import SplatVolume, bake_splats
from advnerf_core.splats.renderer import SplatRenderer
from advnerf_core.splats.scene_file import (
    is_splat_scene,
    load_box,
    load_hash,
    load_renderer,
    load_splat_scene,
    save_splat_scene,
)
from advnerf_core.splats.volume_kernels import LOG_STEP, LOWEST_LOG
from tests.support.splats import gaussians, random_splats, room

LENS = Pinhole(100, 40, 60.0, 60.0, 50.0, 20.0)
BOX = ((-2.2, -2.2, -1.4), (2.2, 2.2, 1.4))


def poses(count, seed):
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        x, y, turn = rng.uniform(-1.0, 1.0), rng.uniform(-1.0, 1.0), rng.uniform(0.0, 2.0 * np.pi)
        found.append(look_at(np.array([x, y, -0.8]), np.array([x + np.cos(turn), y + np.sin(turn), -0.9])))
    return np.stack(found)


def test_a_baked_room_looks_like_its_gaussians():
    splat = SplatRenderer(room(20_000).ordered(), box=BOX)
    baked = bake_splats(splat, poses(20, 0), LENS, 64)
    rgb, depth_m, alpha = splat.render(poses(4, 1), LENS)
    baked_rgb, baked_m, baked_alpha = baked.render(poses(4, 1), LENS)
    assert psnr(baked_rgb.numpy(), rgb.numpy()) > 25.0
    assert float((baked_m - depth_m).abs().median()) < 0.12
    assert float((baked_alpha - alpha).abs().mean()) < 0.03


def test_the_density_of_one_gaussian_has_the_opacity_of_its_image():
    """Through the middle of a large ball, optical depths sum to -log(1 - opacity), and at one deviation to -log(1 - o exp(-1/2))."""
    for opacity in (0.3, 0.9):
        one = gaussians([[0.0, 0.0, 0.0]], 0.2, opacity, [[0.2, 0.4, 0.6]])
        volume = SplatVolume(SplatRenderer(one, box=((-1.0,) * 3, (1.0,) * 3)), poses(2, 0), LENS, 64)
        for aside, shown in ((0.0, opacity), (0.2, opacity * np.exp(-0.5))):
            z = (np.arange(400) + 0.5) / 400
            points = np.stack([np.full(400, 0.5 + aside / 2.0), np.full(400, 0.5), z], axis=1)
            values = volume.at(points.astype(np.float32), 1.0 / 400)
            depth = float((np.exp(values[:, 0] * LOG_STEP + LOWEST_LOG) / 400)[values[:, 0] > 0].sum())
            assert 1.0 - np.exp(-depth) == pytest.approx(shown, abs=0.03)
        middle = values[200, 1:] / 255.0
        np.testing.assert_allclose(middle, [0.2, 0.4, 0.6], atol=0.01)


def test_a_splat_that_is_not_in_metres_is_not_baked():
    with pytest.raises(NotBakedError, match=r"expected a splat in metres, got one of 0\.02 m"):
        bake_splats(SplatRenderer(random_splats(20), box=((0.0,) * 3, (0.02,) * 3)), poses(2, 0), LENS)


def test_a_scene_file_comes_back(tmp_path):
    renderer, file = (
        SplatRenderer(random_splats(50), (0.1, 0.2, 0.3), box=BOX),
        tmp_path / "scene.safetensors",
    )
    content = save_splat_scene(file, renderer, {"file": "a.ply"})
    loaded, metadata = load_splat_scene(file)
    assert metadata == {"file": "a.ply", "scene_hash": content}
    assert (loaded.behind, loaded.box, load_hash(file)) == (renderer.behind, BOX, content)
    assert is_splat_scene(file)
    assert load_box(file).box_high_m == BOX[1]
    for one, other in zip(
        renderer.render(poses(1, 0), LENS), load_renderer(file).render(poses(1, 0), LENS), strict=True
    ):
        torch.testing.assert_close(one, other, atol=2e-3, rtol=2e-3)
    assert save_splat_scene(tmp_path / "b", loaded) == content
    moved = SplatRenderer(loaded.splats, box=BOX)
    assert save_splat_scene(tmp_path / "c", moved) != content


def test_damaged_scene_files_are_refused(tmp_path):
    file = tmp_path / "scene.safetensors"
    save_splat_scene(file, SplatRenderer(random_splats(5), box=BOX))
    good = file.read_bytes()
    assert not is_splat_scene(tmp_path / "missing")
    file.write_bytes(good[:-10])
    with pytest.raises(SceneFileError, match="expected a scene file at"):
        load_splat_scene(file)
    file.write_bytes(good.replace(b"advnerf-splat-1", b"advnerf-splat-9"))
    with pytest.raises(SceneFileError, match="expected format advnerf-splat-1"):
        load_splat_scene(file)
    file.write_bytes(good.replace(b"opacities", b"opacitiez"))
    with pytest.raises(SceneFileError, match="expected a splat in"):
        load_splat_scene(file)
