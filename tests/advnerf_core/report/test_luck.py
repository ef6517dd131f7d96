"""Searches of a baseline that are strong where they search and do nothing where they are deployed."""

import pytest

from advnerf_core.report.evidence.luck import luck_of, luck_sentences

GRADIENT = [[0.05, 0.04], [0.06, 0.06], [0.04, 0.03]]


def means(pairs, side=1.0):
    return [{"surrogate_m": here, "deployed_m": there, "shift_m": side * here} for here, there in pairs]


def a_test(baseline, p_surrogate=0.4, side=1.0):
    return {
        "test": {"method": "gradient"},
        "baseline": "random_coarse",
        "p_surrogate": p_surrogate,
        "searches": {"gradient": means(GRADIENT), "random_coarse": means(baseline, side)},
    }


def test_lucky_searches_are_those_above_every_search_of_the_method():
    found = luck_of(a_test([[0.01, 0.01], [0.10, 0.01], [0.06, 0.01], [0.20, 0.01]]))
    assert [each["surrogate_m"] for each in found.lucky] == [0.20, 0.10]
    assert found.lucky_shares == pytest.approx((0.05, 0.1))
    assert found.method_shares == pytest.approx((0.8, 1.0, 0.75))
    assert found.difference_without_m == pytest.approx(0.05 - 0.035)


def test_the_sentences_name_what_is_left_of_them():
    text = luck_sentences(a_test([[0.01, 0.01], [0.10, 0.01], [0.20, 0.01]]))
    assert (
        "Of the 3 searches of random, coarse, 2 are stronger in the learned scene than every gradient search"
        in text
    )
    assert (
        "(0.200 and 0.100 m per tick). Deployed, 5 and 10 % of that is left; of the gradient searches 75 to 100 %"
        in text
    )
    assert "Without them, the difference where they search would be +0.040 m per tick." in text
    assert "other side" not in text
    alone = luck_sentences(a_test([[0.01, 0.01], [0.10, 0.01]]))
    assert "1 is stronger" in alone
    assert "Without it," in alone


def test_a_push_to_the_other_side_is_told():
    lucky = [[0.01, 0.01], [0.10, 0.01], [0.20, 0.01]]
    assert "They push the car to the other side of the path than every gradient" in luck_sentences(
        a_test(lucky, side=-1.0)
    )
    assert "It pushes the car to the other side" in luck_sentences(a_test(lucky[:2], side=-1.0))
    mixed = a_test(lucky)
    mixed["searches"]["gradient"][0]["shift_m"] = -0.01
    assert not luck_of(mixed).other_side
    assert not luck_of(a_test([[0.05, 0.05]], side=-1.0)).other_side


def test_nothing_is_explained_where_the_method_is_better_or_no_search_stands_out():
    lucky = [[0.01, 0.01], [0.10, 0.01]]
    assert luck_sentences(a_test(lucky, 0.01)) == luck_sentences(a_test(lucky, None)) == ""
    assert luck_sentences(a_test([[0.05, 0.05]])).endswith("not shown to be better than random, coarse.")
    assert "Without" not in luck_sentences(a_test([[0.10, 0.01]]))
