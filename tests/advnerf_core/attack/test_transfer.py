"""The prediction against drives that are known: a policy that steers by what the picture says, and pictures that say the steering."""

import numpy as np
import pytest
import torch

from advnerf_core.attack.problem import AttackProblem
from advnerf_core.attack.transfer import TransferPrediction, predict_transfer
from advnerf_core.driving.dynamics import Dubins
from advnerf_core.driving.metrics import Horizon, drive_metrics
from advnerf_core.driving.path import Line, Path
from advnerf_core.driving.rollout import drive
from advnerf_core.scene.fidelity import Effect, SceneAgreement

PATH = Path.from_segments((0.0, 0.0, 0.0), [Line(50.0)], closed=False)
HORIZON = Horizon(20, 0.1, 0.4)
CAR = Dubins(1.0, 0.1)
START = torch.zeros(1, 3, dtype=torch.float64)
TURN = 0.8  # what the attack adds to the turn rate [rad/s]


class Reads:
    """Steers as the picture says."""

    stateless = True

    def __call__(self, images, goals=None):
        return images[:, 0, 0, 0]


class Nothing:
    theta_shape = (1,)


def images(states, attacked):
    # Without the attack it steers back to the path; the attack adds a constant.
    steering = -0.5 * states[:, 1] - 1.0 * states[:, 2] + (TURN if attacked else 0.0)
    return steering[:, None, None, None]


def problem():
    return AttackProblem(Reads(), Nothing(), CAR, PATH, START, 20)


def views(difference, effect_learned, effect_real):
    ones = np.ones(len(difference))
    return SceneAgreement(30 * ones, ones, 0 * ones, np.asarray(difference)), Effect(
        np.asarray(effect_learned), np.asarray(effect_real)
    )


def driven(turn):
    rollout = drive(Reads(), lambda s: images(s, False) + turn, CAR, START, HORIZON.ticks)
    return drive_metrics(PATH, rollout.states[:, 0].numpy(), HORIZON).total_cte_m


@pytest.mark.parametrize("share", [1.0, 0.5, 0.0])
def test_without_disagreement_it_is_the_drive_with_that_share_of_the_effect(share):
    clean, effect = views(np.zeros(16), np.full(16, TURN), np.full(16, share * TURN))
    found = predict_transfer(problem(), CAR, images, clean, effect, START, HORIZON, draws=9)
    assert found.attacked_m == pytest.approx([driven(share * TURN)] * 9)
    assert found.retained == pytest.approx(share)


def test_a_constant_disagreement_moves_the_clean_drive_by_its_size():
    # Learned pictures say 0.2 more than real ones, so the deployed car steers 0.2 less.
    clean, effect = views(np.full(16, 0.2), np.full(16, TURN), np.full(16, TURN))
    found = predict_transfer(problem(), CAR, images, clean, effect, START, HORIZON, draws=9)
    assert found.none_m == pytest.approx([driven(-0.2)] * 9)
    assert found.attacked_m == pytest.approx([driven(TURN - 0.2)] * 9)
    excess_m = (driven(TURN - 0.2) - driven(-0.2)) / HORIZON.ticks
    assert found.excess_m_per_tick == pytest.approx((excess_m,) * 3)


def test_draws_differ_by_what_was_measured_and_repeat_with_the_seed():
    noise = np.random.default_rng(0).normal(0.0, 0.3, 40)
    clean, effect = views(noise, np.full(40, TURN), np.full(40, TURN) + noise)
    first = predict_transfer(problem(), CAR, images, clean, effect, START, HORIZON, draws=12, seed=3)
    again = predict_transfer(problem(), CAR, images, clean, effect, START, HORIZON, draws=12, seed=3)
    assert first == again
    assert len(set(first.attacked_m)) == 12
    low, mean, high = first.excess_m_per_tick
    assert low < mean < high
    assert set(first.record()) >= {"excess_m", "excess_low_m", "excess_high_m", "retained", "draws"}
    other = Effect(effect.learned, 0.5 * effect.real)
    alone = predict_transfer(problem(), CAR, images, clean, other, START, HORIZON, draws=12, seed=3)
    assert alone.none_m == first.none_m != alone.attacked_m  # the drive without attack knows nothing of it
    assert (
        predict_transfer(
            problem(), CAR, images, clean, other, START, HORIZON, draws=12, seed=3, none_m=first.none_m
        )
        == alone
    )
    with pytest.raises(ValueError, match="at least 9 draws"):
        predict_transfer(problem(), CAR, images, clean, effect, START, HORIZON, draws=8)


def test_the_fence_stops_a_car_as_the_protocol_does():
    clean, effect = views(np.zeros(16), np.full(16, TURN), np.full(16, TURN))
    fenced = AttackProblem(Reads(), Nothing(), CAR, PATH, START, 20, fence_m=1.0, held_cap_m=0.1)
    found = predict_transfer(fenced, CAR, images, clean, effect, START, HORIZON, draws=9)
    assert found.attacked_m[0] < driven(TURN)


def test_the_excess_per_tick_is_that_of_each_draw_over_its_own_without_attack():
    none_m = (2.0, 2.0, 3.0) * 3
    found = TransferPrediction((4.0, 6.0, 8.0) * 3, none_m, 1.0, 20)
    low, mean, high = found.excess_m_per_tick
    assert (low, mean, high) == pytest.approx((0.1, (0.1 + 0.2 + 0.25) / 3, 0.25))
    assert found.record()["excess_m"] == mean


@pytest.mark.parametrize("draws", [9, 20])
@pytest.mark.parametrize("kind", ["normal", "exponential"])
def test_bands_hold_the_next_drive_in_80_percent_of_cases(draws, kind):
    values = getattr(np.random.default_rng(0), kind)(size=(4000, draws + 1))
    bands = np.array(
        [TransferPrediction(tuple(each), (0.0,) * draws, 1.0, 1).excess_m_per_tick for each in values[:, 1:]]
    )
    held = np.mean((bands[:, 0] <= values[:, 0]) & (values[:, 0] <= bands[:, 2]))
    assert held == pytest.approx(0.8, abs=0.025)  # four standard deviations
