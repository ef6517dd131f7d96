"""Who operates, and when the button counts as held."""

from hypothesis import given, settings
from hypothesis import strategies as st

from nodes.operator_page.config import PageConfig
from nodes.operator_page.desk import Desk

MS = 1_000_000
LIMITS = PageConfig(lease_s=10.0)


class Bench:
    """A desk with Ann at it, a clock, and a picture on her screen."""

    def __init__(self):
        self.desk, self.ns = Desk(LIMITS), 10**12
        assert self.desk.take(1, "Ann", self.ns) == ""

    def wait(self, ms):
        self.ns += ms * MS
        return self.desk.check(self.ns)

    def beat(self):
        return self.desk.beat(self.ns)

    def hold(self, beat, press=1, client=1, picture_ns=None):
        return self.desk.hold(client, beat, press, self.ns if picture_ns is None else picture_ns, self.ns)


def test_a_button_is_held_while_beats_are_answered():
    bench = Bench()
    for _ in range(40):
        assert bench.hold(bench.beat()) == ""
        assert bench.wait(50) == ""
        assert bench.desk.held
    assert bench.wait(190) == ""
    assert bench.wait(11) == "the page has not answered for 0.25 s"
    assert not bench.desk.held


def test_a_hold_that_ended_needs_a_new_press():
    bench = Bench()
    assert bench.hold(bench.beat()) == ""
    assert bench.wait(300) != ""
    assert bench.hold(bench.beat()) == "this press has ended; release the button and hold it again"
    assert not bench.desk.held
    assert bench.hold(bench.beat(), press=2) == ""
    assert bench.desk.release(1, 2)
    assert bench.hold(bench.beat(), press=2) != ""
    assert bench.hold(bench.beat(), press=1) != ""


def test_answers_that_waited_in_a_buffer_do_not_hold():
    bench = Bench()
    assert bench.hold(bench.beat()) == ""
    beats = []
    for _ in range(10):
        beats.append(bench.beat())
        bench.wait(50)
    assert not bench.desk.held
    # All answers arrive at once when the network is back, with those to a press of their own.
    assert all(bench.hold(beat, press=2) == "the answer of the page is too old" for beat in beats[:5])
    assert not bench.desk.held


def test_an_answer_counts_by_its_beat_and_not_by_its_arrival():
    bench = Bench()
    old = bench.beat()
    bench.wait(200)
    assert bench.hold(old) == ""
    assert bench.wait(40) == ""
    assert bench.wait(20) != ""


def test_a_screen_that_stands_still_lets_go():
    bench = Bench()
    assert bench.hold(bench.beat(), picture_ns=0) == "the page has shown no picture yet"
    seen_ns = bench.ns
    for _ in range(20):
        assert bench.hold(bench.beat(), press=2, picture_ns=seen_ns) == ""
        assert bench.wait(50) == ""
    assert bench.wait(100) == "the picture on the page is 1.1 s old"
    assert not bench.desk.held


def test_one_operator_at_a_time():
    bench = Bench()
    assert bench.desk.take(2, "Bob", bench.ns) == "Ann operates; one operator at a time"
    assert bench.hold(bench.beat(), client=2) == "Ann operates; one operator at a time"
    assert not bench.desk.leave(2)
    assert bench.hold(bench.beat()) == ""
    assert bench.desk.leave(1)
    assert not bench.desk.held
    assert bench.hold(bench.beat(), press=2) == "nobody operates; take control first"
    assert bench.desk.take(2, "Bob", bench.ns) == ""
    assert bench.hold(bench.beat(), client=2) == ""


def test_a_browser_that_lost_its_connection_takes_over_from_itself():
    bench = Bench()
    bench.desk.leave(1)
    assert bench.desk.take(1, "Ann", bench.ns, "session-a") == ""
    assert bench.hold(bench.beat()) == ""
    assert bench.desk.take(2, "Bob", bench.ns, "session-b") != ""
    assert bench.desk.take(3, "Ann", bench.ns, "session-a") == ""
    assert not bench.desk.held
    assert bench.hold(bench.beat(), press=2) == "Ann operates; one operator at a time"
    assert bench.hold(bench.beat(), client=3) == ""


def test_a_desk_that_nobody_uses_is_free_again():
    bench = Bench()
    for _ in range(300):
        assert bench.hold(bench.beat()) == ""
        bench.wait(50)
    assert bench.desk.lease is not None
    bench.desk.drop()
    bench.wait(10_001)
    assert bench.desk.lease is None


def test_the_e_stop_latches():
    bench = Bench()
    assert bench.hold(bench.beat()) == ""
    assert bench.desk.stop()
    assert bench.hold(bench.beat(), press=2) == "the emergency stop is latched; release it first"
    assert bench.desk.reset(2) == "Ann operates; one operator at a time"
    assert bench.desk.estop
    assert bench.desk.reset(1) == ""
    assert bench.hold(bench.beat(), press=2) == "this press has ended; release the button and hold it again"
    assert bench.hold(bench.beat(), press=3) == ""


@settings(max_examples=300)
@given(st.lists(st.tuples(st.sampled_from("bhwrsxl"), st.integers(0, 400)), max_size=60))
def test_nothing_holds_without_a_young_answer(steps):
    """Whatever the order of beats, late answers, waits, releases and stops: held means an answer to a beat of the last 0.25 s."""
    bench, beats, answered = Bench(), [], []
    for what, number in steps:
        if what == "b":
            beats.append((bench.beat(), bench.ns))
        elif what == "h" and beats:
            beat, sent_ns = beats[number % len(beats)]
            if bench.hold(beat, press=1 + number // 100) == "":
                answered.append(sent_ns)
        elif what == "w":
            bench.wait(number)
        elif what == "r":
            bench.desk.release(1, 1 + number // 100)
        elif what == "s":
            bench.desk.stop()
        elif what == "x":
            bench.desk.reset(1)
        elif what == "l":
            bench.desk.leave(1)
            bench.desk.take(1, "Ann", bench.ns)
        bench.desk.check(bench.ns)
        if bench.desk.held:
            assert not bench.desk.estop
            assert bench.ns - max(answered) <= 250 * MS
