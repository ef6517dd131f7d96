"""Fine-tuning: a policy that is wrong about a red image learns it, and does not forget the rest."""

from pathlib import Path

import numpy as np
import pytest
import torch

from advnerf_core.geometry import Pinhole
from advnerf_core.learning.augment import AugmentConfig
from advnerf_core.learning.frames import Frames, FrameStoreError
from advnerf_core.learning.retrain import FineTuneConfig, MixedFrames, fine_tune
from advnerf_core.policies.architecture import PilotNetConfiguration
from advnerf_core.policies.network import images_to_tensor
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import load_policy, save_policy
from advnerf_core.policies.view import PolicyView

VIEW = PolicyView(Pinhole(336, 188, 174.0, 174.0, 168.0, 94.0))
QUIET = AugmentConfig()


def frames(count, red, steering_rad, goals=0, seed=0):
    rng = np.random.default_rng(seed)
    images = rng.integers(60, 100, (count, 66, 200, 3)).astype(np.uint8)
    if red:
        images[:, 20:40, 80:120] = [250, 10, 10]
    return Frames(
        images,
        np.zeros((count, 3)),
        np.full(count, steering_rad, np.float32),
        np.zeros((count, goals), np.float32),
        np.full(count, red),
    )


@pytest.fixture
def policy(tmp_path):
    torch.manual_seed(0)
    save_policy(
        tmp_path / "old.safetensors",
        PilotNet(configuration=PilotNetConfiguration(hidden=(16, 8, 4))),
        VIEW,
        {"kind": "test"},
    )
    return load_policy(tmp_path / "old.safetensors")


def steering(path, shown):
    with torch.no_grad():
        return float(load_policy(path).policy(images_to_tensor(shown.images)).mean())


def test_new_frames_take_their_share_by_repetition_and_none_is_dropped():
    old, new = frames(90, False, 0.0), frames(10, True, 0.2)
    mixed = MixedFrames([old], [new], 0.4, 0)
    is_new = mixed.training[:, 0] == 1
    assert is_new.sum() == 60  # 90 * 0.4 / 0.6
    assert np.bincount(mixed.training[is_new, 1]).tolist() == [6] * 10
    assert sorted(mixed.training[~is_new, 1].tolist()) == list(range(90))
    assert len(MixedFrames([old], [new], None, 0).training) == 100


def test_it_learns_the_new_and_keeps_the_old(policy, tmp_path):
    old, new = frames(96, False, 0.1), frames(32, True, -0.1)
    config = FineTuneConfig(steps=40, batch_size=16, learning_rate=2e-3, holdout_every=2, augment=QUIET)
    done = fine_tune(policy, [old], [new], config, tmp_path / "new.safetensors")
    assert done.new_mae_rad[1] < 0.4 * done.new_mae_rad[0]
    assert done.old_mae_rad[1] < 0.04
    assert steering(done.path, frames(8, False, 0.0, seed=5)) > 0.06
    assert steering(done.path, frames(8, True, 0.0, seed=5)) < -0.06
    loaded = load_policy(done.path, done.sha256)
    assert loaded.metadata["fine_tuned_from"] == policy.sha256
    # what was given is as it was
    assert load_policy(tmp_path / "old.safetensors").sha256 == policy.sha256
    for name, weight in load_policy(tmp_path / "old.safetensors").policy.state_dict().items():
        assert torch.equal(weight, policy.policy.state_dict()[name])


def test_a_stopped_one_ends_in_the_same_weights(policy, tmp_path):
    old, new = [frames(32, False, 0.1)], [frames(16, True, -0.1)]
    config = FineTuneConfig(steps=12, batch_size=8, holdout_every=0, augment=QUIET)

    class Stop(Exception):
        pass

    def stop(step: int, loss: float) -> None:
        raise Stop

    whole = fine_tune(policy, old, new, config, tmp_path / "whole.safetensors")
    with pytest.raises(Stop):
        fine_tune(policy, old, new, config, tmp_path / "twice.safetensors", stop)
    again = fine_tune(policy, old, new, config, tmp_path / "twice.safetensors")
    assert again.sha256 == whole.sha256
    assert not Path(tmp_path / ".twice.safetensors.tmp").exists()


def test_what_does_not_fit_is_refused(policy, tmp_path):
    one = [frames(16, False, 0.0)]
    with_goals = [frames(16, False, 0.0, goals=3)]
    with pytest.raises(FrameStoreError, match="goals of size 0 for this policy, got 3"):
        fine_tune(policy, with_goals, with_goals, FineTuneConfig(steps=1), tmp_path / "x.safetensors")
    with pytest.raises(FrameStoreError, match="old and new frames, got 1 old and 0 new"):
        MixedFrames(one, [], 0.5, 0)
    with pytest.raises(ValueError, match="between 0 and 1"):
        FineTuneConfig(new_share=1.0)
