"""Verifying finds planted changes of every kind, in a simulated set; by whom each can be seen is as it is said."""

import pytest

from advnerf_core.files import sha256_of
from advnerf_core.report.evidence.page import picture_of
from benchmarks.planted_changes import planted, simulated_world
from benchmarks.planting.detecting import find
from benchmarks.planting.kinds import KINDS


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    return simulated_world(tmp_path_factory.mktemp("simulated"), searches=2, starts=2)


@pytest.fixture(scope="module")
def picture(world):
    return sha256_of(world.published / picture_of(world.name))


def test_a_copy_that_nobody_changed_has_no_problem(world, picture):
    assert not find(world, picture)


@pytest.mark.parametrize("kind", KINDS)
def test_a_change_is_found_by_those_who_can_see_it(world, picture, kind):
    check(world, picture, kind, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(2, 6))
def test_more_changes_are_found_by_those_who_can_see_them(world, picture, kind, seed):
    check(world, picture, kind, seed)


def check(world, picture, kind, seed):
    world.rng.seed(f"{seed} {kind}")
    KINDS[kind].plant(world)
    found = find(world, picture)
    world.restore()
    if KINDS[kind].seen_by == "files":
        assert found.files
    elif KINDS[kind].seen_by == "history":
        assert found.history
    else:
        assert not found


def test_changes_are_counted_by_kind(world):
    counts = planted(world, range(3))
    assert dict(counts.planted) == dict.fromkeys(list(KINDS)[:3], 1)
    assert counts.missed.total() == 0


def test_a_world_is_as_it_was_after_a_change(world):
    KINDS["a past of its own"].plant(world)
    world.restore()
    assert world.git("status", "--porcelain") == ""
    assert world.git("rev-parse", "HEAD").strip() == world.base[0]
