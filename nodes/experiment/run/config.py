"""The campaign file: which scenarios, victims, methods and seeds make a table, and where each scenario's experiment is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field, StringConstraints, model_validator

from advnerf_core.documents import read_yaml
from advnerf_core.places import require_utf8
from advnerf_core.plugins import name_in_results
from advnerf_core.report.conditions import CONTROLS, NONE, order_of
from advnerf_core.report.evidence.registration import Contrast
from advnerf_core.report.reference import Reference
from advnerf_core.scene.gate_limits import GateLimits
from advnerf_core.strict import StrictModel
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.method_names import ConditionReference
from nodes.experiment.plan.victims import HARDENED, NAIVE, VictimName
from nodes.runtime.config import load_config
from nodes.runtime.errors import ConfigError

if TYPE_CHECKING:
    from nodes.experiment.show.context import Experiment

# Names become file names, whose parts are separated by "_" and "."; a scenario may hold "_", victims may not.
Name = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_-]*$")]
# Of a file that names none.
METHODS: tuple[str, ...] = (NONE, "random", "cem", "gradient")
VICTIMS: tuple[VictimName, ...] = (HARDENED, NAIVE)


class PlacementConfig(StrictModel):
    """The objects somewhere else: changes of the experiment, in a run folder of their own."""

    run_folder: Path = Field(
        description="Run folder of the experiment with these changes; relative to the working folder."
    )
    set: tuple[str, ...] = Field(default=(), description="key=value texts over the scenario's own.")


class _NothingTwice(StrictModel):
    """Cells are named by these: one that is named twice would be run twice under one name."""

    @model_validator(mode="after")
    def _nothing_twice(self) -> _NothingTwice:
        for name in ("seeds", "victims", "methods"):
            values = getattr(self, name) or ()
            # Two files may have methods of one name.
            names = [name_in_results(value) for value in values] if name == "methods" else values
            if len(set(names)) != len(names):
                raise ValueError(f"expected every one of {name} once, got {list(values)}")
        return self


class ScenarioConfig(_NothingTwice):
    """One scenario: an experiment, and how it is read."""

    experiment: Path = Field(description="Experiment file; relative to the campaign file.")
    setting: str = Field(default="full", description="Which of its settings.")
    run_folder: Path = Field(description="Run folder of the experiment; relative to the working folder.")
    set: tuple[str, ...] = Field(default=(), description="key=value texts over the file, as --set.")
    as_scenario: str = Field(
        default="", description="What the experiment calls it, where the name here is another; else the name."
    )
    placements: dict[Name, PlacementConfig] = Field(
        default_factory=dict, description="Other places of the objects."
    )
    seeds: tuple[int, ...] | None = Field(
        default=None, min_length=1, description="Instead of the campaign's."
    )
    victims: tuple[VictimName, ...] | None = Field(
        default=None, min_length=1, description="Instead of the campaign's."
    )
    methods: tuple[ConditionReference, ...] | None = Field(
        default=None, min_length=1, description="Instead of the campaign's."
    )
    gate: GateLimits | None = Field(default=None, description="Instead of the campaign's.")


class CampaignConfig(_NothingTwice):
    """A campaign file."""

    @model_validator(mode="after")
    def _contrasts_scenarios(self) -> CampaignConfig:
        for contrast in self.contrasts:
            for name in (contrast.before, contrast.after):
                if name not in self.scenarios:
                    raise ValueError(
                        f"contrast {contrast.name!r}: expected one of the scenarios {', '.join(self.scenarios)}, got {name!r}"
                    )
        return self

    name: Name
    folder: Path | None = Field(default=None, description="Where cells go; default runs/campaigns/NAME.")
    seeds: tuple[int, ...] = Field(default=(0, 1, 2), min_length=1)
    victims: tuple[VictimName, ...] = Field(default=VICTIMS, min_length=1)
    methods: tuple[ConditionReference, ...] = Field(
        default=METHODS,
        min_length=1,
        description="none, empty, and methods of attack; also file.py:Name, relative to the campaign file.",
    )
    scenarios: dict[Name, ScenarioConfig] = Field(min_length=1)
    gate: GateLimits = GateLimits()
    contrasts: tuple[Contrast, ...] = Field(
        default=(),
        description="What the same attacks under two conditions tell apart; they must be searched alike.",
    )
    reference: Path | None = Field(
        default=None,
        description="File of totals and limits that the table is held against; relative to the campaign file.",
    )


@dataclass(frozen=True)
class Campaign:
    """Cells that make one table: those of a campaign file, or of one experiment.

    Attributes:
        name: Of the campaign or the experiment.
        file: Where it was read.
        folder: Where its cells go.
        scenarios: Where each scenario's experiment is, by name.
        cells: All cells, in the order in which they are run.
        gate: What a learned scene must reach; None judges none.
        reference: What the table is held against.
        contrasts: Conditions that are told apart.
        executes: As of `Experiment`.
    """

    name: str
    file: Path
    folder: Path
    scenarios: Mapping[str, ScenarioConfig]
    cells: tuple[Cell, ...]
    gate: GateLimits | None = None
    reference: Reference = field(default_factory=Reference)
    contrasts: tuple[Contrast, ...] = ()
    executes: bool = True

    def scenario(self, cell: Cell) -> ScenarioConfig:
        """The scenario of a cell."""
        return self.scenarios[cell.scenario]

    def inside(self, cell: Cell) -> Cell:
        """The cell as its experiment names it."""
        return replace(cell, scenario=self.scenario(cell).as_scenario or cell.scenario, placement="")

    def experiment_file(self, cell: Cell) -> Path:
        """The experiment file of a cell."""
        return (self.file.parent / self.scenario(cell).experiment).resolve()

    def run_folder(self, cell: Cell) -> Path:
        """The run folder of a cell's experiment."""
        scenario = self.scenario(cell)
        chosen = scenario.placements[cell.placement].run_folder if cell.placement else scenario.run_folder
        return chosen.resolve()

    def overrides(self, cell: Cell) -> list[str]:
        """Changes of a cell's experiment."""
        scenario = self.scenario(cell)
        return [*scenario.set, *(scenario.placements[cell.placement].set if cell.placement else ())]


