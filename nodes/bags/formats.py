"""Recognises the format of a bag by its first bytes."""

from __future__ import annotations

from enum import Enum
from pathlib import Path

from nodes.runtime.errors import BagError


class BagFormat(Enum):
    """Formats of bags that can be read."""

    MCAP = "MCAP"
    SQLITE = "rosbag2 in SQLite"
    ROS1 = "ROS 1 bag"


_MCAP, _SQLITE, _ROS1 = b"\x89MCAP", b"SQLite format 3\0", b"#ROSBAG V2.0\n"
_EXPECTED = "expected a bag: MCAP (.mcap), rosbag2 in SQLite (.db3), or ROS 1 (.bag)"
_CONVERT = "rosbags-convert --src {bag} --dst NEW_FOLDER --dst-storage mcap"
# First bytes of other file types, their description, and what to do.
_OTHERS = (
    (b"#ROSBAG V", "a ROS 1 bag of an old version", "migrate it on a machine with ROS 1: rosbag fix {bag} NEW.bag"),
    (b"\x28\xb5\x2f\xfd", "a file compressed with zstd", "unpack it: zstd -d {bag}; a whole rosbag2 folder: " + _CONVERT.replace("{bag}", "{folder}")),
    (b"\x1f\x8b", "a file compressed with gzip", "unpack it: gunzip {bag}"),
    (b"BZh", "a file compressed with bzip2", "unpack it: bunzip2 {bag}"),
    (b"\xfd7zXZ\0", "a file compressed with xz", "unpack it: unxz {bag}"),
    (b"\x04\x22\x4d\x18", "a file compressed with LZ4", "unpack it: lz4 -d {bag}"),
    (b"PK\x03\x04", "a ZIP archive", "unpack it and give the bag in it"),
    (b"\x89PNG", "a PNG picture", ""),
    (b"\xff\xd8\xff", "a JPEG picture", ""),
)  # fmt: skip


def recognise(path: Path) -> BagFormat:
    """Recognise the format of a file.

    Raises:
        BagError: The file is not a bag. The message says what it is and what to do.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(512)
    except OSError as error:
        raise BagError(f"cannot read {path}: {error.strerror}") from error
    for magic, found in ((_MCAP, BagFormat.MCAP), (_SQLITE, BagFormat.SQLITE), (_ROS1, BagFormat.ROS1)):
        if head.startswith(magic):
            return found
    # A recorder that is killed right after its start leaves fewer bytes than the format's signature.
    if head and _MCAP.startswith(head):
        return BagFormat.MCAP
    kind, advice = _kind(head)
    advice = advice.format(bag=path, folder=path.parent)
    raise BagError(f"{path} is {kind}; {_EXPECTED}" + (f". To read it, {advice}" if advice else ""))


def no_checksums(form: BagFormat) -> str:
    """Explain why damage to a file of a format cannot be noticed."""
    return f"{form.value} has no checksums"


def mend_advice(path: Path, form: BagFormat) -> str:
    """Say what rebuilds a damaged bag of another format: the tools of its own software."""
    if form is BagFormat.ROS1:
        return f"if its recording was cut short, rebuild its index: rosbag reindex {path}"
    return f"save what is left: sqlite3 {path} .recover | sqlite3 {path.with_suffix('.saved.db3')}, then: ros2 bag reindex {path.parent}"


def require_mcap(path: Path, verb: str) -> None:
    """Refuse a bag of another format, for operations that only work with MCAP.

    Args:
        verb: Participle of the operation for the message, for example ``repaired``.
    """
    if (found := recognise(path)) is not BagFormat.MCAP:
        raise BagError(
            f"{path} is {found.value}; only MCAP bags can be {verb}. Convert it first: {_CONVERT.format(bag=path)}"
            + (f", or: ros2 bag convert -i {path} -o OPTIONS.yaml" if found is BagFormat.SQLITE else "")
        )


def _kind(head: bytes) -> tuple[str, str]:
    if not head:
        return "empty (0 bytes)", ""
    for magic, kind, advice in _OTHERS:
        if head.startswith(magic):
            return kind, advice
    if not any(head):
        return "full of zeros: its disk was full or lost power before anything was written", ""
    return (
        "a text file" if _is_text(head) else f"a file of unknown format (it begins with {head[:8].hex(' ')})"
    ), ""


def _is_text(head: bytes) -> bool:
    text = head.decode("utf-8", "replace")
    # The last character may be cut.
    return text.count("\ufffd") <= 1 and all(letter.isprintable() or letter in "\t\r\n\f" for letter in text)
