"""The twin node: the simulated lab as a process, whose VESC, VICON and camera use the real protocols.

The other nodes open a serial port, a UDP port and a frame socket, as in the real lab. The only topic of this node is ``/twin/reset``,
with which experiments move the car to a start pose. It is refused while the car moves or is commanded to.
"""

from __future__ import annotations

from typing import Any, TextIO

from advnerf_core.geometry import yaw_of
from hardware.emulators.live import LiveLab, LiveLabConfig
from hardware.errors import HardwareError
from nodes.control.stamps import REQUEST_AGE_S, stamp_age_s, stamp_problem
from nodes.runtime.errors import MessageError
from nodes.runtime.messages import pose_matrix, stamp_ns
from nodes.runtime.node import ACTIVE, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.paths import bus_folder
from nodes.runtime.process import run_node_main
from nodes.runtime.twin_port import claim_twins_port

RESET_TOPIC = "/twin/reset"


class TwinNode(Node):
    """Runs the simulated lab."""

    opens = "a simulated lab"
    subscriptions = (RESET_TOPIC,)
    tick_rate_hz = 10.0

    def __init__(self, lab: LiveLab, claim: TextIO) -> None:
        self._lab, self._claim = lab, claim
        self._text = ""
        self._resets = self._refused = 0

    @classmethod
    def build(cls, config: LiveLabConfig, context: NodeContext) -> TwinNode:
        """Build the lab. Returns when its devices are available."""
        # Before the serial port exists: a motor node may open it at once, and must see whose it is.
        claim = claim_twins_port(context.run_dir)
        return cls(LiveLab(config, context.run_dir, bus_folder(context.run_dir)), claim)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Move the car to the pose of a ``PoseStamped``, if it was asked for a moment ago."""
        try:
            if problem := stamp_problem(stamp_age_s(stamp_ns(message), now.real_ns), REQUEST_AGE_S):
                raise MessageError(problem)
            T = pose_matrix(message)
            self._lab.place(float(T[0, 3]), float(T[1, 3]), yaw_of(T))
            self._resets += 1
            self._text = ""
        except (HardwareError, MessageError, ValueError) as error:
            self._refused += 1
            self._text = f"reset refused: {error}"
        return []

    def tick(self, now: Now) -> list[Out]:
        """Raise an error if a part of the lab has failed."""
        self._lab.check()
        return []

    def status(self) -> tuple[str, str]:
        """Report the last refusal, if any."""
        return ACTIVE, self._text

    def counters(self) -> dict[str, float]:
        """Report missed ticks of the lab's threads, and resets."""
        missed = {f"missed {name}": float(count) for name, count in self._lab.missed.items()}
        return {**missed, "resets": self._resets, "resets_refused": self._refused}

    def close(self) -> None:
        """Stop the lab."""
        self._lab.close()
        self._claim.close()


if __name__ == "__main__":
    raise SystemExit(run_node_main(LiveLabConfig, TwinNode.build))
