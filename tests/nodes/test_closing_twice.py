"""What is closed twice closes nothing of others: a descriptor's number is given out again at once, to a socket of ZeroMQ for example."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hardware.emulators.vesc_emulator import VescEmulator
from hardware.emulators.vesc_firmware import VescEmulatorConfig
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle
from nodes.bags.journal import Journal
from nodes.bags.part import PartWriter
from nodes.bags.writer import BagWriter
from nodes.operator_page.diary import Diary
from nodes.operator_page.disk import DiskWriter
from nodes.runtime.clock import SystemClock
from nodes.runtime.descriptors import Reserve
from nodes.runtime.inbox import Inbox


def diary(folder: Path) -> Diary:
    disk = DiskWriter()
    made = Diary(folder / "acts.log", disk)
    made.note(SystemClock().now(), "a", "b", "c", "d", 0, "")
    disk.close()
    return made


MAKERS: dict[str, Callable[[Path], Any]] = {
    "journal": lambda folder: Journal(folder / "one.mcap", 0),
    "part": lambda folder: PartWriter(folder / "one.mcap", {}, {}),
    "bag": lambda folder: BagWriter(folder / "bag"),
    "diary": diary,
    "inbox": lambda _: Inbox(4),
    "reserve": lambda _: Reserve(),
    "vesc": lambda _: VescEmulator(VescEmulatorConfig(), TwinVehicle(CarConfig())),
}


@pytest.mark.parametrize("what", MAKERS)
def test_closing_twice_leaves_the_descriptors_of_others_open(what: str, tmp_path: Path) -> None:
    made = MAKERS[what](tmp_path)
    close = made.let_go if what == "part" else made.close
    close()
    # As many as were freed, and more: these have the numbers now.
    others = [os.open(os.devnull, os.O_RDONLY) for _ in range(64)]
    try:
        close()
        for descriptor in others:
            os.fstat(descriptor)
    finally:
        for descriptor in others:
            os.close(descriptor)
