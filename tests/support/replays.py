"""The little bag of `tests/replay`, replayed through its nodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from nodes.bags.info import BagMessage
from nodes.replaying.lockstep import Summary
from nodes.replaying.nodes import Choice
from nodes.replaying.replay import Replay
from nodes.runtime.messages import encode, pose_message

START_NS = 1_800_000_000_000_000_000
MS = 1_000_000
GOLDEN_FOLDER = Path(__file__).parents[1] / "replay"
CORNER = GOLDEN_FOLDER / "corner.mcap"
GREEN = Choice(("compositor", "policy"), {"policy": "green_policy"})


def pose(ms: int, sequence: int = 0, x: float = 0.0) -> BagMessage:
    """A pose of the car, so long after the start of the bag."""
    T = np.eye(4)
    T[0, 3] = x
    ns = START_NS + ms * MS
    return BagMessage("/vicon/car", encode(pose_message(T, ns)), ns, ns - MS, sequence)


def run(choice: Choice = GREEN, bag: Path = CORNER) -> tuple[list[BagMessage], Summary]:
    """What the nodes publish, and the summary."""
    with Replay(bag, choice) as replay:
        made = list(replay)
        return made, replay.summary
