"""Commands count only as answers to what was sent a moment ago, from the only publisher."""

import pytest

from nodes.linking.ros2.answers import AnsweredStamps, OneWriter, stamp_of_cdr
from nodes.runtime.errors import MessageError
from nodes.runtime.messages import drive_message, encode

S = 10**9


@pytest.fixture
def answers():
    found = AnsweredStamps(max_age_s=0.15)
    for k in range(5):
        found.sent(stamp_ns=100 + k, mono_ns=S + k * S // 10)
    return found


def test_an_answer_in_time_counts_once(answers):
    assert answers.refusal(104, S + 4 * S // 10 + S // 100) == ""
    assert "already answered" in answers.refusal(104, S + 4 * S // 10 + S // 100)


def test_an_older_image_does_not_count_after_a_newer_one(answers):
    at_ns = S + 4 * S // 10 + S // 100
    assert answers.refusal(104, at_ns) == ""
    assert "already answered" in answers.refusal(103, at_ns)


@pytest.mark.parametrize("stamp_ns", [0, -5, 99, 105, 2**62])
def test_a_stamp_that_was_never_sent_does_not_count(answers, stamp_ns):
    assert "is not that of a message sent" in answers.refusal(stamp_ns, S + 4 * S // 10)


def test_a_late_answer_does_not_count_and_does_not_block_later_ones(answers):
    assert "0.20 s old, the limit is 0.15 s" in answers.refusal(102, S + 4 * S // 10)
    assert answers.refusal(104, S + 4 * S // 10) == ""


def test_sending_again_does_not_make_a_message_younger(answers):
    answers.sent(100, 5 * S)
    assert "s old" in answers.refusal(100, 5 * S)


def test_memory_is_bounded(answers):
    for k in range(10_000):
        answers.sent(1000 + k, S)
    assert len(answers._sent_ns) <= 256


def test_of_two_publishers_none_counts():
    one = OneWriter()
    assert one.refusal("a") == "its publisher is not announced, or already gone"
    one.present = ("a",)
    assert one.refusal("a") == one.problem == ""
    assert one.refusal("b")
    one.present = ("a", "b")
    assert "2 publishers (a, b)" in one.refusal("a")
    assert one.refusal("b") == one.problem


def test_a_shared_topic_has_any_number_of_publishers():
    many = OneWriter(shared=True, present=("a", "b"))
    assert many.problem == many.refusal("a") == many.refusal("b") == ""


def test_the_stamp_is_read_without_decoding():
    cdr = encode(drive_message(0.5, 0.1, 1_795_000_000_123_456_789))
    assert stamp_of_cdr(cdr) == 1_795_000_000_123_456_789
    assert stamp_of_cdr(b"\x00\x00\x00\x00" + (5).to_bytes(4, "big") + (7).to_bytes(4, "big")) == 5 * S + 7
    for wrong in (b"", cdr[:11], b"\x00\x07" + cdr[2:], b"\x01\x01" + cdr[2:]):
        with pytest.raises(MessageError, match="begin with a header"):
            stamp_of_cdr(wrong)


def test_a_stamp_of_a_wrong_clock_does_not_lock_out_the_right_ones(answers):
    answers.sent(10**18, 2 * S)  # an image with a stamp far in the future
    assert answers.refusal(10**18, 2 * S) == ""
    answers.sent(200, 2 * S + S // 10)
    assert answers.refusal(200, 2 * S + S // 10) == ""
    assert "already answered" in answers.refusal(10**18, 2 * S + S // 10)
