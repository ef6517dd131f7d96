import re
from pathlib import Path

import pytest

from advnerf_core.driving.metrics import Horizon
from nodes.bags.play import Playhead
from nodes.bags.reader import read_attachments, read_messages
from nodes.bags.stamps import read_delays
from nodes.bags.time_gaps import LONGEST_SILENCE_S, TimeGap, find_gaps, read_gaps, read_steps_back, silence_s
from nodes.bags.writer import BagWriter
from nodes.lab.trials.evaluation import trajectory
from nodes.player import PlayerConfig, PlayerNode
from nodes.replaying.nodes import Choice
from nodes.replaying.replay import Replay
from nodes.runtime.clock import ManualClock
from nodes.runtime.errors import BagError, NodeFinished
from tests.support.commands import advnerf

NS = 1_000_000_000
YEAR_NS = 31_557_600 * NS
CORNER = Path(__file__).parents[2] / "replay" / "corner.mcap"
JUMPS = {
    "five messages at 0": lambda number, log_ns: 0 if number <= 5 else log_ns,
    "a year late": lambda number, log_ns: log_ns + YEAR_NS * (number > 131),
    "two jumps": lambda number, log_ns: log_ns + 2 * 3600 * NS * (number > 40) + YEAR_NS * (number > 90),
    "none": lambda number, log_ns: log_ns + int(0.9 * LONGEST_SILENCE_S * NS) * (number > 60),
}
TEXTS = {
    "five messages at 0": ["log time jumps by 57 years after message 5"],
    "a year late": ["log time jumps by 1 year after message 131"],
    "two jumps": ["log time jumps by 2 hours after message 40", "log time jumps by 1 year after message 90"],
    "none": [],
}
CASES = Path(__file__).parents[4] / "shared/data/cases/replay_clock_jump"


def shifted(folder, shift_ns):
    """The corner's bag with the log time of each message moved by ``shift_ns(number)``."""
    with BagWriter(folder, read_attachments(CORNER)) as writer:
        for number, message in enumerate(read_messages(CORNER), start=1):
            log_ns = shift_ns(number, message.log_ns)
            writer.write(message.topic, message.cdr, log_ns, message.publish_ns, message.sequence)
        writer.close()
    return folder


def digest_and_length(bag):
    with Replay(bag, Choice(("compositor",), {})) as replay:
        images = [made.cdr for made in replay if made.topic == "/compositor/image"]
    return images, replay.summary.duration_s


@pytest.mark.parametrize("name", JUMPS)
def test_gaps_are_found_and_a_replay_skips_them(tmp_path, name, capfd):
    bag = shifted(tmp_path / "bag", JUMPS[name])
    gaps = read_gaps(bag)
    assert [str(gap) for gap in gaps] == TEXTS[name]
    images, _ = digest_and_length(CORNER)
    assert len(images) == 12
    if name != "none":
        found, duration_s = digest_and_length(bag)
        assert (found, duration_s < 2.0) == (images, True)
        assert [text in capfd.readouterr().err for text in TEXTS[name][:1]] == [True]


@pytest.mark.parametrize(
    ("file", "text"), [("zero5", "57 years after message 5"), ("future", "days after message 131")]
)
def test_the_recordings_of_others_are_replayed(file, text):
    bag = CASES / f"{file}.mcap"
    if not bag.exists():
        pytest.skip("needs the shared cases")
    assert text in str(read_gaps(bag)[0])
    assert digest_and_length(bag)[0] == digest_and_length(CORNER)[0]


def test_a_gap_is_longer_than_the_limit():
    limit_ns = int(LONGEST_SILENCE_S * NS)
    assert find_gaps([5, 5 + limit_ns, 6 + 2 * limit_ns]) == (TimeGap(5 + limit_ns, 6 + 2 * limit_ns, 2),)
    assert find_gaps([]) == find_gaps([3]) == ()
    assert silence_s([TimeGap(0, 5 * NS, 1), TimeGap(7 * NS, 9 * NS, 2)]) == 7.0


