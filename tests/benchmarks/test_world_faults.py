"""The campaign of faults of a foreign world's process, in its smallest size."""

from collections import Counter

import pytest

from benchmarks import world_faults
from benchmarks.world_faults import plan, wrong_ends
from hardware.worlds.remote_errors import ServerTimeout
from tests.support.remote.faults import FAULTS


def test_every_kind_comes_about_equally_often_in_a_call_where_it_may_happen() -> None:
    faults = plan(200)
    counts = Counter(kind for kind, _, _ in faults)
    assert set(counts) == set(FAULTS)
    assert max(counts.values()) - min(counts.values()) <= 1
    assert all(call in FAULTS[kind][0] for kind, call, _ in faults)


@pytest.mark.live
def test_faults_at_random_moments_end_as_their_named_errors() -> None:
    assert wrong_ends(plan(12, seed=5)) == {}


@pytest.mark.live
def test_a_fault_that_ends_as_another_error_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(world_faults.FAULTS, "killed", (("step",), ServerTimeout))
    assert wrong_ends([("killed", "step", 0)]) == {"killed": 1}
