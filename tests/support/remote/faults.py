"""Every fault that the misbehaving server knows: the calls in which it may happen, and the error that must come of it."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path

import numpy as np

from hardware.worlds.remote_errors import (
    RemoteWorldError,
    ServerLost,
    ServerProtocolError,
    ServerTimeout,
    ServerVersionError,
    SimulatorError,
    WrongDepthError,
    WrongPictureError,
    WrongPoseError,
)
from hardware.worlds.remote_world import ServerDeadlines
from tests.support.remote.flat_world import FlatConfig, FlatWorld, plan_fault

_ANY = ("reset", "step", "render")
_STATES = ("reset", "step")
_RENDER = ("render",)
FAULTS: dict[str, tuple[tuple[str, ...], type[RemoteWorldError]]] = {
    **dict.fromkeys(("exit", "killed", "crash"), (_ANY, ServerLost)),
    **dict.fromkeys(("stopped", "hang", "late", "too large"), (_ANY, ServerTimeout)),
    "raises": (_ANY, SimulatorError),
    **dict.fromkeys(("other version", "no version"), (_ANY, ServerVersionError)),
    **dict.fromkeys(("old answer", "no sequence", "no result"), (_ANY, ServerProtocolError)),
    **dict.fromkeys(("garbage", "garbage frames", "empty", "a list", "cut"), (_ANY, ServerProtocolError)),
    **dict.fromkeys(("missing frame", "extra frame", "huge shape", "objects"), (_ANY, ServerProtocolError)),
    **dict.fromkeys(("small picture", "wide picture", "four channels"), (_RENDER, WrongPictureError)),
    **dict.fromkeys(("float picture", "black picture", "no picture"), (_RENDER, WrongPictureError)),
    **dict.fromkeys(("no depth", "small depth", "double depth"), (_RENDER, WrongDepthError)),
    **dict.fromkeys(("millimetres", "feet", "tenths", "negative depth"), (_RENDER, WrongDepthError)),
    **dict.fromkeys(("NaN depth", "zero depth", "all infinite"), (_RENDER, WrongDepthError)),
    **dict.fromkeys(("from elsewhere", "turned over", "no pose"), (_RENDER, WrongPoseError)),
    **dict.fromkeys(("jumps", "spins"), (("step",), WrongPoseError)),
    **dict.fromkeys(("NaN state", "text state", "short state", "no blocked"), (_STATES, WrongPoseError)),
    **dict.fromkeys(("not put down", "rolls"), (("reset",), WrongPoseError)),
}
TICKS = 6


def faulty_world(folder: Path, call_s: float = 0.8) -> FlatWorld:
    """A small world whose server misbehaves as `plan_fault` says."""
    deadlines = ServerDeadlines(open_s=30.0, call_s=call_s)
    return FlatWorld(FlatConfig(width=84, height=47, server=deadlines, faulty=folder))


def drive(world: FlatWorld) -> list[tuple[float, float]]:
    """A short drive that looks with depth at every tick; where the car was."""
    world.reset(6.0, 0.0, np.pi / 2.0)
    places = []
    for _ in range(TICKS):
        world.observe()
        state = world.step(0.08, 1.2, 0.1)
        places.append((state.x_m, state.y_m))
    return places


def suffer(
    world: FlatWorld, folder: Path, call: str, kind: str, after: int
) -> tuple[RemoteWorldError | None, bool]:
    """Have a fault happen in a drive; what was raised, and whether the process has ended."""
    world.reset(6.0, 0.0, 0.0)  # starts a process where the last one was lost
    assert world.server is not None
    pid = world.server.process.pid
    plan_fault(folder, call, kind, 0 if call == "reset" else after)
    try:
        drive(world)
    except RemoteWorldError as error:
        return error, ended(pid)
    return None, ended(pid)


def ended(pid: int, orphan: bool = False, within_s: float = 60.0) -> bool:
    """Whether a process is gone, and somebody has waited for it; nobody waits for an orphan where process 1 does not."""
    until = time.monotonic() + within_s
    while time.monotonic() < until:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        with suppress(OSError):
            if "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text():
                return orphan
        time.sleep(0.02)
    return False
