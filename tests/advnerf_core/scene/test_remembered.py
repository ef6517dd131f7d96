"""Frames that are asked for again are the same bits, and are not rendered again; memory stays within its budget."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch

from advnerf_core.geometry import Pinhole
from advnerf_core.scene.remembered import RememberedBackground, frame_bytes

LENS, OTHER = Pinhole(4, 3, 4.0, 4.0, 2.0, 1.5), Pinhole(4, 3, 5.0, 5.0, 2.0, 1.5)
FRAME_BYTES = 4 * 3 * (3 + 1) * 4
assert frame_bytes(LENS) == FRAME_BYTES


class Scene:
    """Colours and depth that say the pose's x and the lens; counts what it renders."""

    def __init__(self):
        self.asked = []

    def __call__(self, poses, pinhole):
        self.asked += poses[:, 0, 3].tolist()
        values = torch.tensor(poses[:, 0, 3] * pinhole.fx, dtype=torch.float32)
        return (
            values[:, None, None, None].expand(-1, 3, 4, 3),
            values[:, None, None].expand(-1, 3, 4),
            "opacity",
        )


def poses(*x_m):
    found = np.tile(np.eye(4), (len(x_m), 1, 1))
    found[:, 0, 3] = x_m
    return found


def test_only_what_is_not_kept_is_rendered_and_all_comes_in_the_order_asked_for():
    scene = Scene()
    kept = RememberedBackground(scene, 100 * FRAME_BYTES)
    kept(poses(1.0, 2.0), LENS)
    rgb, depth_m = kept(poses(3.0, 2.0, 1.0, 3.0), LENS)
    assert scene.asked == [1.0, 2.0, 3.0, 3.0]  # twice in one batch is the renderer's own business
    assert rgb[:, 0, 0, 0].tolist() == depth_m[:, 0, 0].tolist() == [12.0, 8.0, 4.0, 12.0]
    assert kept(poses(1.0), OTHER)[0][0, 0, 0, 0] == 5.0  # another lens is another frame
    # The next number after a pose is another pose.
    assert kept(poses(np.nextafter(1.0, 2.0)), LENS)[0].shape == (1, 3, 4, 3)
    assert len(scene.asked) == 6


def test_what_is_kept_cannot_be_changed_from_outside():
    kept = RememberedBackground(Scene(), 100 * FRAME_BYTES)
    for _ in range(2):
        rgb, _ = kept(poses(1.0), LENS)
        assert rgb[0, 0, 0, 0] == 4.0
        rgb.fill_(9.0)


def test_the_oldest_frames_go_when_the_budget_is_full():
    scene = Scene()
    kept = RememberedBackground(scene, 2 * FRAME_BYTES)
    for x_m in (1.0, 2.0, 3.0, 3.0, 2.0, 1.0):
        kept(poses(x_m), LENS)
        assert kept.nbytes <= 2 * FRAME_BYTES
    assert scene.asked == [1.0, 2.0, 3.0, 1.0]
    nothing = RememberedBackground(again := Scene(), 0)
    nothing(poses(1.0), LENS)
    nothing(poses(1.0), LENS)
    assert again.asked == [1.0, 1.0]
    assert nothing.nbytes == 0


def test_threads_get_their_own_frames_and_the_count_of_bytes_is_right():
    kept = RememberedBackground(Scene(), 20 * FRAME_BYTES)

    def ask(k):
        rgb, _ = kept(poses(float(k % 7), float(k % 5)), LENS)
        return rgb[:, 0, 0, 0].tolist() == [4.0 * (k % 7), 4.0 * (k % 5)]

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(ask, range(400)))
    assert kept.nbytes == 7 * FRAME_BYTES
