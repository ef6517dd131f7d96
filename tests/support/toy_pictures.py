"""Real and learned pictures of toy cells, in place of `nodes.experiment.steps.fidelity`: a policy reads its steering off one pixel.

Real pictures keep half of what the attack does on learned ones.
"""

import numpy as np
import torch

from advnerf_core.attack.problem import AttackProblem
from advnerf_core.driving.dynamics import Dubins
from advnerf_core.driving.metrics import Horizon
from advnerf_core.driving.path import Line, Path
from advnerf_core.scene.fidelity import PicturePairs
from nodes.runtime.errors import RuntimeFault

TURN, KEPT = 0.2, 0.5
START = torch.tensor([[0.0, 0.3, 0.0]], dtype=torch.float64)


class Reads:
    stateless = True

    def __call__(self, images, goals=None):
        return images[:, 0, 0, 0] - 0.5


class Nothing:
    theta_shape = (1,)


def _pictures(of, real, learned):
    grain = np.random.default_rng(0).uniform(
        0.0, 0.1, (len(real), 66, 200, 3)
    )  # as SSIM of flat pictures says nothing
    grain[:, 0, 0] = 0.0

    def show(values):
        return np.round(255 * (grain + np.asarray(values)[:, None, None, None])).astype(np.uint8)

    return PicturePairs(of, show(real), show(learned))


def policy_of(experiment, cell):
    return Reads(), ()


def held_out(experiment):
    with open(experiment.folder / "looked.txt", "a") as file:
        file.write("held out\n")
    real = np.linspace(0.3, 0.6, 16)
    return _pictures("held-out views", real, real + experiment.data.get("wrong", 0.0))


def driven(experiment, cell, clean, bag=None):
    if experiment.data.get("late") and not clean.with_suffix(".json").exists():
        raise RuntimeFault("expected a live drive, got none")
    real = np.full(16, 0.5)
    return _pictures("driven bag", real, real + experiment.data.get("wrong_drive", 0.0))


def lacks(experiment, cell, folder, clean):
    return "" if (folder / "searched").exists() else "its search"


def attacked(experiment, cell, folder, clean):
    return _pictures("attacked", np.full(16, 0.5 + KEPT * TURN), np.full(16, 0.5 + TURN))


def loop(experiment, cell, folder, clean):
    path = Path.from_segments((0.0, 0.0, 0.0), [Line(50.0)], closed=False)

    def images(states, attacked):
        return (0.5 - 0.5 * states[:, 1] - states[:, 2] + TURN * attacked)[:, None, None, None]

    car = Dubins(1.0, 0.1)
    problem = AttackProblem(Reads(), Nothing(), car, path, START, 20)
    return problem, car, images, START, Horizon(20, 0.1, 0.4)
