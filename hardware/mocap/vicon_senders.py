"""Detects measurements of a subject that cannot come from one continuously running motion-capture system.

Tracker's object stream names no system. Two computers that send the same subject, or two streams behind one address, make the
subject jump between two places. The receiver cannot know which of them is right, so it trusts neither while it hears both.
"""

from __future__ import annotations

from dataclasses import dataclass, field

Address = tuple[str, int]

# Two senders within this time are two senders; a Tracker that is started again, with a new port, takes longer. A fault lasts as
# long after it was last seen [ns].
_HOLD_NS = 1_000_000_000
# Number of frames whose measurements are kept, which is the largest delay of a datagram.
_REMEMBERED_FRAMES = 64
_MOST_SENDERS = 8


@dataclass
class _Subject:
    senders: dict[Address, int] = field(default_factory=dict)  # last heard [monotonic ns]
    sender: Address | None = None
    frames: dict[int, bytes] = field(default_factory=dict)


class SenderWatch:
    """Remembers the senders of each subject. Pure: time comes as an argument.

    Args:
        subjects: Names to watch.
    """

    def __init__(self, subjects: tuple[str, ...]) -> None:
        self._subjects = {name: _Subject() for name in subjects}
        # Replaced and never changed: another thread reads it.
        self._faults: dict[str, tuple[str, int]] = {}

    def measured(self, name: str, sender: Address, frame_number: int, numbers: bytes, mono_ns: int) -> None:
        """Note a measurement of a subject, new or late, with its raw ``numbers``."""
        subject = self._subjects.get(name)
        if subject is None:
            return
        if sender != subject.sender:
            subject.sender = sender
            subject.frames.clear()
        subject.senders[sender] = mono_ns
        self._look_for_others(name, subject, mono_ns)
        known = subject.frames.setdefault(frame_number, numbers)
        if known != numbers:
            self._blame(
                name,
                f"two different measurements of subject {name} in frame {frame_number} of {_text(sender)}: do two streams"
                " come by this address?",
                mono_ns,
            )
        while len(subject.frames) > _REMEMBERED_FRAMES:
            del subject.frames[next(iter(subject.frames))]

    def leapt(self, sender: Address, last: int, frame_number: int, silence_s: float, mono_ns: int) -> None:
        """Whether the frame numbers of a sender restart; after a silence that is a restarted Tracker."""
        for name, subject in self._subjects.items():
            if subject.sender != sender:
                continue
            subject.frames.clear()
            if silence_s < _HOLD_NS / 1e9:
                self._blame(
                    name,
                    f"the frame numbers of {_text(sender)}, which sends subject {name}, went from {last} to {frame_number}"
                    f" within {silence_s:.2f} s",
                    mono_ns,
                )

    def fault(self, name: str, mono_ns: int) -> str:
        """Return why a subject is unreliable; empty if it is reliable."""
        text, since_ns = self._faults.get(name, ("", 0))
        return text if text and mono_ns - since_ns < _HOLD_NS else ""

    def faults(self, mono_ns: int) -> str:
        """Return all faults in one line; empty if there are none. Any thread."""
        texts = [text for text, since_ns in self._faults.values() if mono_ns - since_ns < _HOLD_NS]
        return "; ".join(texts)

    def _look_for_others(self, name: str, subject: _Subject, mono_ns: int) -> None:
        silent = [s for s, heard_ns in subject.senders.items() if mono_ns - heard_ns >= _HOLD_NS]
        for sender in silent:
            del subject.senders[sender]
        while len(subject.senders) > _MOST_SENDERS:
            del subject.senders[next(iter(subject.senders))]
        if len(subject.senders) > 1:
            count = {2: "two"}.get(len(subject.senders), str(len(subject.senders)))
            self._blame(
                name,
                f"{count} senders of subject {name}: {' and '.join(map(_text, subject.senders))}",
                mono_ns,
            )

    def _blame(self, name: str, text: str, mono_ns: int) -> None:
        self._faults = {**self._faults, name: (text, mono_ns)}


def _text(sender: Address) -> str:
    return f"{sender[0]}:{sender[1]}"
