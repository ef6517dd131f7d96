"""Where the phone goes, and what it does to colours."""

import math

import numpy as np
import pytest

from advnerf_core.geometry import yaw_of
from hardware.worlds.lab.config import LabConfig, PhoneConfig
from hardware.worlds.lab.furniture import furnish
from hardware.worlds.lab.phone import (
    apply_colours,
    car_mounted_poses,
    track_length,
    track_pose,
    walk_around_poses,
)

CONFIG = LabConfig()


def test_track_is_the_documented_rounded_square():
    track = CONFIG.track
    assert track_length(track) == pytest.approx(4 * 1.8 + 2 * math.pi * 1.1)
    assert track_pose(track, 0.0) == pytest.approx((-0.9, -2.0, 0.0))
    assert track_pose(track, 1.8) == pytest.approx((0.9, -2.0, 0.0))
    middle = track_pose(track, 1.8 + 0.25 * math.pi * 1.1)
    assert middle == pytest.approx((0.9 + 1.1 * math.sqrt(0.5), -0.9 - 1.1 * math.sqrt(0.5), 0.25 * math.pi))
    assert track_pose(track, 1.8 + 0.5 * math.pi * 1.1) == pytest.approx((2.0, -0.9, 0.5 * math.pi))


def test_track_heading_is_the_tangent_everywhere():
    for s in np.linspace(0.01, track_length(CONFIG.track) - 0.01, 200):
        x0, y0, _ = track_pose(CONFIG.track, s - 1e-5)
        x1, y1, _ = track_pose(CONFIG.track, s + 1e-5)
        yaw = track_pose(CONFIG.track, s)[2]
        assert math.hypot(x1 - x0, y1 - y0) == pytest.approx(2e-5, rel=1e-3)
        assert abs(math.remainder(math.atan2(y1 - y0, x1 - x0) - yaw, 2 * math.pi)) < 1e-3


def test_walk_is_at_eye_height_clear_of_furniture_and_all_around():
    poses = np.array(walk_around_poses(CONFIG, 120, np.random.default_rng(3)))
    centres = poses[:, :3, 3]
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0)
    assert ((centres[:, 2] >= 0.9) & (centres[:, 2] <= 1.7)).all()
    assert (np.abs(centres[:, :2]) <= 3.5).all()
    assert np.ptp(np.degrees(np.arctan2(centres[:, 1], centres[:, 0]))) > 350
    looks_in = (poses[:, :3, 2] * centres).sum(axis=1) < 0
    assert 0.4 < looks_in.mean() < 0.7
    for solid in furnish(CONFIG):
        level = np.abs(centres[:, 2] - solid.centre_m[2]) < solid.half_m[2]
        touching = level & (np.linalg.norm((centres - solid.centre_m)[:, :2], axis=1) < min(solid.half_m[:2]))
        assert not touching.any(), solid


def test_car_mounted_photos_are_low_forward_and_along_the_whole_track():
    poses = np.array(car_mounted_poses(CONFIG, 160, np.random.default_rng(4)))
    heights = poses[:, 2, 3]
    assert ((heights >= CONFIG.phone.mount_height_m[0]) & (heights <= CONFIG.phone.mount_height_m[1])).all()
    pitch = np.degrees(np.arcsin(-poses[:, 2, 2]))
    assert pitch.mean() == pytest.approx(10.0, abs=1.5)
    headings = np.array([yaw_of(np.c_[T[:, 2], T[:, 1:]]) for T in poses])
    assert np.histogram(headings % (2 * math.pi), bins=8, range=(0, 2 * math.pi))[0].min() > 5
    beyond = (np.abs(poses[:, :2, 3]).max(axis=1) > 2.3).mean()
    assert 0.05 < beyond < 0.5  # some views from where a car goes that misses the corner


def test_poses_depend_on_the_generator_only():
    first = walk_around_poses(CONFIG, 5, np.random.default_rng(1))
    again = walk_around_poses(CONFIG, 5, np.random.default_rng(1))
    np.testing.assert_array_equal(first, again)
    assert car_mounted_poses(CONFIG, 0, np.random.default_rng(1)) == []


def test_colours_follow_the_formula():
    phone = PhoneConfig(colour_matrix=((0.9, 0.1, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.8)), gamma=0.5)
    rgb = np.array([[[100, 200, 50]]], dtype=np.uint8)
    expected = np.sqrt([(0.9 * 100 + 0.1 * 200) / 255, 200 / 255, 0.8 * 50 / 255]) * 255
    np.testing.assert_allclose(apply_colours(rgb, phone)[0, 0], expected, atol=0.51)


def test_the_phones_colours_differ_modestly():
    rgb = np.random.default_rng(0).integers(20, 235, (50, 50, 3), dtype=np.uint8)
    difference = np.sqrt(np.mean((apply_colours(rgb, CONFIG.phone).astype(float) - rgb) ** 2)) / 255
    assert 0.01 < difference < 0.05
