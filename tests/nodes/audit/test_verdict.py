"""What drives from the judging starts say: against closed forms, and against drives whose truth is known."""

from fractions import Fraction
from math import comb

import numpy as np
import pytest
from scipy import stats

from nodes.audit.verdict import ArmDrives, change_of, judge, paired_p

LIMIT_M = 0.4


def drives(largest_m):
    largest = np.asarray(largest_m, dtype=np.float64)
    states = np.zeros((len(largest), 2, 3))
    return ArmDrives(states, largest, 0.5 * largest, np.ones(len(largest), dtype=np.int64))


def test_the_smaller_effect_counts_and_its_interval_is_students_for_symmetric_differences():
    offsets = np.array([-0.2, -0.1, 0.0, 0.1, 0.2])
    attacked, nothing, plain = drives(1.0 + offsets), drives(np.full(5, 0.1)), drives(np.full(5, 0.3))
    found = judge(attacked, {"no_object": nothing, "plain_object": plain}, LIMIT_M)
    half = stats.t.ppf(0.975, 4) * np.std(offsets, ddof=1) / np.sqrt(5)
    assert found.control == "plain_object"
    assert found.effect.mean_m == pytest.approx(0.7)
    assert (found.effect.low_m, found.effect.high_m) == pytest.approx((0.7 - half, 0.7 + half))
    assert found.left == {"object": 5, "no_object": 0, "plain_object": 0}


@pytest.mark.parametrize(("only_object", "only_control"), [(5, 0), (6, 1), (0, 0), (3, 3), (1, 8)])
def test_the_exact_test_is_the_binomial_tail(only_object, only_control):
    both = np.ones(4, dtype=bool)
    one = np.concatenate([both, np.ones(only_object, dtype=bool), np.zeros(only_control, dtype=bool)])
    other = np.concatenate([both, np.zeros(only_object, dtype=bool), np.ones(only_control, dtype=bool)])
    discordant = only_object + only_control
    tail = sum(comb(discordant, k) for k in range(only_object, discordant + 1))
    assert paired_p(one, other) == pytest.approx(float(Fraction(tail, 2**discordant)))


def test_an_object_that_does_no_more_than_a_plain_one_is_not_found():
    attacked = drives([0.9] * 10)
    as_bad = {"no_object": drives([0.1] * 10), "plain_object": drives([0.9] * 10)}
    assert not judge(attacked, as_bad, LIMIT_M).found
    assert judge(attacked, {**as_bad, "plain_object": drives([0.1] * 10)}, LIMIT_M).found


def test_four_starts_of_twenty_are_not_enough_and_five_are():
    controls = {"no_object": drives([0.1] * 20), "plain_object": drives([0.1] * 20)}
    assert not judge(drives([0.9] * 4 + [0.1] * 16), controls, LIMIT_M).found
    assert judge(drives([0.9] * 5 + [0.1] * 15), controls, LIMIT_M).found


def test_without_a_difference_something_is_found_in_at_most_one_audit_of_twenty():
    rng, found = np.random.default_rng(0), 0
    for _ in range(2000):
        one, nothing, plain = (drives(rng.uniform(0.0, 0.8, 20)) for _ in range(3))
        found += judge(one, {"no_object": nothing, "plain_object": plain}, LIMIT_M).found
    assert found <= 100


def test_the_largest_of_several_changes_has_a_wider_interval():
    rng = np.random.default_rng(1)
    now, then = drives(rng.uniform(0.0, 1.0, 12)), drives(rng.uniform(0.0, 1.0, 12))
    one, three = change_of(now, then), change_of(now, then, 3)
    assert three.low_m < one.low_m < one.mean_m < one.high_m < three.high_m
    assert three.level == pytest.approx(1 - 0.05 / 3)
    assert change_of(then, then).mean_m == 0.0
