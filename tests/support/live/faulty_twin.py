"""The simulated lab with its faults on a string: one command per line on standard input. For the fault campaign.

``camera silent|repeated|heal``, ``vicon missing|zeros|nan|frozen|jump|two_senders|heal``, ``wire garbage|bad_crc|silent|heal``,
``usb unplug|heal``, ``car jammed|spinning|heal``. Each line is answered by ``ok``, so that whoever asked knows when it happened.
"""

from __future__ import annotations

import sys
import threading

import numpy as np

from advnerf_core.geometry import Array, make_transform
from hardware.emulators.live import LiveLabConfig
from hardware.emulators.vicon_emulator import ViconEmulator
from nodes.runtime.node import NodeContext
from nodes.runtime.paths import bus_folder
from nodes.runtime.process import run_node_main
from nodes.runtime.twin_port import claim_twins_port
from nodes.twin import TwinNode
from tests.support.faulty_devices import FaultyLab

# To the side, and inside the fence of the track's straights: the pose check must stop the car, not the fence.
_ELSEWHERE = make_transform(np.eye(3), [0.0, 0.1, 0.0])
_JAMS = {"jammed": "locked", "spinning": "spinning"}


class LabOnAString:
    """Obeys the commands.

    Args:
        lab: The lab.
    """

    def __init__(self, lab: FaultyLab) -> None:
        self._lab = lab
        self._second: ViconEmulator | None = None

    def obey(self, line: str) -> None:
        """Let a fault happen, or heal it."""
        part, what = line.split()
        fault, lab = None if what == "heal" else what, self._lab
        if part == "camera":
            lab.freeze_camera(fault)
        elif part == "vicon":
            self._disturb_vicon(fault)
        elif part == "wire":
            lab.vesc.disturb(fault)
        elif part == "usb":
            lab.vesc.hang_up() if fault else lab.vesc.plug_in()
        elif part == "car":
            lab.vesc.jam(_JAMS[fault] if fault else None)
        else:
            raise ValueError(f"expected camera, vicon, wire, usb or car, got {part!r}")

    def _disturb_vicon(self, fault: str | None) -> None:
        vicon = self._lab.vicon
        if fault == "two_senders":
            self._second = ViconEmulator(
                self._lab.config.vicon.model_copy(update={"seed": 1}), self._poses_elsewhere
            )
            return
        if self._second is not None:
            self._second.close()
            self._second = None
        vicon.displace("car", _ELSEWHERE if fault == "jump" else None)
        vicon.occlude("car", None if fault == "jump" else fault)

    def _poses_elsewhere(self, mono_ns: int) -> dict[str, Array]:
        del mono_ns
        return {"car": _ELSEWHERE @ np.asarray(self._lab.state.T_world_from_car)}


def _listen(lab: LabOnAString) -> None:
    for line in sys.stdin:
        lab.obey(line)
        print("ok", flush=True)


def build(config: LiveLabConfig, context: NodeContext) -> TwinNode:
    """The twin node, with a thread that obeys standard input."""
    claim = claim_twins_port(context.run_dir)
    lab = FaultyLab(config, context.run_dir, bus_folder(context.run_dir))
    threading.Thread(target=_listen, args=(LabOnAString(lab),), daemon=True).start()
    return TwinNode(lab, claim)


if __name__ == "__main__":
    raise SystemExit(run_node_main(LiveLabConfig, build))
