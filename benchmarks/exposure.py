"""What is a gain per photograph worth? Held-out PSNR with and without ``--exposure``, at equal steps, on three kinds of data.

- ``fox``: Instant-NGP's photographs by a phone.
- ``car``: pictures with alpha of a generated car.
- ``lab``: a phone's photographs of the simulated lab.

All are trained with the preset ``best``. ``--spread 0.2`` multiplies the training pictures by known gains, log-normal with that spread
and the same in every run. The recovered gains are then compared with them, up to the common factor. Held-out pictures are never
changed. They are compared as rendered, at the mean exposure, and, separately, after fitting a gain to each.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from advnerf_core.data.views import ImageSet
from advnerf_core.geometry import Array
from advnerf_core.scene.metrics import gain_fitted, psnr
from advnerf_core.scene.presets import PHOTOGRAPH_BANDS, PRESETS
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.train import TrainConfig, TrainedScene, train_scene
from benchmarks.results import record_row
from benchmarks.sample_intervals import Case, fox, room, standing_back

COMMAND = "python -m benchmarks.exposure"
STEPS = 1000
CASES = {"fox": fox, "car": standing_back, "lab": room}
# A gain that is not needed may cost so much; one that is needed must be worth so much.
MOST_LOSS_DB, LEAST_GAIN_DB = 0.1, 1.0
_NEAR = {"fox": 0.3, "car": 0.05, "lab": 0.1}


@dataclass(frozen=True)
class Outcome:
    """A training, compared with held-out pictures.

    Attributes:
        plain_db: Mean PSNR as rendered [dB].
        fitted_db: Mean PSNR after fitting a gain to each picture [dB].
        log_error: Root mean square error of the logarithms of the gains, their common factor aside; None if not learned.
        log_spread: Root mean square of those logarithms; None if not learned.
    """

    plain_db: float
    fitted_db: float
    log_error: float | None
    log_spread: float | None


def main() -> None:
    """Train with and without, compare, print and record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data/fox"), help="folder of the fox")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--steps", type=int, default=STEPS, help="fewer or more are not recorded")
    parser.add_argument("--spread", type=float, default=0.0, help="of the logarithms of known gains")
    arguments = parser.parse_args()
    for name in arguments.cases:
        case = CASES[name](arguments.data)
        logs = known_gains(len(case.training.rgb), arguments.spread)
        images = exposed(case.training, logs)
        off, on = (learn(name, case, images, logs, arguments.steps, exposure) for exposure in (False, True))
        gain_db = on.plain_db - off.plain_db
        gains = f"gains found: spread {on.log_spread:.3f}"
        if arguments.spread:
            gains += f", {on.log_error:.3f} from the known ones"
        note = (
            f"held-out PSNR {on.plain_db:.2f} against {off.plain_db:.2f} dB; after fitting a gain to each picture "
            f"{on.fitted_db:.2f} against {off.fitted_db:.2f} dB; {gains}; {arguments.steps} steps each"
        )
        print(f"{name}: {gain_db:+.2f} dB; {note}", flush=True)
        if arguments.steps == STEPS:
            record(name, arguments.spread, gain_db, note)


def record(name: str, spread: float, gain_db: float, note: str) -> None:
    """Write the row of one kind of data."""
    least_db = LEAST_GAIN_DB if spread else -MOST_LOSS_DB
    taken = f"gains of spread {spread:g}" if spread else "as taken"
    command = f"{COMMAND} --cases {name}" + (f" --spread {spread:g}" if spread else "")
    target = None if name == "fox" and not spread else gain_db >= least_db
    words = "printed" if target is None else f">= {least_db:g} dB"
    record_row(
        f"exposure per photograph, {name}, {taken}: PSNR gained", gain_db, "dB", words, target, command, note
    )


def known_gains(count: int, spread: float) -> Array:
    """Logarithms of gains ``[count, 3]``, with mean zero in each channel."""
    logs = spread * np.random.default_rng(17).standard_normal((count, 3))
    centred: Array = logs - logs.mean(axis=0)
    return centred


def exposed(images: ImageSet, logs: Array) -> ImageSet:
    """Images times gains, as a camera would store them: rounded, and cut off at 255."""
    bright = np.rint(images.rgb * np.exp(logs)[:, None, None])
    return replace(images, rgb=np.clip(bright, 0, 255).astype(np.uint8))


def learn(name: str, case: Case, images: ImageSet, logs: Array, steps: int, exposure: bool) -> Outcome:
    """Train with the preset ``best`` for so many steps, and compare."""
    preset = PRESETS["best"]
    config = replace(
        preset.training,
        steps=steps,
        near_m=_NEAR[name],
        opacity=0.0 if images.alpha is not None else TrainConfig.opacity,
        exposure=exposure,
        warmup_steps=min(TrainConfig.warmup_steps, steps // 4),
    )
    field = replace(case.field, grid=preset.grid_for(contraction=False), direction_bands=PHOTOGRAPH_BANDS)
    trained = train_scene(images, field, config)
    plain_db, fitted_db = compare(trained, case.held_out)
    if trained.gains is None:
        return Outcome(plain_db, fitted_db, None, None)
    found = np.log(trained.gains)
    return Outcome(plain_db, fitted_db, _rms(found - logs), _rms(found))


def compare(trained: TrainedScene, views: ImageSet) -> tuple[float, float]:
    """Mean PSNR [dB] as rendered, and after fitting a gain to each picture."""
    renderer = FieldRenderer(trained.scene, trained.occupied, trained.march, least_transmittance=1e-3)
    scores = []
    for index, real in enumerate(views.on_background((1.0, 1.0, 1.0))):
        rgb, _, alpha = renderer.render(views.T_world_from_camera[index][None], views.pinholes[index])
        white = 0.0 if views.alpha is None else 1.0 - alpha[0].numpy()[..., None]
        ours, theirs = rgb[0].numpy(), real / 255.0
        scores.append((psnr(ours, theirs), psnr(gain_fitted(ours, theirs, white), theirs)))
    plain_db, fitted_db = np.mean(scores, axis=0)
    return float(plain_db), float(fitted_db)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    main()
