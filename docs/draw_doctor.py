"""Draws what ``advnerf doctor`` prints for a car: ``python docs/draw_doctor.py`` writes ``docs/doctor.svg`` (half a minute).

A VESC with the time-out that it is delivered with and Tracker's stream of two subjects are emulated. Rows about
the computer itself are left out.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.terminal_theme import DIMMED_MONOKAI
from rich.text import Text
from typer.testing import CliRunner

from advnerf_core.files import write_atomically
from advnerf_core.geometry import make_transform
from hardware.emulators.vesc_emulator import VescEmulator
from hardware.emulators.vesc_firmware import VescEmulatorConfig
from hardware.emulators.vicon_emulator import ViconEmulator, ViconEmulatorConfig
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle
from nodes.cli.main import app
from nodes.lab.doctor import motor

ROOT = Path(__file__).resolve().parents[1]
_COLUMNS = 96
_ROWS = ("VESC", "VESC time-out", "battery", "VICON", "camera")


def output() -> list[str]:
    """The lines of the command about devices, with their colours."""
    subjects = {
        "car": make_transform(np.eye(3), [1.2, -0.4, 0.02]),
        "board": make_transform(np.eye(3), [3.1, -1.8, 0.5]),
    }
    vicon = ViconEmulator(ViconEmulatorConfig(port=51001), lambda mono_ns: subjects)
    try:
        with VescEmulator(VescEmulatorConfig(), TwinVehicle(CarConfig())) as vesc:
            motor.FIXED_NAME = Path(
                vesc.port
            )  # the number of a pseudo-terminal, where a car has its udev name
            done = CliRunner().invoke(app, ["doctor"], color=True)
            lines = done.output.replace(vesc.port, "/dev/vesc").splitlines()
    finally:
        vicon.close()
    return [line for line in lines if Text.from_ansi(line).plain[9:23].strip() in _ROWS]


def main() -> None:
    """Draw the picture."""
    console = Console(record=True, width=_COLUMNS, file=open(os.devnull, "w"))  # noqa: SIM115 - never written to
    console.print("[bold]$ advnerf doctor[/]")
    for line in output():
        print(line)
        console.print(Text.from_ansi(line))
    picture = console.export_svg(title="advnerf doctor", theme=DIMMED_MONOKAI, unique_id="doctor")
    picture = re.sub(r"\s*@font-face \{.*?\}", "", picture, flags=re.DOTALL)  # fonts from elsewhere
    write_atomically(ROOT / "docs" / "doctor.svg", picture)


if __name__ == "__main__":
    main()
