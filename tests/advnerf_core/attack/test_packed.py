"""A packed attack file is the attack file again, to the bit."""

import numpy as np
import pytest

from advnerf_core.attack.artifact import AttackFileError, load_attack, save_attack
from advnerf_core.geometry import Pinhole
from tests.support.faces import face_attack


def attack(theta, texture=None):
    return face_attack(
        theta=theta, size_m=(1.0, 1.0), subject="board", corners_in_subject=np.eye(4, 3), T_world_from_object=np.eye(4), texture=texture,
        method="gradient", camera=Pinhole(200, 66, 100.0, 100.0, 100.0, 33.0), scene_sha256="s", policy_sha256="p", config_sha256="c", seed=3,
        predicted_total_cte_m=4.0, software_version="1",
    )  # fmt: skip


@pytest.mark.parametrize("exact", [True, False])
@pytest.mark.parametrize("own_texture", [True, False])
def test_it_is_restored_whatever_can_be_left_out(tmp_path, exact, own_texture):
    rng = np.random.default_rng(0)
    theta = rng.normal(0.0, 3.0, (64, 64, 3)).astype(np.float16 if exact else np.float32).astype(np.float32)
    texture = rng.integers(0, 256, (512, 512, 3), dtype=np.uint8) if own_texture else None
    there = attack(theta, texture)
    assert save_attack(tmp_path / "small", there, small=True) == save_attack(tmp_path / "whole", there)
    again = load_attack(tmp_path / "small")
    assert again.sha256 == there.sha256
    assert np.array_equal(again.face_object.theta, theta)
    assert np.array_equal(again.face.texture, there.face.texture)
    shares = (tmp_path / "small").stat().st_size / (tmp_path / "whole").stat().st_size
    assert own_texture or shares < (0.035 if exact else 0.065)


def test_a_changed_texel_is_found(tmp_path):
    save_attack(tmp_path / "small", attack(np.zeros((8, 8, 3), np.float32)), small=True)
    data = bytearray((tmp_path / "small").read_bytes())
    data[-1] ^= 0x40
    (tmp_path / "small").write_bytes(data)
    with pytest.raises(AttackFileError, match="was changed after it was saved"):
        load_attack(tmp_path / "small")
