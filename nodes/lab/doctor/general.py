"""The checks for the whole stack. Devices that only a car needs may be absent."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from hardware.mocap.vicon import ViconConfig
from nodes.lab.doctor import cameras, graphics, machine, mocap, motor, priority
from nodes.lab.doctor.check import CHILD_S, Check
from nodes.lab.doctor.recording import Pictures, bytes_per_s

_CHILD_DEADLINE_S = CHILD_S + 5.0
# The recorded topics of launch/green_screen.launch.yaml.
_ROLES = ("camera", "vicon", "compositor", "policy", "safety", "motor")


def checks(folder: Path, vicon_port: int, vesc_port: str | None = None) -> list[Check]:
    """Return all checks of a computer.

    Args:
        folder: Folder for results.
        vicon_port: UDP port of the motion-capture stream.
        vesc_port: Serial device of the VESC; None detects it.
    """
    vesc = partial(motor.vesc, vesc_port, required=vesc_port is not None)
    recorded = bytes_per_s(Pictures(), publishers=_ROLES)
    return [
        Check("versions", machine.versions),
        Check("machine", machine.machine),
        Check("places", machine.places),
        Check("priority", priority.shares, priority.DEADLINE_S),
        Check("torch", graphics.torch, _CHILD_DEADLINE_S),
        Check("EGL", graphics.egl, _CHILD_DEADLINE_S),
        Check("LLVM", graphics.llvm, _CHILD_DEADLINE_S),
        Check("disk", partial(machine.disk, folder, recorded)),
        Check("sockets", machine.sockets),
        Check("keys", machine.keys),
        Check("clock", machine.clock),
        Check("serial", motor.serial_ports),
        Check("VESC", vesc),
        Check("VICON", partial(mocap.listen, ViconConfig((), "", vicon_port))),
        Check("camera", cameras.video_devices),
        Check("OAK", cameras.oaks, 30.0),
        Check("screens", graphics.screens, _CHILD_DEADLINE_S),
        Check("gamepad", partial(motor.gamepads, False)),
        Check("launches", machine.launches),
    ]
