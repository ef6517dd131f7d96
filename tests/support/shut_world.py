"""The lab as a world that must be open to be described, as simulators of other people are."""

from __future__ import annotations

import os
from pathlib import Path

from hardware.worlds.lab.lab import Lab
from hardware.worlds.world import NotOpenError, WorldDescription

# Name of the environment variable with a file that gets a line for each opening.
LOG = "SHUT_WORLD_LOG"


class Shut(Lab):
    """Knows its paths and its camera only while it is open."""

    is_open = False

    def __enter__(self) -> Shut:
        super().__enter__()
        if LOG in os.environ:
            with Path(os.environ[LOG]).open("a") as file:
                file.write("opened\n")
        self.is_open = True
        return self

    def describe(self) -> WorldDescription:
        if not self.is_open:
            raise NotOpenError("only its simulator knows the road")
        return super().describe()


NAME = f"{__file__}:{Shut.__name__}"
