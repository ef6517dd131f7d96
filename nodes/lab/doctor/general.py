"""The checks for the whole stack. Devices that only a car needs may be absent."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from hardware.mocap.vicon import ViconConfig
from nodes.lab.doctor import cameras, graphics, machine, mocap, motor, priority, ros2
from nodes.lab.doctor.check import CHILD_S, DoctorCheck
from nodes.lab.doctor.recording import ImageFormat, bytes_per_s

_CHILD_DEADLINE_S = CHILD_S + 5.0
# The recorded topics of launch/green_screen.launch.yaml.
_ROLES = ("camera", "vicon", "compositor", "policy", "safety", "motor")


def checks(folder: Path) -> list[DoctorCheck]:
    """Return all checks of a computer."""
    recorded = bytes_per_s(ImageFormat(), publishers=_ROLES)
    return [
        DoctorCheck("versions", machine.versions),
        DoctorCheck("machine", machine.machine),
        DoctorCheck("places", machine.places),
        DoctorCheck("priority", priority.shares, priority.DEADLINE_S),
        DoctorCheck("torch", graphics.torch, _CHILD_DEADLINE_S),
        DoctorCheck("EGL", graphics.egl, _CHILD_DEADLINE_S),
        DoctorCheck("LLVM", graphics.llvm, _CHILD_DEADLINE_S),
        DoctorCheck("disk", partial(machine.disk, folder, recorded)),
        DoctorCheck("sockets", machine.sockets),
        DoctorCheck("keys", machine.keys),
        DoctorCheck("clock", machine.clock),
        DoctorCheck("serial", motor.serial_ports),
        DoctorCheck("VESC", partial(motor.vesc, None)),
        DoctorCheck("VICON", partial(mocap.listen, ViconConfig((), ""))),
        DoctorCheck("camera", cameras.video_devices),
        DoctorCheck("OAK", cameras.oaks, 30.0),
        DoctorCheck("screens", graphics.screens, _CHILD_DEADLINE_S),
        DoctorCheck("ROS 2", ros2.installed),
        DoctorCheck("gamepad", partial(motor.gamepads, False)),
        DoctorCheck("launches", machine.launches),
    ]
