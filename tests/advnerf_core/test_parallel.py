import threading
from functools import partial

import pytest

from advnerf_core.parallel import Work, beside, run_slots, set_thread_count, slot_bounds, thread_count


@pytest.mark.parametrize(("count", "slots", "multiple"), [(10, 3, 1), (1000, 7, 256), (0, 4, 1), (5, 8, 1)])
def test_slots_cover_the_range_once(count: int, slots: int, multiple: int) -> None:
    bounds = slot_bounds(count, slots, multiple)
    assert len(bounds) == slots
    assert [i for start, stop in bounds for i in range(start, stop)] == list(range(count))
    assert all(start % multiple == 0 or start == count for start, _ in bounds)


@pytest.mark.parametrize("threads", [1, 3])
def test_every_slot_runs_once_on_any_number_of_threads(threads: int) -> None:
    lock, done = threading.Lock(), []

    def work(slot: int) -> None:
        with lock:
            done.append(slot)

    set_thread_count(threads)
    try:
        assert thread_count() == threads
        run_slots(work, 17)
    finally:
        set_thread_count(0)
    assert sorted(done) == list(range(17))


def test_errors_of_a_slot_reach_the_caller() -> None:
    def work(slot: int) -> None:
        raise KeyError(slot)

    with pytest.raises(KeyError):
        run_slots(work, 4)


@pytest.mark.parametrize("threads", [1, 3])
def test_works_beside_each_other_run_every_part_before_they_give_results(threads: int) -> None:
    lock = threading.Lock()
    done: dict[str, list[int]] = {"first": [], "second": []}

    def part(name: str, k: int) -> None:
        with lock:
            done[name].append(k)

    works = {
        name: Work([partial(part, name, k) for k in range(count)], lambda name=name: sorted(done[name]))
        for name, count in (("first", 7), ("second", 5))
    }
    set_thread_count(threads)
    try:
        assert beside(works["first"], works["second"]).run() == (list(range(7)), list(range(5)))
    finally:
        set_thread_count(0)
    assert Work([], lambda: 3).run() == 3
