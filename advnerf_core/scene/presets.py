"""Named settings for scenes from photographs: sizes of the field, and a training of minutes on a CPU.

Measured on one set of photographs only, Instant-NGP's fox.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.scene.train_config import TrainConfig


@dataclass(frozen=True)
class ScenePreset:
    """Settings for a training time.

    Attributes:
        minutes: The training time that the settings suit [min].
        grid: Sizes of the hash grid over a bounded box.
        training: Settings of the training; the time limit comes from ``minutes``.
    """

    minutes: float
    grid: HashGridConfig
    training: TrainConfig

    def train_config(self, minutes: float | None = None, steps: int | None = None) -> TrainConfig:
        """Settings for a training of this many minutes or steps; for the preset's own time if neither is given."""
        if minutes is None and steps is not None:
            return replace(self.training, steps=steps)
        seconds = 60.0 * (self.minutes if minutes is None else minutes)
        return replace(self.training, steps=steps or self.training.steps, max_seconds=seconds)

    def grid_for(self, contraction: bool) -> HashGridConfig:
        """The grid over the box; a contracted cube is twice as wide as its inner region, so twice the cells keep the detail."""
        return replace(self.grid, finest=2 * self.grid.finest) if contraction else self.grid


# Bands of spherical harmonics, for the gloss in photographs.
PHOTOGRAPH_BANDS = 3
# Found by `python -m benchmarks.learning_rates` on photographs, a room, a road and a town. Experiments use the same.
FAST = TrainConfig(learning_rate=0.02, decay="cosine")
# Ends by time: no training takes this many steps in minutes.
_NO_LIMIT_STEPS = 1_000_000
_COMMON = replace(FAST, steps=_NO_LIMIT_STEPS, refine_depth=0.005, distortion=2e-3)
_GRID = HashGridConfig(levels=8, features=4, log2_entries=18)

PRESETS = {
    # Smaller steps, samples front to back and coarser intervals were tried for three minutes on fox, and were no better.
    "minutes": ScenePreset(3.0, _GRID, _COMMON),
    "best": ScenePreset(10.0, _GRID, _COMMON),
}
