import threading

import pytest

from advnerf_core.parallel import run_slots, set_thread_count, slot_bounds, thread_count


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
