from pathlib import Path

from nodes.bags.reader import read_messages
from nodes.bags.writer import BagWriter

NS = 1_000_000_000
YEAR_NS = 31_557_600 * NS
CORNER = Path(__file__).parents[2] / "replay" / "corner.mcap"
CASES = Path(__file__).parents[4] / "shared/data/cases/replay_clock_jump"


def shifted(folder, shift_ns):
    """The corner's bag with the log time of each message moved by ``shift_ns(number)``."""
    with BagWriter(folder, {}, {}) as writer:
        for number, message in enumerate(read_messages(CORNER), start=1):
            log_ns = shift_ns(number, message.log_ns)
            writer.write(message.topic, message.cdr, log_ns, message.publish_ns, message.sequence)
        writer.close()
    return folder
