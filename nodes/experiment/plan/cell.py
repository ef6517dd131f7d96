"""One point of the grid that experiments are made of: which path, which victim meets what, which seed, where the objects stand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from advnerf_core.plugins import name_in_results
from advnerf_core.report.cells import cell_name
from advnerf_core.report.conditions import CONTROLS, NONE
from nodes.runtime.errors import ConfigError

# What --only may name.
KEYS = ("scenario", "placement", "victim", "method", "seed")


@dataclass(frozen=True)
class Cell:
    """One cell.

    Attributes:
        scenario: Name of the path, or in a campaign of the scenario.
        victim: Which policy.
        method: Name of the method that found what it meets; ``none``: no attack, ``empty``: no object.
        seed: Of the search and its starts; 0 without attack.
        placement: Name of the placement of the objects; empty for the experiment's own.
        reference: Where the method's code is, as `advnerf_core.attack.methods.load_method` takes it, if its name does not say.
    """

    scenario: str
    victim: str
    method: str
    seed: int
    placement: str = ""
    reference: str = field(default="", compare=False)

    @classmethod
    def of(cls, scenario: str, victim: str, method: str, seed: int, placement: str = "") -> Cell:
        """The cell of a method as `load_method` takes it, or of a control."""
        name = name_in_results(method)
        return cls(scenario, victim, name, seed, placement, "" if method == name else method)

    @property
    def name(self) -> str:
        """Name of its files."""
        return cell_name(self.scenario, self.victim, self.method, self.seed, self.placement)

    @property
    def searched(self) -> bool:
        """Whether a search finds what it meets; else it is a control."""
        return self.method not in CONTROLS

    @property
    def clean(self) -> Cell:
        """The same drives without attack: all seeds are measured from the same starts."""
        return replace(self, method=NONE, seed=0, reference="")

    @property
    def code(self) -> str:
        """Its method as `load_method` takes it, or the name of a control."""
        return self.reference or self.method


def select(cells: Sequence[Cell], only: str) -> list[Cell]:
    """The cells that fit a text such as ``scenario=straight,method=gradient+none,seed=0``; an empty text takes all.

    Raises:
        ConfigError: The text is no such text, or no cell fits.
    """
    wanted: dict[str, set[str]] = {}
    for part in filter(None, only.split(",")):
        key, separator, value = part.partition("=")
        if not separator or key.strip() not in KEYS:
            raise ConfigError(
                f"--only {only}: expected KEY=VALUE with KEY one of {', '.join(KEYS)}, got {part!r}"
            )
        wanted[key.strip()] = {each.strip() for each in value.split("+")}
    chosen = [
        cell for cell in cells if all(str(getattr(cell, key)) in values for key, values in wanted.items())
    ]
    if not chosen:
        raise ConfigError(f"--only {only}: expected some cells, got none; see advnerf status")
    return chosen
