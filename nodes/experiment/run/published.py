"""Cells that are stored with the code: one whose key matches counts as finished on every machine."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically, write_json
from advnerf_core.report.cells import CellResult, read_cell, read_cells
from advnerf_core.report.evidence.hardness import FILE as HARDNESS
from advnerf_core.report.evidence.hardness import PUBLISHED_FILE, merged, read_hardness, write_hardness
from advnerf_core.report.result_table import ResultTable, make_table
from nodes.experiment.engine.artefact import (
    BUILD,
    RECORD,
    ReferenceBuild,
    has_key,
    read_artefact,
    read_current,
)
from nodes.experiment.pages.table import wanted_rows
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.admission import gate_file, gate_key
from nodes.experiment.run.cells import keep_build
from nodes.experiment.run.kept_attacks import publish_attacks
from nodes.experiment.run.predictions import kept_prediction, prediction_file
from nodes.experiment.run.store import FINISHED, CellStatus
from nodes.experiment.show.context import Experiment
from nodes.runtime.errors import ConfigError


@dataclass(frozen=True)
class Published:
    """Result of publishing cells, by name.

    Attributes:
        written: Cells that are new or changed there.
        same: Cells that were there already.
        stale: Cells that are there with other settings than the current ones, also in the run folder.
    """

    written: tuple[str, ...]
    same: tuple[str, ...]
    stale: tuple[str, ...]


def publish(
    experiment: Experiment, found: Sequence[CellStatus], folder: Path, prune: bool = False
) -> Published:
    """Copy finished cells to the experiment's folder in ``folder``, with the fidelity gate's verdicts and the predictions of these cells.

    Cells there that are not finished here stay: they may have been run on another machine. With ``prune`` those whose results here have other
    settings too are removed.
    """
    written, same, stale = [], [], []
    for each in found:
        target = folder / experiment.config.name / f"{each.cell.name}.json"
        if each.state == "changed" and _is_of(target, each.result):
            stale.append(each.cell.name)
            if prune:
                target.unlink()
                prediction_file(folder / experiment.config.name, each.cell.name).unlink(missing_ok=True)
        if each.state != "done":
            continue
        text = _as_published(each)
        if target.exists() and target.read_text(encoding="utf-8") == text:
            same.append(each.cell.name)
            continue
        write_atomically(target, text)
        written.append(each.cell.name)
    _publish_beside(
        experiment, [each for each in found if each.state == "done"], folder / experiment.config.name
    )
    publish_attacks(experiment, found, folder / experiment.config.name)
    _publish_hardness(experiment, folder / experiment.config.name)
    return Published(tuple(written), tuple(same), tuple(stale))


def _as_published(found: CellStatus) -> str:
    """Content of a finished cell's file, under its name here: the variant's own run folder uses the name of its path."""
    assert found.file is not None, "a done cell is somewhere"
    cell, text = found.cell, found.file.read_text(encoding="utf-8")
    data = json.loads(text)
    if data["scenario"] == cell.scenario:
        return text
    return json.dumps({**data, "scenario": cell.scenario}, indent=1) + "\n"


@dataclass(frozen=True)
class PublishedBuild:
    """The reference build after its publication.

    Attributes:
        written: New folders of stages there.
        removed: Folders of stages that no published cell was run with.
        size_bytes: Size of all its files.
    """

    folder: Path
    written: tuple[Path, ...]
    removed: tuple[Path, ...]
    size_bytes: int


def publish_build(
    experiment: Experiment, cells: Sequence[Cell], folder: Path, prune: bool = False
) -> PublishedBuild:
    """Copy the scenes, victims and objects of an experiment's cells into the reference build beside the published sets.

    With ``prune`` stages there are removed that no cell published in ``folder`` was run with.
    """
    reference = ReferenceBuild(folder / BUILD)
    variants = {each.variant: experiment.of(each) for each in cells}
    written = [path for variant in variants.values() for path in keep_build(variant, reference)]
    removed = _prune_build(reference, folder) if prune else []
    size = sum(path.stat().st_size for path in reference.folder.rglob("*") if path.is_file())
    return PublishedBuild(reference.folder, tuple(written), tuple(removed), size)


def _prune_build(reference: ReferenceBuild, published: Path) -> list[Path]:
    found = [read_json(file) for file in published.glob("*/*.json")]
    used = {digest for each in found if "stages" in each for digest in each["stages"].values()}
    used |= {each["policy_sha256"] for each in found if each.get("policy_sha256")}  # of existing victims
    records = {
        file.parent: read_artefact(file.parent) for file in sorted(reference.folder.glob(f"*/{RECORD}"))
    }
    kept = {
        stage: record for stage, record in records.items() if record is not None and record.digest in used
    }
    shared = {folder for record in kept.values() for folder in record.files_in.values()}
    removed = [stage for stage in records if stage not in kept and stage.name not in shared]
    for stage in removed:
        shutil.rmtree(stage)
    return removed


def _is_of(published: Path, result: CellResult | None) -> bool:
    """Whether a published cell equals that result, and is not one with newer settings from another machine."""
    return (
        result is not None
        and published.exists()
        and read_cell(published).settings_hash == result.settings_hash
    )


def _publish_beside(experiment: Experiment, done: Sequence[CellStatus], folder: Path) -> None:
    for each in done:
        assert each.result is not None, "a finished cell has a result"
        kept = kept_prediction(prediction_file(experiment.folder, each.cell.name), each.result.settings_hash)
        if kept is not None:
            write_json(prediction_file(folder, each.cell.name), kept)
    for key in sorted({gate_key(each.cell) for each in done}):
        for drive in (False, True):
            verdict, published = (gate_file(each, key, drive) for each in (experiment.folder, folder))
            # Another machine judges the same scene and policy again, with other last digits: what was published stays.
            if (judged := read_current(verdict)) is not None and not has_key(published, judged["key"]):
                write_json(published, judged)


def _publish_hardness(experiment: Experiment, folder: Path) -> None:
    """Publish every verdict of the victims, also of recipes that did not pass."""
    runs = dict.fromkeys(experiment.folder_of(cell) for cell in experiment.cells)
    record = merged(
        [read_hardness(folder / PUBLISHED_FILE), *(read_hardness(run / HARDNESS) for run in runs)]
    )
    if record.verdicts:
        write_hardness(folder / PUBLISHED_FILE, record)


def published_table(folder: Path, experiment: Experiment, cells: Sequence[Cell] | None = None) -> ResultTable:
    """The table of published cells in a folder, with all requested lines and seeds; all cells of the experiment if none are given.

    Raises:
        ConfigError: The folder has no cells.
    """
    found = read_cells(folder)
    if not found:
        raise ConfigError(f"expected published cells in {folder}, got none; run advnerf experiment publish")
    return make_table(
        wanted_rows(experiment.cells if cells is None else cells),
        found,
        experiment.config.name,
    )


def table_of(experiment: Experiment, found: Sequence[CellStatus]) -> ResultTable:
    """The table of existing cells; only results with the current settings are used."""
    cells = [each.result for each in found if each.result is not None and each.state in FINISHED]
    return make_table(wanted_rows([each.cell for each in found]), cells, experiment.config.name)