def load_campaign(file: Path, folder: Path | None = None, overrides: tuple[str, ...] = ()) -> Campaign:
    """Read a campaign file.

    Args:
        file: A ``*.campaign.yaml`` file.
        folder: Instead of the file's.
        overrides: ``key=value`` texts over the file.

    Raises:
        ConfigError: With file, line and the valid keys.
    """
    config = load_config(CampaignConfig, file, overrides)
    where = (folder or config.folder or Path("runs/campaigns") / config.name).resolve()
    require_utf8(where)
    against = load_config(Reference, file.parent / config.reference) if config.reference else Reference()
    campaign = Campaign(
        config.name,
        file.resolve(),
        where,
        config.scenarios,
        tuple(_cells(config)),
        config.gate,
        against,
        config.contrasts,
    )
    for cell in campaign.cells:
        if not campaign.experiment_file(cell).is_file():
            raise ConfigError(
                f"{file}: expected the experiment file of scenario {cell.scenario} at {campaign.experiment_file(cell)}, which is "
                "not there; the path is relative to the campaign file"
            )
    return campaign


def is_campaign(file: Path) -> bool:
    """Whether a file lists several experiments; else it is one."""
    data = read_yaml(file).data
    return isinstance(data, dict) and isinstance(data.get("scenarios"), dict)


def campaign_of(experiment: Experiment, overrides: Sequence[str], cells: Sequence[Cell]) -> Campaign:
    """The cells of one experiment, in its own run folder.

    Args:
        experiment: The experiment.
        overrides: ``key=value`` texts with which it was read.
        cells: Its cells.
    """
    scenario = ScenarioConfig(
        experiment=experiment.file,
        setting=experiment.setting,
        run_folder=experiment.folder,
        set=tuple(overrides),
    )
    scenarios = dict.fromkeys(experiment.config.scenarios, scenario)
    return Campaign(
        experiment.config.name,
        experiment.file,
        experiment.folder,
        scenarios,
        tuple(cells),
        # By default the experiment itself judges, see `steering_gate`.
        experiment.config.gate if isinstance(experiment.config.gate, GateLimits) else None,
        experiment.held_to,
        executes=experiment.executes,
    )


def _cells(config: CampaignConfig) -> Iterator[Cell]:
    """Per scenario and seed, none first, as others are compared with it."""
    for name, scenario in config.scenarios.items():
        for placement in ("", *scenario.placements):
            for number, seed in enumerate(scenario.seeds or config.seeds):
                for victim in scenario.victims or config.victims:
                    for method in sorted(scenario.methods or config.methods, key=_order):
                        cell = Cell.of(name, victim, method, seed, placement)
                        # All seeds are measured from the same starts.
                        if method not in CONTROLS:
                            yield cell
                        elif number == 0:
                            yield replace(cell, seed=0)


def _order(method: str) -> tuple[int, str]:
    return order_of(name_in_results(method))
