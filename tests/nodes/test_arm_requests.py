"""Requests to arm and to disarm: a repeat never arms, whatever happens in between."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodes.control.arming import Arming, ArmingLimits
from nodes.control.arming_requests import ArmRequests
from nodes.runtime.messages import header, types
from nodes.runtime.requests import Answer, AnswerMemory, asked_mono_ns
from nodes.runtime.wire import MessageInfo

pytestmark = pytest.mark.live

MS = 1_000_000
REAL_NS = 1_700_000_000_000_000_000
FENCE = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))


class Car:
    """A safety node's state machines that can be started again, and a car for which all is well or is not."""

    def __init__(self):
        self.ms = 50_000
        self.well = True
        self.restart()
        self.run(100)

    def restart(self):
        self.arming = Arming(ArmingLimits(nodes=("motor",), fence_m=FENCE))
        self.arming.peer = "TWIN firmware 5.02"
        self.requests = ArmRequests(self.arming)
        self.run(20)

    def run(self, duration_ms):
        for _ in range(duration_ms // 10):
            self.ms += 10
            now, info = self.ms * MS, MessageInfo(self.ms * MS, self.ms * MS, instance_id=1)
            self.arming.heard_motor(info)
            self.arming.heard_status("motor", "ready" if self.well else "fault", "", info)
            self.arming.heard_car(0.0, 0.0, info)
            self.arming.heard_drive(0.5, 0.0, REAL_NS + now, info, now, REAL_NS + now)
            self.arming.check(now)

    def ask(self, ask_id="a", asked_ms=None, arm=True):
        self.ms += 1
        asked_ns = (self.ms if asked_ms is None else asked_ms) * MS
        if arm:
            self.requests.arm(ask_id, "operator", asked_ns, self.ms * MS)
        else:
            self.requests.disarm(ask_id, "disarmed by operator: ", asked_ns, self.ms * MS)
        return self.requests.last


@pytest.fixture
def car():
    return Car()


def test_a_fault_between_two_repeats_of_an_arm_leaves_the_car_disarmed(car):
    asked_ms = car.ms + 1
    assert car.ask("a", asked_ms) == Answer("a", True, "armed")
    car.well = False
    car.run(10)
    car.well = True
    car.run(100)
    assert car.ask("a", asked_ms) == Answer("a", True, "armed")  # what was decided then
    assert not car.arming.armed
    assert car.arming.reason == "node motor is in state fault: "


def test_a_fault_between_a_lost_request_and_its_repeat_leaves_the_car_disarmed(car):
    asked_ms = car.ms + 1
    car.well = False
    car.run(20)
    car.well = True
    car.run(20)
    answer = car.ask("a", asked_ms)
    assert not car.arming.armed
    assert answer.text == "a fault occurred after the request: node motor is in state fault: ; arm again"
    assert car.ask("b").granted


def test_a_restart_between_two_repeats_leaves_the_car_disarmed(car):
    asked_ms = car.ms + 1
    assert car.ask("a", asked_ms).granted
    car.restart()
    answer = car.ask("a", asked_ms)
    assert (answer.granted, car.arming.armed) == (False, False)
    assert "older than the last stop (not armed since the start)" in answer.text
    assert car.ask("b").granted


def test_a_disarm_between_a_lost_request_and_its_repeat_leaves_the_car_disarmed(car):
    asked_ms = car.ms + 1
    assert car.ask("stop", arm=False).granted
    answer = car.ask("a", asked_ms)
    assert "older than the last stop (disarmed by operator: )" in answer.text
    assert not car.arming.armed


def test_an_id_is_decided_once_even_when_it_claims_to_be_asked_now(car):
    assert car.ask("a").granted
    car.ask("stop", arm=False)
    assert car.ask("a").granted  # the answer of then
    assert not car.arming.armed
    for no_id in ("", "x" * 65):
        assert (
            car.ask(no_id).text
            == f"expected an ask_id of 1 to 64 characters, got {len(no_id)}; use advnerf car arm"
        )
        assert not car.arming.armed
        assert car.ask(no_id, arm=False).granted


def test_an_old_request_is_void(car):
    answer = car.ask("a", car.ms - 1100)
    assert not answer.granted
    car.run(2000)
    assert car.ask("b", car.ms - 1100).text == "the request is 1.1 s old, the limit is 1 s; arm again"


def test_a_repeated_disarm_stops_a_car_that_was_armed_again(car):
    car.ask("stop", arm=False)
    assert car.ask("a").granted
    car.ask("stop", arm=False)
    assert not car.arming.armed
    reason = car.arming.reason
    car.ms += 10
    car.ask("stop", arm=False)
    assert car.arming.reason == reason


def test_a_forgotten_id_does_not_arm_again(car):
    asked_ms = car.ms + 1
    assert car.ask("a", asked_ms).granted
    car.ask("stop", arm=False)
    for number in range(300):
        car.ask(f"other {number}", asked_ms + 1)
    car.arming._disarmed_ns = 0  # what else would make it void
    answer = car.ask("a", asked_ms)
    assert "decided and forgotten" in answer.text
    assert not car.arming.armed


def test_clocks_of_two_hosts_make_a_request_older_never_younger(car):
    car.ask("stop", arm=False)
    car.run(100)
    info = MessageInfo(car.ms * MS, car.ms * MS, instance_id=1)
    car.arming.clocks.heard("workstation", -0.02, 0.01, info)
    # It seems to be asked 20 ms after the stop, by a clock that is known to 30 ms: it may have been asked before.
    car.ask("stop 2", arm=False)
    car.ms += 19
    assert "older than the last stop" in car.ask("a").text
    car.ms += 19
    assert car.ask("b").granted
    assert car.arming.clocks.doubt_ns(car.ms * MS) == 30 * MS
    for offset_s in (float("nan"), float("inf"), 1e9):
        car.arming.clocks.heard("workstation", offset_s, 0.01, info)
        assert car.arming.clocks.doubt_ns(car.ms * MS) == 3_600_000 * MS


@pytest.mark.parametrize("offset_s", [-300.0, -0.2, 300.0])
def test_a_wrong_clock_is_named_and_not_the_age_that_it_gives_to_a_request(car, offset_s):
    car.run(2000)
    info = MessageInfo(car.ms * MS, car.ms * MS, instance_id=1)
    car.arming.clocks.heard("workstation", offset_s, 0.001, info)
    for ask_id, asked_ms in (("now", None), ("old", car.ms - 1500), ("before the start", 1)):
        answer = car.ask(ask_id, asked_ms)
        expected = f"the clock of workstation is off by {1e3 * offset_s:.0f} ms, the limit is 30 ms"
        assert (answer.granted, expected in answer.text) == (False, True)
    assert not car.arming.armed
    car.arming.clocks.heard("workstation", 0.0, 0.001, info)
    assert "the request is 1.5 s old" in car.ask("old again", car.ms - 1500).text
    assert car.ask("right").granted


@pytest.mark.parametrize(
    ("published_ms", "stamp_ms", "age_ms", "asked_ms"),
    [
        (500, 400, 100, 400),
        (500, 480, 100, 400),
        (500, 300, 100, 300),
        (500, 9000, 100, 400),
        (500, 100, 0, 100),
    ],
)
def test_the_older_of_the_senders_clocks_counts(published_ms, stamp_ms, age_ms, asked_ms):
    message = types.Arm(
        header=header(REAL_NS + stamp_ms * MS), arm=True, source="", reason="", ask_id="a", age_ns=age_ms * MS
    )
    # Received later, behind a gateway: its publication is 500 ms by the real time of the sender, 7000 ms by our monotonic clock.
    info = MessageInfo(7000 * MS, 7100 * MS, publish_real_ns=REAL_NS + published_ms * MS)
    assert asked_mono_ns(message, info) == (7000 - (published_ms - asked_ms)) * MS


def test_answers_are_forgotten_oldest_first():
    answers = AnswerMemory(limit=2)
    assert [answers.give(Answer(ask_id, True)) for ask_id in "ab"] == [None, None]
    assert answers.give(Answer("c", True)) == Answer("a", True)
    assert [answers.repeat(ask_id) for ask_id in ("a", "b", "", "c")] == [False, True, False, True]
    assert answers.last == Answer("c", True)
    answers.give(Answer("", True))
    assert not answers.repeat("")


ACTS = st.one_of(
    st.tuples(st.just("arm"), st.integers(0, 1500)),
    st.tuples(st.just("repeat"), st.integers(0, 9)),
    st.tuples(st.sampled_from(["disarm", "fault", "restart"]), st.just(0)),
    st.tuples(st.just("wait"), st.integers(1, 60)),
)


@settings(max_examples=300)
@given(st.lists(ACTS, max_size=25))
def test_armed_only_by_a_young_request_that_nothing_came_after(acts):
    """Armed means: by a request first asked less than a second before, never decided before, after the last stop of any kind."""
    car = Car()
    asked, decided, stopped_ms = (
        [],
        set(),
        car.ms - 110,
    )  # (id, when it was first asked); the start of the node
    for what, number in acts:
        was_armed = car.arming.armed
        if what in ("arm", "repeat"):
            if what == "arm":
                # It may come late: its first repeats were lost.
                asked.append((f"{len(asked)}", car.ms + 1 - number))
            elif not asked:
                continue
            ask_id, asked_ms = asked[-1] if what == "arm" else asked[number % len(asked)]
            answer = car.ask(ask_id, asked_ms)
            may = ask_id not in decided and asked_ms > stopped_ms and car.ms - asked_ms <= 1000
            assert answer.ask_id == ask_id
            assert car.arming.armed == (was_armed or may), (what, number, answer)
            decided.add(ask_id)
        elif what == "wait":
            car.run(number * 10)
            assert car.arming.armed == was_armed
        else:
            if what == "disarm":
                car.ask(f"stop {car.ms}", arm=False)
            elif what == "fault":
                car.well = False
                car.run(10)
                car.well = True
                car.run(10)
            else:
                car.restart()
                decided.clear()  # it remembers nothing; the time of its start must be enough
            stopped_ms = car.ms if what == "disarm" else car.ms - 10
            assert not car.arming.armed
