"""The example's warehouse in a small size, for the tests of this folder."""

from pathlib import Path
from typing import Any

from nodes.lab.worlds.named import NamedWorld, find_world

EXAMPLES = Path(__file__).parents[2] / "examples"
Warehouse: Any = find_world("world_warehouse.py:Warehouse", EXAMPLES)


def small(world_class: Any = Warehouse) -> NamedWorld:
    """A world with small pictures, as it is named."""
    return NamedWorld("small", world_class, Warehouse.Config(width=112, height=63), "")
