"""Verifying a published set: every number is computed again, and every file, cell, drive and start is what was registered.

A set is a folder: its registration, one file per cell with the kept drives, and `SET`, which lists the files with their digests and holds
the published numbers. The digests of all sets are in one file beside their folders, `DIGESTS`. Nothing here needs torch or a simulator.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import sha256_of, write_atomically
from advnerf_core.report.cells import CellError, CellResult, read_cell
from advnerf_core.report.evidence.about import check_about, read_about
from advnerf_core.report.evidence.contrasts import contrast_data
from advnerf_core.report.evidence.families import families_note
from advnerf_core.report.evidence.hardness import titles_of, with_titles
from advnerf_core.report.evidence.kept import KeptDrive
from advnerf_core.report.evidence.kept_build import lost_note
from advnerf_core.report.evidence.page import film_of, picture_of, results_page
from advnerf_core.report.evidence.registration import (
    FILE,
    WITHDRAWN,
    RegisteredScenario,
    Registration,
    RegistrationError,
    read_registration,
    read_withdrawn,
)
from advnerf_core.report.evidence.results import DOMAINS, Evidence, as_data
from advnerf_core.report.reference import Domain

SET, DIGESTS, PAGE, FORMAT = "set/set.json", "sets.json", "transfer.md", "advnerf-set-1"
# Kept poses are rounded; a total of some hundred ticks then differs by less.
_TOTAL_TOLERANCE_M = 2e-3
# A surrogate drive begins at its start to the bit. Live, a car is put down so well [m, rad].
_SURROGATE_START, _DEPLOYED_START = (2e-5, 2e-5), (0.05, 0.1)


class SetError(AdvnerfError, ValueError):
    """A folder is no set of results."""


@dataclass(frozen=True)
class Verified:
    """What verifying a set found.

    Attributes:
        name: Of the set.
        numbers: Published numbers that were computed again.
        drives: Drives that they were computed from.
        problems: What is wrong, in words; none if all is well.
        awaits_results: It is registered, and nothing of it was published yet.
    """

    name: str
    numbers: int
    drives: int
    problems: tuple[str, ...]
    awaits_results: bool = False


def sets_in(published: Path) -> list[str]:
    """Names of the registered sets in the folder of all that is published."""
    return sorted(file.parents[1].name for file in published.glob(f"*/{FILE}"))


def write_set(folder: Path) -> Path:
    """Write a set as `write_numbers` does, and the page of all sets."""
    file = write_numbers(folder)
    write_page(folder.parent)
    return file


def write_numbers(folder: Path) -> Path:
    """Write the manifest, the numbers and the picture of a set, and beside its folder its digest.

    Raises:
        SetError: Nothing was registered there, or its cells contradict the registration.
    """
    registration, cells = _read(folder)
    evidence = Evidence(registration, cells)
    withdrawn = read_withdrawn(folder)
    problems = list(_against_registration(evidence, cells, withdrawn))
    if problems:
        raise SetError(f"{folder}: cannot be published: {problems[0]} ({len(problems)} problems in all)")
    data = {
        "format": FORMAT,
        "name": registration.name,
        "registration": registration.digest,
        "files": digests_of(folder),
        **({"withdrawn": withdrawn} if withdrawn else {}),
        **_published(evidence),
    }
    write_atomically(folder / SET, json.dumps(data, indent=1) + "\n")
    # They load matplotlib, which verifying does not need.
    from advnerf_core.report.evidence.above import write_above_of
    from advnerf_core.report.evidence.plot import excess_plot
    from advnerf_core.report.plots import write_png

    known = _known_digests(folder.parent)
    known[folder.name] = sha256_of(folder / SET)
    write_atomically(folder.parent / DIGESTS, json.dumps(known, indent=1, sort_keys=True) + "\n")
    write_png(
        excess_plot(evidence, titles_of(folder, data)), folder.parent / picture_of(folder.name), dpi=110
    )
    write_above_of(folder)
    return folder / SET


def write_page(published: Path) -> Path:
    """Write the page of all sets."""
    write_atomically(published / PAGE, _page(published))
    return published / PAGE


def verify_set(folder: Path) -> Verified:
    """Compute everything in a set again, and compare.

    Raises:
        SetError: The folder has no registration.
    """
    try:
        registration, cells = _read(folder)
        withdrawn = read_withdrawn(folder)
    except (SetError, RegistrationError, CellError) as error:
        return Verified(folder.name, 0, 0, (str(error),))
    if not cells and not (folder / SET).exists() and folder.name not in _known_digests(folder.parent):
        return Verified(folder.name, 0, 0, (), awaits_results=True)
    evidence = Evidence(registration, cells)
    problems = [*_files(folder), *_against_registration(evidence, cells, withdrawn)]
    numbers = 0
    if not problems:  # numbers of damaged drives say nothing more
        numbers, wrong = _numbers(folder, evidence, withdrawn)
        problems += wrong
        if not wrong:  # it is made of these numbers
            problems += _page_problems(folder.parent)
    drives = sum(len(kept) for cell in cells for kept in cell.kept.values())
    return Verified(folder.name, numbers, drives, tuple(problems))


def _page_problems(published: Path) -> list[str]:
    try:
        check_about(published, sets_in(published))
    except AdvnerfError as error:
        return [str(error)]
    page = published / PAGE
    try:
        made = _page(published)
    except (KeyError, TypeError) as error:
        return [
            f"{page}: cannot be made: a set has not the numbers that this version publishes: {error}; publish it again"
        ]
    same = page.exists() and page.read_text(encoding="utf-8") == made
    return [] if same else [f"{page}: is not the page of the published sets"]


def _page(published: Path) -> str:
    """The page of all sets, from their manifests and registrations."""
    sets, about = {}, read_about(published)
    for name in sets_in(published):
        registration = read_registration(published / name)
        if registration is not None and (published / name / SET).exists():
            registered = {**registration.model_dump(mode="json"), "digest": registration.digest}
            data = with_titles(published / name, read_json(published / name / SET))
            filmed = (published / film_of(name)).exists()
            notes = [*families_note(registration), *lost_note(published / name)]
            said = about[name].model_dump(mode="json") if name in about else None
            sets[name] = {**data, "registered": registered, "about": said, "filmed": filmed, "notes": notes}
    return results_page(sets)


def _read(folder: Path) -> tuple[Registration, list[CellResult]]:
    registration = read_registration(folder)
    if registration is None:
        raise SetError(f"{folder}: expected {FILE}, which advnerf register writes, got none")
    return registration, [read_cell(file) for file in _cell_files(folder)]


def _cell_files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.json"))


def digests_of(folder: Path) -> dict[str, str]:
    files = (folder / FILE, *filter(Path.exists, [folder / WITHDRAWN]), *_cell_files(folder))
    return {file.relative_to(folder).as_posix(): sha256_of(file) for file in files}


def _known_digests(published: Path) -> dict[str, str]:
    file = published / DIGESTS
    if not file.exists():
        return {}
    known: dict[str, str] = read_json(file)
    return known


def _files(folder: Path) -> Iterator[str]:
    """Whether the files are those of the manifest, and the manifest is the one that was published."""
    file = folder / SET
    try:
        listed = read_json(file)["files"]
        known = _known_digests(folder.parent).get(folder.name)
    except (OSError, ValueError, KeyError, TypeError) as error:
        yield f"{file}: cannot be read: {error}"
        return
    if known != sha256_of(file):
        yield f"{file}: its digest is not the one in {folder.parent / DIGESTS}"
    found = digests_of(folder)
    for name in sorted(listed.keys() | found.keys()):
        if name not in found:
            yield f"{folder / name}: is listed in {SET}, and is not there"
        elif name not in listed:
            yield f"{folder / name}: is not listed in {SET}"
        elif listed[name] != found[name]:
            yield f"{folder / name}: its digest is not the one in {SET}"


def _against_registration(
    evidence: Evidence, cells: Sequence[CellResult], withdrawn: Collection[str]
) -> Iterator[str]:
    """Whether all that was registered and not withdrawn is there, from the registered starts, and of one build."""
    there = {cell.name for cell in cells}
    for wanted in evidence.registration.cells:
        name = wanted.name
        if wanted.scenario in withdrawn:
            if name in there:
                yield f"{name}: is there, and its scenario was withdrawn"
        elif name not in there:
            yield f"{name}: was registered, and is not there"
        elif name in evidence.cells and not evidence.is_registered(evidence.cells[name]):
            yield f"{name}: was registered, and was not run under this registration"
    for cell in cells:
        if cell.not_driven_live:
            yield f"{cell.name}: was not driven live and is no evidence: {cell.not_driven_live}"
        elif cell.name not in evidence.cells:
            yield f"{cell.name}: expected a cell of a registered scenario with its drives kept"
        elif not evidence.is_registered(cell) and cell.registration:
            yield f"{cell.name}: says that it was registered, and was not"
        else:
            yield from _drives(evidence, cell)
    yield from _one_build(evidence)


def _drives(evidence: Evidence, cell: CellResult) -> Iterator[str]:
    """Whether a cell has one drive from each registered start in each domain, and its totals are those of its drives."""
    scenario = evidence.scenario_of(cell)
    counts: Mapping[Domain, int] = {"surrogate": len(scenario.starts), "deployed": scenario.deployed_starts}
    for domain in DOMAINS:
        kept, where = cell.kept.get(domain, ()), f"{cell.name}, {domain}"
        if len(kept) != counts[domain]:
            yield f"{where}: expected drives from {counts[domain]} registered starts, got {len(kept)}"
            continue
        if len({drive.x_m + drive.y_m for drive in kept}) != len(kept):
            yield f"{where}: two drives are the same"
        try:
            yield from _starts(scenario, kept, domain, where)
            yield from _totals(evidence, cell, domain, where)
        except ValueError as error:
            yield f"{where}: {error}"


def _starts(
    scenario: RegisteredScenario, kept: Sequence[KeptDrive], domain: Domain, where: str
) -> Iterator[str]:
    near_m, near_rad = _SURROGATE_START if domain == "surrogate" else _DEPLOYED_START
    for number, (drive, start) in enumerate(zip(kept, scenario.starts, strict=False)):
        poses = drive.poses()
        if len(poses) != scenario.ticks + 1 or drive.driven_ticks > scenario.ticks:
            yield f"{where}, start {number}: expected {scenario.ticks + 1} poses, got {len(poses)}"
        off_m = float(np.hypot(*(poses[0, :2] - start[:2])))
        turned_rad = abs(float(np.angle(np.exp(1j * (poses[0, 2] - start[2])))))
        if off_m > near_m or turned_rad > near_rad:
            yield f"{where}, start {number}: begins {off_m:.3f} m and {turned_rad:.3f} rad from the registered start"


def _totals(evidence: Evidence, cell: CellResult, domain: Domain, where: str) -> Iterator[str]:
    said = cell.surrogate if domain == "surrogate" else cell.deployed
    if said is None:
        return
    clean = evidence.without(cell)
    none = evidence.metrics(clean, domain) if clean else []
    for number, found in enumerate(evidence.metrics(cell, domain)):
        pairs = [(said.total_cte_m[number], found.total_cte_m)]
        pairs += [(said.none_total_cte_m[number], none[number].total_cte_m)] if number < len(none) else []
        if any(abs(a - b) > _TOTAL_TOLERANCE_M for a, b in pairs):
            yield f"{where}, start {number}: its total CTE is not that of its poses"
        elif said.off_track[number] != found.off_track:
            yield f"{where}, start {number}: whether it left the track is not what its poses say"


def _one_build(evidence: Evidence) -> Iterator[str]:
    """Whether all cells of a scenario are of the same stages, and each victim is one policy."""
    stages: dict[tuple[str, str], dict[str, str]] = {}
    policies: dict[tuple[str, str, str], str] = {}
    for cell in evidence.cells.values():
        place = (cell.scenario, cell.placement)
        if cell.stages != stages.setdefault(place, cell.stages):
            yield f"{cell.name}: was run with other stages than the cells before it"
        victim = (*place, cell.victim)
        if cell.policy_sha256 != policies.setdefault(victim, cell.policy_sha256):
            yield f"{cell.name}: was run against another policy than the other cells of this victim"
    by_place: dict[tuple[str, str], list[str]] = {}
    for (scenario, placement, _), digest in policies.items():
        by_place.setdefault((scenario, placement), []).append(digest)
    for (scenario, placement), found in by_place.items():
        if len(set(found)) != len(found):
            yield f"{scenario} {placement}: two victims are one policy"


def _published(evidence: Evidence) -> dict[str, Any]:
    """All numbers of a set as JSON data."""
    return {**as_data(evidence), **contrast_data(evidence)}


def _numbers(folder: Path, evidence: Evidence, withdrawn: Mapping[str, str]) -> tuple[int, list[str]]:
    """How many published numbers there are, and those that are not what the drives give."""
    published = read_json(folder / SET)
    found = json.loads(json.dumps(_published(evidence)))
    count, wrong = 0, []
    if published["deployed_through"] != found["deployed_through"]:
        wrong.append(
            f"{SET}: expected drives deployed through {found['deployed_through']}, got {published['deployed_through']}"
        )
    if published.get("withdrawn", {}) != withdrawn:
        wrong.append(f"{SET}: expected what {WITHDRAWN} says was withdrawn, got {published.get('withdrawn')}")
    for part in ("searches", "rows", "primary", *(["contrasts"] if "contrasts" in found else [])):
        there = published.get(part, [])
        if len(there) != len(found[part]):
            wrong.append(f"{SET}, {part}: expected {len(found[part])}, got {len(there)}")
        for said, again in zip(there, found[part], strict=False):
            for name, value in again.items():
                count += 1
                if not _equal(said.get(name), value):
                    wrong.append(f"{SET}, {part}, {name}: published {said.get(name)!r}, computed {value!r}")
    return count, wrong


def _equal(said: Any, again: Any) -> bool:
    """Numbers may differ in the last bits between machines."""
    if isinstance(said, float) and isinstance(again, float):
        return bool(np.isclose(said, again, rtol=1e-9, atol=1e-12))
    if isinstance(said, dict) and isinstance(again, dict):
        return said.keys() == again.keys() and all(_equal(said[key], again[key]) for key in said)
    if isinstance(said, list) and isinstance(again, list):
        return len(said) == len(again) and all(map(_equal, said, again))
    return bool(said == again)


__all__ = ["DIGESTS", "SET", "SetError", "Verified", "sets_in", "verify_set", "write_numbers", "write_set"]
