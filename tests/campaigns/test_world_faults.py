"""Does a world in another process ever end as a result when it fails? 200 faults in full, about four minutes.

A real process serves a small simulator and misbehaves once at a random moment of a drive: it is killed, hangs, is late, sends garbage, another
version, or lies about the size of a picture, about depth, or about where it or the car is. What counts is that the drive ends with the
named error that fits, that the process is gone, and that the next drive is the same as before.
"""

from __future__ import annotations

import random
import tempfile
from collections import Counter
from pathlib import Path

import pytest

from hardware.worlds.remote_errors import ServerTimeout
from tests.campaigns.campaign import Campaign
from tests.support.remote.faults import FAULTS, drive, faulty_world, suffer

SEED = 20261123


def plan(count: int, seed: int = SEED) -> list[tuple[str, str, int]]:
    """Kinds in random order, each about equally often, with the call in which it happens and how many such calls go well before."""
    rng, kinds = random.Random(seed), list(FAULTS)
    order: list[str] = []
    while len(order) < count:
        order += rng.sample(kinds, len(kinds))
    return [(kind, rng.choice(FAULTS[kind][0]), rng.randrange(5)) for kind in order[:count]]


def wrong_ends(faults: list[tuple[str, str, int]]) -> Counter[str]:
    """How often each kind of fault ended as something else than its named error, left its process, or spoiled the next drive."""
    wrong: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="advnerf-faults-") as name:
        folder = Path(name)
        with faulty_world(folder) as world:
            whole = drive(world)
            for kind, call, after in faults:
                error, gone = suffer(world, folder, call, kind, after)
                if type(error) is not FAULTS[kind][1] or not gone or drive(world) != whole:
                    wrong[kind] += 1
                    print(
                        f"{kind} in {call}: {type(error).__name__}: {error}; process gone: {gone}", flush=True
                    )
    return wrong


@pytest.mark.campaign
def test_every_fault_ends_as_its_named_error(campaign: Campaign) -> None:
    count = campaign.size(12, 200)
    wrong = wrong_ends(plan(count))
    named = count - wrong.total()
    campaign.record(
        "faults of a foreign world's process that end as a named error",
        named,
        f"of {count}",
        f"{count}",
        not wrong,
        f"{len(FAULTS)} kinds at random moments of a drive; wrong: {dict(wrong) or 'none'}",
    )
    assert wrong == {}


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
    monkeypatch.setitem(FAULTS, "killed", (("step",), ServerTimeout))
    assert wrong_ends([("killed", "step", 0)]) == {"killed": 1}
