"""A policy that drives straight on until a file ``mad`` in its run folder says how to go wrong. For the fault campaign.

``flood``: it repeats its last command as fast as it can, without looking at anything; ``nan``: its commands are not numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from nodes.runtime.messages import drive_message, ns_from_stamp
from nodes.runtime.node import MessageInfo, NodeContext, Now, Out
from nodes.runtime.process import run_node_main
from tests.support.live.straight_policy import StraightConfig, StraightPolicy


class MadPolicy(StraightPolicy):
    """Goes wrong on request."""

    def __init__(self, config: StraightConfig, flag: Path) -> None:
        super().__init__(config)
        self._flag = flag

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Drive on, or go mad."""
        outs = super().handle(topic, message, info, now)
        madness = self._flag.read_text() if self._flag.exists() else ""
        if madness == "nan":
            return [Out("/policy/drive", drive_message(math.nan, 0.0, ns_from_stamp(message.header.stamp)))]
        return self._flood(outs) if madness == "flood" else outs  # type: ignore[return-value]

    def _flood(self, outs: list[Out]) -> Iterator[Out]:
        # The loop publishes whatever it is given, one after the other: it stays in here until the flag is gone.
        while self._flag.exists():
            yield from outs * 100


def build(config: StraightConfig, context: NodeContext) -> MadPolicy:
    """Make the node of a process."""
    return MadPolicy(config, context.run_dir / "mad")


if __name__ == "__main__":
    raise SystemExit(run_node_main(StraightConfig, build))
