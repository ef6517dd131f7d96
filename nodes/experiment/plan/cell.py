"""One point of an experiment's grid: variant and path, victim, condition, and seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from advnerf_core.plugins import name_in_results, unknown
from advnerf_core.report.cells import cell_name
from advnerf_core.report.conditions import CONTROLS, NONE
from nodes.experiment.plan.config import ExperimentConfig
from nodes.runtime.errors import ConfigError

# Keys of --only.
KEYS = ("variant", "path", "victim", "method", "seed")
# Share of a cell's work that is finished when only its drives are left.
SEARCHED_SHARE = 0.9


@dataclass(frozen=True)
class Cell:
    """One cell.

    Attributes:
        scenario: Name of variant and path in tables and file names: the path; for a variant its name, or PATH_VARIANT if it has several paths.
        method: Name of the method of attack; ``none``: no attack, ``empty``: no object.
        seed: Seed of the search and its starts; 0 without attack.
        variant: Name of the experiment's variant; empty for an experiment without variants.
        within: The path of a variant's cell; empty if ``scenario`` is the path.
        reference: Reference of the method's code for `advnerf_core.attack.methods.load_method`, if it differs from its name.
    """

    scenario: str
    victim: str
    method: str
    seed: int
    variant: str = ""
    within: str = ""
    reference: str = field(default="", compare=False)

    @classmethod
    def of(cls, path: str, victim: str, method: str, seed: int) -> Cell:
        """The cell of a control, or of a method by its reference for `load_method`."""
        name = name_in_results(method)
        return cls(path, victim, name, seed, reference="" if method == name else method)

    @property
    def path(self) -> str:
        """The path that is driven."""
        return self.within or self.scenario

    @property
    def inside(self) -> Cell:
        """The cell with its name in the variant."""
        return replace(self, scenario=self.path, variant="", within="")

    @property
    def name(self) -> str:
        """Name of its files."""
        return cell_name(self.scenario, self.victim, self.method, self.seed)

    @property
    def searched(self) -> bool:
        """Whether a search finds its attack; else it is a control."""
        return self.method not in CONTROLS

    @property
    def clean(self) -> Cell:
        """The same drives without attack: all seeds are measured from the same starts."""
        return replace(self, method=NONE, seed=0, reference="")

    @property
    def code(self) -> str:
        """Reference of the method for `load_method`, or the name of a control."""
        return self.reference or self.method


def cells_of(config: ExperimentConfig, variant: str = "") -> list[Cell]:
    """All cells of a resolved experiment, or of one of its variants: every seed against each victim, quick ones first.

    Unless ``over`` names victims, a plainly trained one beside the main one meets the first seed alone.
    """
    paths = config.cell_paths

    def seeds_of(victim: str) -> tuple[int, ...]:
        train = config.trained.get(victim)
        beside = victim != config.main_victim and train is not None and train.textures == "none"
        return config.seeds[:1] if beside and config.over.victim is None else config.seeds

    def cell(path: str, victim: str, method: str, seed: int) -> Cell:
        # All seeds are measured from the same starts, so that a control is one cell for all of them.
        found = Cell.of(path, victim, method, 0 if method in CONTROLS else seed)
        if not variant:
            return found
        return replace(
            found, scenario=variant if len(paths) == 1 else f"{path}_{variant}", variant=variant, within=path
        )

    found = (
        cell(path, victim, method, seed)
        for victim in config.over.victim or config.attacked
        for seed in seeds_of(victim)
        for method in config.over.method
        for path in paths
    )
    return list(dict.fromkeys(found))


def select(cells: Sequence[Cell], only: str) -> list[Cell]:
    """The cells that match a text such as ``path=straight,method=gradient+none,seed=0``; an empty text selects all.

    Raises:
        ConfigError: The text is invalid, a value is that of no cell, or no cell matches.
    """
    wanted: dict[str, set[str]] = {}
    for part in filter(None, only.split(",")):
        key, separator, value = part.partition("=")
        if not separator or key.strip() not in KEYS:
            raise ConfigError(
                f"--only {only}: expected KEY=VALUE with KEY one of {', '.join(KEYS)}, got {part!r}"
            )
        if (name := key.strip()) in wanted:
            raise ConfigError(f"--only {only}: expected {name} once, got it twice; join its values with +")
        wanted[name] = {each.strip() for each in value.split("+")}
        known = dict.fromkeys(str(getattr(cell, name)) for cell in cells)
        for each in sorted(wanted[name] - known.keys()):
            raise ConfigError(f"--only {only}: {unknown(each, name, known)}")
    chosen = [
        cell for cell in cells if all(str(getattr(cell, key)) in values for key, values in wanted.items())
    ]
    if not chosen:
        raise ConfigError(f"--only {only}: expected some cells, got none; see advnerf experiment status")
    return chosen
