"""The simulated lab with its faults on a string: one command per line on standard input. For the fault campaign.

``camera silent|repeated|heal``, ``vicon missing|zeros|nan|frozen|heal``, ``wire garbage|bad_crc|silent|heal``, ``usb unplug|heal``.
Each line is answered by ``ok``, so that whoever asked knows when it happened.
"""

from __future__ import annotations

import sys
import threading

from hardware.twin.live import LiveLab
from nodes.runtime.node import NodeContext, run_node_main
from nodes.runtime.paths import bus_folder
from nodes.twin import TwinConfig, TwinNode


def _obey(lab: LiveLab, line: str) -> None:
    part, what = line.split()
    fault = None if what == "heal" else what
    if part == "camera":
        lab.freeze_camera(fault)
    elif part == "vicon":
        lab.vicon.occlude("car", fault)
    elif part == "wire":
        lab.vesc.disturb(fault)
    elif part == "usb":
        lab.vesc.hang_up() if fault else lab.vesc.plug_in()
    else:
        raise ValueError(f"expected camera, vicon, wire or usb, got {part!r}")


def _listen(lab: LiveLab) -> None:
    for line in sys.stdin:
        _obey(lab, line)
        print("ok", flush=True)


def build(config: TwinConfig, context: NodeContext) -> TwinNode:
    """The twin node, with a thread that obeys standard input."""
    lab = LiveLab(config, context.run_dir, bus_folder(context.run_dir))
    threading.Thread(target=_listen, args=(lab,), daemon=True).start()
    return TwinNode(lab)


if __name__ == "__main__":
    raise SystemExit(run_node_main(TwinConfig, build))
