"""Does a killed scene training end as good as one that was left alone?

Each round trains a small scene of the lab in a process of its own, kills it (SIGKILL) at a random moment, starts it again in the
same folder until it ends, and compares what it shows of held-out views with what an undisturbed training shows.
"""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from advnerf_core.data.views import ImageSet
from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from advnerf_core.geometry import Pinhole
from advnerf_core.scene.field import SceneFieldConfig
from advnerf_core.scene.metrics import psnr
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.train import TrainConfig, train_scene
from benchmarks.training_step import photograph_lab
from tests.support.live.processes import REPOSITORY

IMAGES, CHECKPOINT, RESULT = "images.npz", "checkpoint.safetensors", "result.json"
TOLERANCE_DB = 0.1
REDUCE = 4  # images are averaged over squares of so many pixels: small, so that twenty trainings are minutes
HELD_OUT_EVERY = 8
STEPS, PHOTOGRAPHS = 200, 48


def photograph(path: Path, count: int) -> None:
    """Write small photographs of the lab, with all that training asks for."""
    images, field = photograph_lab(count)
    n, height, width, _ = images.rgb.shape
    squares = images.rgb.reshape(n, height // REDUCE, REDUCE, width // REDUCE, REDUCE, 3)
    lens = images.pinholes[0]
    np.savez(
        path,
        rgb=np.rint(squares.mean(axis=(2, 4))).astype(np.uint8),
        poses=images.T_world_from_camera,
        lens=np.array([lens.fx, lens.fy, lens.cx, lens.cy]) / REDUCE,
        box=np.array([field.box_low_m, field.box_high_m]),
    )


def load(path: Path) -> tuple[ImageSet, ImageSet, SceneFieldConfig]:
    """Training images, held-out images and the box."""
    with np.load(path) as held:
        rgb, poses, (fx, fy, cx, cy), (low, high) = (
            held["rgb"],
            held["poses"],
            held["lens"].tolist(),
            held["box"].tolist(),
        )
    lens = Pinhole(rgb.shape[2], rgb.shape[1], fx, fy, cx, cy)
    out = np.arange(len(rgb)) % HELD_OUT_EVERY == 0
    training, held_out = (ImageSet(rgb[part], (lens,) * int(part.sum()), poses[part]) for part in (~out, out))
    return training, held_out, SceneFieldConfig(tuple(low), tuple(high))


def run_in(folder: Path, images: Path, steps: int) -> None:
    """The whole training, or the rest of it; ends in a file with the held-out PSNR."""
    training, held_out, box = load(images)
    # Checkpoints as often as anyone could want them, so that kills strike while one is written, too.
    config = TrainConfig(steps=steps, samples_per_step=1 << 15, checkpoint_every_s=0.2, backend="numba")
    trained = train_scene(training, box, config, folder / CHECKPOINT)
    renderer = FieldRenderer(trained.scene, trained.occupied, trained.march)
    shown = renderer.render(held_out.T_world_from_camera, held_out.pinholes[0])[0].numpy()
    scores = [psnr(a, b / 255.0) for a, b in zip(shown, held_out.rgb, strict=True)]
    write_atomically(folder / RESULT, json.dumps({"psnr_db": float(np.mean(scores))}))


@contextmanager
def running(folder: Path, images: Path, steps: int) -> Iterator[subprocess.Popen[bytes]]:
    """The training in a process of its own, which does not outlive this."""
    command = [sys.executable, "-m", "tests.campaigns.scene_kill", str(folder), str(images), str(steps)]
    process = subprocess.Popen(command, cwd=REPOSITORY)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


def until_first_checkpoint(folder: Path, process: subprocess.Popen[bytes]) -> None:
    """Wait until there is something to lose."""
    while process.poll() is None and not (folder / CHECKPOINT).exists():
        time.sleep(0.002)


def finished(folder: Path, images: Path, steps: int) -> tuple[float, float]:
    """Train to the end; held-out PSNR [dB], and time from the first checkpoint to the end [s]."""
    with running(folder, images, steps) as process:
        until_first_checkpoint(folder, process)
        began = time.monotonic()
        if process.wait() != 0:
            raise RuntimeError(f"expected the training in {folder} to end well; see what it printed above")
    return float(read_json(folder / RESULT)["psnr_db"]), time.monotonic() - began


def killed_and_resumed(folder: Path, images: Path, steps: int, after_s: float) -> tuple[float, bool]:
    """Kill at a moment, then train to the end; also whether the training was at work when it was killed."""
    with running(folder, images, steps) as process:
        until_first_checkpoint(folder, process)
        time.sleep(after_s)
        process.send_signal(signal.SIGKILL)
        struck = process.wait() == -signal.SIGKILL
    return finished(folder, images, steps)[0], struck


def kill_many(kills: int, steps: int = STEPS, seed: int = 0) -> tuple[float, list[float]]:
    """Held-out PSNR of an undisturbed training [dB], and how far from it those ended that were hit while at work [dB]."""
    moments = random.Random(seed)
    differences_db: list[float] = []
    with tempfile.TemporaryDirectory() as name:
        images, alone = Path(name) / IMAGES, Path(name) / "alone"
        photograph(images, PHOTOGRAPHS)
        alone.mkdir()
        undisturbed_db, lasted_s = finished(alone, images, steps)
        for number in range(3 * kills):
            if len(differences_db) == kills:
                break
            folder = Path(name) / str(number)
            folder.mkdir()
            after_s = moments.uniform(0.0, 0.9 * lasted_s)
            got_db, struck = killed_and_resumed(folder, images, steps, after_s)
            if struck:
                differences_db.append(abs(got_db - undisturbed_db))
            print(
                f"killed after {after_s:.2f} s{'' if struck else ' (had ended)'}: {got_db:.3f} dB, undisturbed {undisturbed_db:.3f} dB",
                flush=True,
            )
    return undisturbed_db, differences_db


if __name__ == "__main__":
    run_in(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
