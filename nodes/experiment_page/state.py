"""The page's data of a run folder, as JSON: from its progress record, and from the files of its cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from advnerf_core.report.conditions import style_of
from nodes.experiment.engine.progress_record import read_progress
from nodes.experiment.plan.method_names import know_methods_of
from nodes.experiment_page import shown_files
from nodes.experiment_page.cells import cell_part
from nodes.experiment_page.searches import Search, has_texture, read_search
from nodes.experiment_page.time_left import all_left_s, part_left_s
from nodes.lab.recorded_victim import recorded_state

_REPORT_STAGE, _CELLS = "report", "cells"
_LINES = 40


def read_state(folder: Path, now_s: float) -> dict[str, Any]:
    """The page's current data at ``now_s``, seconds since 1970."""
    record = read_progress(folder)
    if not record:
        return {"name": folder.name, "phase": "waiting", "parts": [], "curves": [], "searches": []}
    know_methods_of(folder / _CELLS, {cell["method"] for cell in record["cells"]})
    stages = [{**record["parts"][name], "kind": "stage", "title": name} for name in record["stages"]]
    cells = _cells(folder, record)
    phase = _phase(record)
    left_s, known = all_left_s(stages, cells, now_s)
    films = shown_files.films(folder, cell_names(record))
    parts = [*(each for each in stages if each["name"] != _REPORT_STAGE), *cells]
    parts += [each for each in stages if each["name"] == _REPORT_STAGE]
    return {
        "name": record["name"],
        "setting": record["setting"],
        "folder": str(folder),
        "phase": phase,
        "failure": record["failure"],
        "began_s": record["began_s"],
        "ended_s": record["ended_s"],
        "left_s": round(left_s, 1) if phase == "running" else None,
        "left_known": known,
        "report": report_is_shown(folder, record),
        "parts": [_shown(part, now_s) for part in parts],
        "curves": _curves(record),
        # Running parts come first.
        "searches": sorted(_searches(folder, record, cells), key=lambda search: search["finished"]),
        "pictures": list(shown_files.pictures(folder)),
        "films": list(films),
        # Until the run has films of its own.
        "recorded": None if films else recorded_state(folder),
        "log": record["log"][-_LINES:],
    }


def _cells(folder: Path, record: Mapping[str, Any]) -> list[dict[str, Any]]:
    parts, began_s = record["parts"], record["began_s"]
    return [
        {**cell_part(folder / _CELLS, cell, parts[cell["name"]], began_s), "title": _title(cell)}
        for cell in record["cells"]
    ]


def report_is_shown(folder: Path, record: Mapping[str, Any]) -> bool:
    """Whether the run has ended with a report of its settings."""
    part = record.get("parts", {}).get(_REPORT_STAGE)
    made = part is not None and part["state"] in ("done", "reused")
    return bool(made and _phase(record) == "finished" and (folder / shown_files.REPORT).is_file())


def _phase(record: Mapping[str, Any]) -> str:
    if not record["ended_s"]:
        return "running"
    return "failed" if record["failure"] else "finished"


def _shown(part: Mapping[str, Any], now_s: float) -> dict[str, Any]:
    left_s = part_left_s(part, now_s)
    keys = ("name", "title", "kind", "state", "text", "began_s", "seconds", "measured")
    shown = {key: part[key] for key in keys if key in part}
    return {
        **shown,
        "fraction": round(part["fraction"], 3),
        "left_s": None if left_s is None else round(left_s, 1),
    }


def _curves(record: Mapping[str, Any]) -> list[dict[str, Any]]:
    return [
        {"of": stage, "name": name, "points": points}
        for stage in record["stages"]
        for name, points in record["curves"].get(stage, {}).items()
    ]


def _searches(
    folder: Path, record: Mapping[str, Any], cells: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    # Files in the folder of a waiting cell may belong to other settings.
    begun = {part["name"] for part in cells if part["state"] != "waiting"}
    return [*_cell_searches(folder / _CELLS, record, begun), *_other_searches(folder, record)]


def _cell_searches(cells_folder: Path, record: Mapping[str, Any], begun: set[str]) -> list[dict[str, Any]]:
    found = []
    for cell in record["cells"]:
        search = (
            read_search(cells_folder / cell["name"]) if cell["searched"] and cell["name"] in begun else None
        )
        if search is not None:
            found.append(_shown_search(cell["name"], _title(cell), cell["method"], search, record))
    return found


def _title(cell: Mapping[str, Any]) -> str:
    """Title of a cell for readers."""
    seed = f", seed {cell['seed']}" if cell["searched"] else ""
    return f"{cell['scenario']}, {cell['victim']}, {style_of(cell['method']).title}{seed}"


def _other_searches(folder: Path, record: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Searches against retrained victims, which belong to a stage."""
    known = {"maximised": record["maximised"]} if "maximised" in record else {}
    found = []
    for file in sorted((folder / "retrain").glob("round*/*.state.safetensors")):
        search = read_search(file.parent, file.name)
        if search is not None:
            title = f"{file.name.partition('.')[0]}, {file.parent.name} of retraining, gradient"
            found.append(_shown_search("", title, "gradient", search, known))
    return found


def _shown_search(
    name: str, title: str, method: str, search: Search, record: Mapping[str, Any]
) -> dict[str, Any]:
    return {
        "name": name,
        "title": title,
        "colour": style_of(method).key,
        "climbs": style_of(method).climbs,
        "planned": len(search.values) if search.finished else record.get("planned", 0),
        "finished": search.finished,
        "values": search.values,
        "measure": record.get("maximised", {"name": "total CTE", "unit": "m"}),
        "best": search.best,
        "texture": search.version if has_texture(record.get("space", "")) else "",
    }


def cell_names(record: Mapping[str, Any]) -> Sequence[str]:
    """Names of the cells of a record."""
    return [cell["name"] for cell in record.get("cells", ())]