def test_a_playhead_leaves_a_gap_at_once_unless_it_is_paused():
    gaps = [TimeGap(10 * NS, 5000 * NS, 3)]
    head = Playhead(9 * NS, 0)
    head.skip(gaps, NS)
    assert head.time_ns(NS) == 10 * NS  # the message before the gap is due, and not yet played
    head.skip(gaps, NS + 1)
    assert head.time_ns(NS + 1) == 5000 * NS
    head.jump(20 * NS, 0)
    head.pause(True, 0)
    head.skip(gaps, NS)
    assert head.time_ns(NS) == 20 * NS


def played_to_the_end(node, clock):
    played = 0
    for _ in range(1000):  # of 10 ms: 10 s
        try:
            played += len(node.tick(clock.now()))
        except NodeFinished:
            return played
        clock.advance(0.01)
    raise AssertionError("the player is not done")


@pytest.mark.parametrize("name", ["five messages at 0", "a year late", "two jumps"])
def test_a_player_plays_all_messages_without_the_gaps(tmp_path, name):
    bag = shifted(tmp_path / "bag", JUMPS[name])
    clock = ManualClock()
    node = PlayerNode(PlayerConfig(bag=bag, wait_for=[]), lambda topic: 0)
    whole = PlayerNode(PlayerConfig(bag=CORNER, wait_for=[]), lambda topic: 0)
    counts = []
    for each in (node, whole):
        counts.append(played_to_the_end(each, clock))
    assert counts[0] == counts[1] > 100


def test_info_names_the_gap(tmp_path, monkeypatch, capsys):
    bag = shifted(tmp_path / "bag", JUMPS["five messages at 0"])
    assert not advnerf(monkeypatch, "bag", "info", str(bag))
    shown = capsys.readouterr().out
    assert "log time jumps by 57 years after message 5" in shown
    assert "132 messages in 1." in shown


@pytest.mark.parametrize("back_s", [3, 300, 1000])
def test_a_clock_that_was_set_back_is_named(tmp_path, monkeypatch, capfd, back_s):
    bag = shifted(tmp_path / "bag", lambda number, log_ns: log_ns - back_s * NS * (number > 70))
    (step,) = read_steps_back(bag)
    assert re.fullmatch(rf"log time goes back by {back_s} s after message 7\d as recorded", step)
    assert read_steps_back(CORNER) == ()
    assert not advnerf(monkeypatch, "bag", "info", str(bag))
    assert f"{step}: the recorder's clock was set back" in capfd.readouterr().out
    digest_and_length(bag)
    assert f"{bag}: {step}; the recorder's clock was set back" in capfd.readouterr().err


def test_a_recorder_whose_clock_was_set_back_is_told_as_its_messages_are_mixed(tmp_path):
    """As a time server does: what was driven before and after lies in the same half second of the bag."""
    there = [message for message in read_messages(CORNER) if message.topic == "/vicon/car"]
    middle = there[len(there) // 2].log_ns
    bag = shifted(tmp_path / "bag", lambda number, log_ns: log_ns - NS // 2 * (log_ns > middle))
    with pytest.raises(
        BagError, match=r"of /vicon/car in .* in the order of their publication, got \d+ that go back"
    ):
        trajectory(bag, middle, Horizon(3, 0.1))
    assert read_delays(CORNER)["/vicon/car"].backwards == 0
    assert read_delays(bag)["/vicon/car"].backwards > 1


def test_a_publisher_that_was_restarted_twice_is_told_and_read(tmp_path, capfd):
    """Its numbers begin again, as those of a recorder whose clock was set back do; its log times do not."""
    numbers = iter([*range(5), *range(3), *range(1000)])
    with BagWriter(tmp_path / "bag", read_attachments(CORNER)) as writer:
        for message in read_messages(CORNER):
            sequence = next(numbers) if message.topic == "/vicon/car" else message.sequence
            writer.write(message.topic, message.cdr, message.log_ns, message.publish_ns, sequence)
    start_ns = next(message.log_ns for message in read_messages(CORNER, ["/vicon/car"])) + NS // 10
    expected, found = (trajectory(bag, start_ns, Horizon(3, 0.1)) for bag in (CORNER, tmp_path / "bag"))
    assert (found == expected).all()
    assert "the publisher of /vicon/car was restarted 2 times" in capfd.readouterr().err
