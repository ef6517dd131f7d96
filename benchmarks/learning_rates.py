"""Which learning rate makes the sharper scene? ``python -m benchmarks.learning_rates SCENE... [--steps N]``.

Trains the preset ``minutes`` for equally many steps at several rates that fall in two ways, and compares held-out photographs, every eighth.
A scene is a folder with ``transforms.json`` and Instant-NGP's box (``../shared/data/fox``), or a run folder, of which the photographs and the
world's box are taken.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.views import ImageSet, PosedImages
from advnerf_core.scene.field import SceneFieldConfig
from advnerf_core.scene.presets import PHOTOGRAPH_BANDS, PRESETS
from advnerf_core.scene.train import train_scene
from benchmarks.exposure import compare
from benchmarks.results import record_row
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps import capture
from nodes.experiment.steps.scene import field_config

WAYS = (("exponential", 0.01), ("cosine", 0.01), ("cosine", 0.02), ("cosine", 0.03))
_EVERY, _MOST_HELD_OUT = 8, 12
_NEAR = 0.3  # in the unit of a transforms.json; run folders have their own


def main() -> None:
    """Train each scene each way, and record what the presets gain over the default."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--width", type=int, default=320, help="photographs are brought to this width")
    arguments = parser.parse_args()
    for folder in arguments.scenes:
        name, photographs, field, near = _scene(folder)
        learned, kept = photographs.split(_EVERY)
        kept = replace(kept, frames=kept.frames[:_MOST_HELD_OUT])
        training, held_out = (_loaded(part, arguments.width) for part in (learned, kept))
        found = {}
        for decay, rate in WAYS:
            config = replace(
                PRESETS["minutes"].train_config(steps=arguments.steps),
                near_m=near,
                decay=decay,
                learning_rate=rate,
            )
            if field.contraction:
                config = replace(config, opacity=0.0)
            found[decay, rate], _ = compare(train_scene(training, field, config), held_out)
            print(f"{name}, {decay} from {rate:g}: {found[decay, rate]:.2f} dB", flush=True)
        chosen = PRESETS["minutes"].training
        gain_db = found[chosen.decay, chosen.learning_rate] - found[WAYS[0]]
        record_row(
            f"{name}: the presets' learning rate against an exponential fall from 0.01, held-out PSNR",
            gain_db,
            "dB",
            "> 0 dB",
            gain_db > 0.0,
            f"python -m benchmarks.learning_rates {folder} --steps {arguments.steps}",
            f"{len(training.rgb)} photographs, {arguments.width} pixels wide: "
            + ", ".join(f"{decay} from {rate:g} {db:.2f} dB" for (decay, rate), db in found.items()),
        )


def _scene(folder: Path) -> tuple[str, PosedImages, SceneFieldConfig, float]:
    """Name, photographs, field and nearest distance of what is learned."""
    preset = PRESETS["minutes"]
    if (folder / "manifest.json").exists():
        experiment = Experiment.resolved_in(folder.resolve())
        field = field_config(experiment)
        field = replace(field, grid=preset.grid_for(field.contraction), direction_bands=PHOTOGRAPH_BANDS)
        photographs = load_transforms(experiment.stage_folder("capture") / capture.PHOTOS)
        return experiment.config.name, photographs, field, experiment.config.scene.near_m
    listed = load_transforms(folder).sorted_by_name()
    low, high = ((float(x), float(y), float(z)) for x, y, z in listed.box())
    field = SceneFieldConfig(low, high, preset.grid_for(False), direction_bands=PHOTOGRAPH_BANDS)
    return folder.name, listed, field, _NEAR


def _loaded(listed: PosedImages, width: int) -> ImageSet:
    whole = listed.frames[0]
    height = round(width * whole.pinhole.height / whole.pinhole.width)
    return listed.load((width, height))


if __name__ == "__main__":
    main()
