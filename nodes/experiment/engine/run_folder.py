"""A resolved experiment in its run folder, with its variants and cells, and the manifest there; nothing of its world. Needs no torch."""

from __future__ import annotations

import platform
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

from advnerf_core.documents import Document, read_json
from advnerf_core.files import write_json
from advnerf_core.places import require_utf8
from advnerf_core.plugins import unknown
from advnerf_core.report.reference import Reference
from advnerf_core.strict import validate
from nodes.experiment.plan.cell import Cell, cells_of
from nodes.experiment.plan.config import ExperimentConfig
from nodes.experiment.plan.experiment_file import read_experiment_file
from nodes.experiment.plan.over import OVER
from nodes.lab.located import READ_AGAIN
from nodes.runtime.config import load_config
from nodes.runtime.errors import ConfigError

if TYPE_CHECKING:
    from typing_extensions import Self

# Folder of the cells in a run folder, and files of a cell's search in its folder there.
CELLS = "cells"
FROZEN, SEARCHED, ATTACK = "frozen.json", "surrogate.json", "attack.safetensors"
# A cell's note that its texture was rounded to half precision before it was driven past.
THETA = "float16"
_MANIFEST = "manifest.json"
# Libraries whose versions the manifest notes.
_LIBRARIES = (
    "torch",
    "numpy",
    "numba",
    "opencv-contrib-python-headless",
    "mujoco",
    "pyzmq",
    "rosbags",
    "mcap",
)


@dataclass(frozen=True)
class RunFolder:
    """One resolved experiment with its variants, or one of these.

    Attributes:
        setting: Name of the setting, e.g. ``demo``; empty for a file without settings.
        executes: Whether users' worlds may be executed; else the facts stored in the run folder are used.
        overrides: ``key=value`` texts of the command line.
        variants: Variants by name; an experiment without variants has none and runs its cells itself.
        load_variant: Loads a variant with its world and its victims; the same name gives the same object.
    """

    config: ExperimentConfig
    file: Path
    folder: Path
    setting: str
    executes: bool = True
    overrides: tuple[str, ...] = ()
    variants: Mapping[str, ExperimentConfig] = field(default_factory=dict)
    load_variant: Callable[[str], Self] | None = None

    @classmethod
    def resolved(
        cls,
        file: Path,
        setting: str | None,
        overrides: Sequence[str],
        folder: Path | None,
        executes: bool,
        load: Callable[[Self, Document], Self],
    ) -> Self:
        """Resolve an experiment file and its variants; see `nodes.experiment.steps.run.load_experiment`.

        Args:
            load: Reads the world and the victims of an experiment without variants, or of one variant, given its values.

        Raises:
            ConfigError: The file is wrong; with file, line and the valid keys.
        """
        read = read_experiment_file(file, setting, overrides)
        config = validate(ExperimentConfig, read.document, file.parent)
        folder = folder or config.run_folder or Path("runs") / (read.setting or config.name)
        require_utf8(folder.absolute())
        made = cls(config, file.resolve(), folder.resolve(), read.setting, executes, tuple(overrides))
        if not read.variants:
            _check_cells(made, read.document)
            return load(made, read.document)
        variants = {
            name: validate(ExperimentConfig, each, file.parent) for name, each in read.variants.items()
        }

        load_variant = cache(lambda name: load(made._with_values(variants[name]), read.variants[name]))
        whole = replace(made, variants=variants, load_variant=load_variant)
        _check_cells(whole, read.document)
        return whole

    def stage_folder(self, stage: str) -> Path:
        """Folder of a stage."""
        return self.folder / stage

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
                f"{self.file}: expected an experiment without variants, got {', '.join(self.variants)}; take them out of the section over, or name "
                "the file that they begin from"
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
        return self._with_values(self.config_of(cell)).folder if cell.variant else self.folder

    def _with_values(self, config: ExperimentConfig) -> Self:
        """A variant with these values, in its own run folder or in this one."""
        own = config.run_folder
        return replace(self, config=config, folder=self.folder if own is None else own.resolve())

    @cached_property
    def held_to(self) -> Reference:
        """The limits that the report is compared with.

        Raises:
            ConfigError: The file does not exist, or is not a file of limits.
        """
        file = self.config.reference
        return Reference() if file is None else load_config(Reference, self.file.parent / file)


def _check_cells(made: RunFolder, document: Document) -> None:
    """Check that cells have different names, paths and victims that exist, and that contrasts and claims name existing cells."""
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

    for variant, config in made.variants.items() or (("", made.config),):
        within = f" in {variant}" if variant else ""
        for victim in config.over.victim or ():
            require(victim, f"victim{within}", config.all_victims, OVER, "victim")
        for path in config.over.path or ():
            require(path, f"path{within}", config.paths, OVER, "path")
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


def require_own_folder(experiment: RunFolder) -> None:
    """Raise for a run folder of another experiment: stages with the same names and other keys would empty each other's folders.

    Raises:
        ConfigError: The folder belongs to another experiment.
    """
    manifest = experiment.folder / _MANIFEST
    try:
        there = read_json(manifest)["experiment"]
    except (OSError, ValueError, KeyError, TypeError):
        return
    if there != experiment.config.name:
        raise ConfigError(
            f"expected a run folder of experiment {experiment.config.name!r} or a new one, got {experiment.folder} of {there!r}; name another one "
            f"with --folder (for a variant: run_folder), or remove {manifest} to have its stages replaced where they differ"
        )


def _installed(library: str) -> str:
    """Version of a library; empty if it is not installed, such as MuJoCo for a world that does not need it."""
    try:
        return version(library)
    except PackageNotFoundError:
        return ""


def write_manifest(experiment: RunFolder) -> None:
    """Write the resolved experiment, the command, and the versions of the software into its run folder."""
    manifest = {
        "experiment": experiment.config.name,
        "setting": experiment.setting,
        "file": str(experiment.file),
        "command": " ".join(["advnerf", *sys.argv[1:]]),
        "config": experiment.config.model_dump(mode="json", context=READ_AGAIN),
        "versions": {"advnerf": version("advnerf"), "python": platform.python_version()}
        | {name: found for name in _LIBRARIES if (found := _installed(name))},
    }
    write_json(experiment.folder / _MANIFEST, manifest)
