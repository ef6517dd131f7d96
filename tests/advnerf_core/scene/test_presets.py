"""The presets for scenes from photographs, and the settings that they rest on."""

import dataclasses

import numpy as np
import pytest

from advnerf_core.data.views import ImageSet
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.geometry import Pinhole, look_at
from advnerf_core.render.march import MarchConfig
from advnerf_core.scene.field import SceneFieldConfig
from advnerf_core.scene.presets import PRESETS
from advnerf_core.scene.train import TrainConfig, Trainer


def test_presets_end_by_time_unless_steps_are_given() -> None:
    minutes, best = PRESETS["minutes"], PRESETS["best"]
    assert minutes.train_config().max_seconds == 180.0
    assert best.train_config().max_seconds == 600.0
    assert best.train_config(minutes=2.0).max_seconds == 120.0
    by_steps = best.train_config(steps=7)
    assert (by_steps.steps, by_steps.max_seconds) == (7, None)


def test_a_contracted_field_gets_twice_the_finest_cells() -> None:
    for preset in PRESETS.values():
        assert preset.grid_for(False) == preset.grid
        assert preset.grid_for(True).finest == 2 * preset.grid.finest


def images() -> ImageSet:
    """Two bright pictures of a box from outside."""
    lens = Pinhole(8, 8, 10.0, 10.0, 4.0, 4.0)
    poses = np.stack([look_at([3.0, 0.0, 0.5], [0.5] * 3), look_at([0.0, 3.0, 0.5], [0.5] * 3)])
    return ImageSet(np.full((2, 8, 8, 3), 230, np.uint8), (lens, lens), poses)


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_a_preset_trains(name: str) -> None:
    field = SceneFieldConfig(
        (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), HashGridConfig(4, 4, log2_entries=10, finest=64)
    )
    march = MarchConfig(near_m=0.1, smallest_step_m=0.02, largest_step_m=0.1, step_growth=0.02)
    config = dataclasses.replace(
        PRESETS[name].train_config(steps=8), occupancy_resolution=8, max_rays=256, march=march
    )
    trainer = Trainer(images(), field, config)
    results = [trainer.train_step() for _ in range(8)]
    assert results[-1].loss < results[0].loss


def test_rates_fall_from_the_first_to_the_last_either_way() -> None:
    exponential = TrainConfig(learning_rate=0.02, final_rate=0.01)
    cosine = dataclasses.replace(exponential, decay="cosine")
    for config in (exponential, cosine):
        assert config.rate(0.0) == pytest.approx(0.02)
        assert config.rate(1.0) == pytest.approx(0.0002)
    assert exponential.rate(0.5) == pytest.approx(0.002)  # the geometric mean
    assert cosine.rate(0.5) == pytest.approx(0.0101)  # the arithmetic mean
    with pytest.raises(ValueError, match="exponential, cosine, got 'linear'"):
        TrainConfig(decay="linear")
