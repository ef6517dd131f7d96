"""An experiment's file content: its variants, its cells and their folders; nothing of its world. Needs no torch."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from advnerf_core.documents import Document
from advnerf_core.places import require_utf8
from advnerf_core.plugins import unknown
from advnerf_core.report.reference import Reference
from advnerf_core.strict import validate
from nodes.experiment.engine.run_folder import RunFolder
from nodes.experiment.plan.cell import Cell, cells_of
from nodes.experiment.plan.config import ExperimentConfig
from nodes.experiment.plan.experiment_file import read_experiment_file
from nodes.experiment.plan.over import OVER
from nodes.runtime.config import load_config
from nodes.runtime.errors import ConfigError

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True)
class Variants(RunFolder):
    """One resolved experiment with its variants, or one of these.

    Attributes:
        executes: Whether users' worlds may be executed; else the facts stored in the run folder are used.
        overrides: ``key=value`` texts of the command line.
        variants: Variants by name; an experiment without variants has none and runs its cells itself.
        load_variant: Loads a variant with its world and its victims; the same name gives the same object.
    """

    executes: bool = True
    overrides: tuple[str, ...] = ()
    variants: Mapping[str, ExperimentConfig] = field(default_factory=dict)
    load_variant: Callable[[str], Self] | None = None

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """All cells, in the order in which they are run."""
        if not self.variants:
            return tuple(cells_of(self.config))
        return tuple(cell for name, config in self.variants.items() for cell in cells_of(config, name))

    def require_one(self) -> None:
        """Raise for an experiment with variants.

        Raises:
            ConfigError: The experiment has variants.
        """
        if self.variants:
            raise ConfigError(
                f"{self.file}: expected an experiment without variants, got {', '.join(self.variants)}; name the file that they change"
            )

    def of(self, cell: Cell) -> Self:
        """The experiment that a cell belongs to: the variant, or this one.

        Raises:
            ConfigError: The variant's world or victims are wrong.
        """
        return self.load_variant(cell.variant) if cell.variant and self.load_variant is not None else self

    def config_of(self, cell: Cell) -> ExperimentConfig:
        """The values of the variant that a cell belongs to, or of this experiment."""
        return self.variants[cell.variant] if cell.variant else self.config

    def folder_of(self, cell: Cell) -> Path:
        """The run folder of the stages that a cell needs."""
        own = self.config_of(cell).run_folder if cell.variant else None
        return self.folder if own is None else own.resolve()

    @cached_property
    def held_to(self) -> Reference:
        """The limits that the report is compared with.

        Raises:
            ConfigError: The file does not exist, or is not a file of limits.
        """
        file = self.config.reference
        return Reference() if file is None else load_config(Reference, self.file.parent / file)


Made = TypeVar("Made", bound=Variants)


def resolve(
    kind: type[Made],
    file: Path,
    setting: str | None,
    overrides: Sequence[str],
    folder: Path | None,
    executes: bool,
    load: Callable[[Made, Document], Made],
) -> Made:
    """Resolve an experiment file and its variants; see `nodes.experiment.steps.run.load_experiment`.

    Args:
        kind: Class of the result.
        load: Reads the world and the victims of an experiment without variants, or of one variant, given its values.

    Raises:
        ConfigError: The file is wrong; with file, line and the valid keys.
    """
    read = read_experiment_file(file, setting, overrides)
    config = validate(ExperimentConfig, read.document, file.parent)
    folder = folder or config.run_folder or Path("runs") / (read.setting or config.name)
    require_utf8(folder.absolute())
    made = kind(config, file.resolve(), folder.resolve(), read.setting, executes, tuple(overrides))
    if not read.variants:
        _check_cells(made, read.document)
        return load(made, read.document)
    variants = {name: validate(ExperimentConfig, each, file.parent) for name, each in read.variants.items()}

    @cache
    def load_variant(name: str) -> Made:
        own = variants[name].run_folder
        variant = replace(made, config=variants[name], folder=made.folder if own is None else own.resolve())
        return load(variant, read.variants[name])

    whole = replace(made, variants=variants, load_variant=load_variant)
    _check_cells(whole, read.document)
    return whole


def _check_cells(made: Variants, document: Document) -> None:
    """Check that cells have different names, and that contrasts and claims name existing cells."""
    (name, count), *_ = Counter(cell.name for cell in made.cells).most_common(1)
    if count > 1:
        raise ConfigError(
            f"{document.place((OVER,))}: expected cells of different names, got {name} {count} times; rename a variant"
        )
    known = dict.fromkeys(cell.scenario for cell in made.cells)

    def require(name: str, what: str, names: Iterable[str], *place: str | int) -> None:
        if name not in names:
            message = unknown(name, what, names)
            raise ConfigError(f"{document.place(place)}: {'.'.join(map(str, place))}: {message}")

    for index, contrast in enumerate(made.config.contrasts):
        for name in (contrast.before, contrast.after):
            require(name, "variant", known, "contrasts", index)
    for index, claim in enumerate(made.config.claims):
        for scenario in claim.scenarios:
            require(scenario, "variant", known, "claims", index)
            for victim in claim.victims:
                there = [cell for cell in made.cells if cell.scenario == scenario]
                require(victim, f"victim of {scenario}", {cell.victim for cell in there}, "claims", index)
                methods = {cell.method for cell in there if cell.victim == victim}
                for method in (claim.method, *claim.against):
                    require(method, f"method against {victim} in {scenario}", methods, "claims", index)
