"""Does ``advnerf verify`` find what somebody changed in a published set? ``python -m benchmarks.planted_changes [SET]``.

One change at a time is planted into a copy of the set: a digit, a file with its new digest in the manifest, a dropped drive, a cell
that was not registered, another victim, a drive from another start. The last four also renew the manifest and its digest, so that only
the registration and the drives themselves can tell.
"""

from __future__ import annotations

import argparse
import json
import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.driving.metrics import drive_metrics
from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.files import sha256_of
from advnerf_core.report.cells import cell_name
from advnerf_core.report.evidence.about import ABOUT
from advnerf_core.report.evidence.kept import KeptDrive
from advnerf_core.report.evidence.page import film_of
from advnerf_core.report.evidence.registration import (
    FILE,
    PrimaryTest,
    RegisteredCell,
    RegisteredScenario,
    Registration,
)
from advnerf_core.report.evidence.verify import (
    DIGESTS,
    PAGE,
    SET,
    digests_of,
    sets_in,
    verify_set,
    write_set,
)
from benchmarks.results import record_row

PUBLISHED = Path("docs/results")
_RECORDED = 1000  # changes of a run that is recorded
Change = Callable[[Path, random.Random], None]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("set", nargs="?", help="a published set; else one of simulated drives")
    parser.add_argument("--changes", type=int, default=_RECORDED)
    arguments = parser.parse_args()
    with TemporaryDirectory() as work:
        original = Path(work) / "published" / (arguments.set or "simulated")
        if arguments.set:
            # All sets, as one page is of all of them.
            original.parent.mkdir()
            for name in sets_in(PUBLISHED):
                shutil.copytree(PUBLISHED / name, original.parent / name)
                if (film := PUBLISHED / film_of(name)).exists():
                    shutil.copy(film, original.parent / film.name)
            for beside in (DIGESTS, PAGE, ABOUT):
                shutil.copy(PUBLISHED / beside, original.parent / beside)
        else:
            write_simulated_set(original)
        began = time.perf_counter()
        clean = verify_set(original)
        seconds = time.perf_counter() - began
        assert not clean.problems, clean.problems
        missed = planted(original, arguments.changes, Path(work) / "changed")
    print(f"{arguments.changes} changes, missed: {missed or 'none'}; verified in {seconds:.2f} s")
    if arguments.changes != _RECORDED:
        return
    command = "python -m benchmarks.planted_changes" + f" {arguments.set}" * bool(arguments.set)
    which = f"the set {arguments.set}" if arguments.set else "a set of simulated drives"
    found = arguments.changes - sum(missed.values())
    note = f"{len(CHANGES)} kinds; missed: {missed or 'none'}"
    record_row(f"changes planted in {which} that verify finds", found, f"of {arguments.changes}", f"{arguments.changes}", not missed, command, note)  # fmt: skip
    record_row(f"verifying {which}", seconds, "s", "<= 60 s", seconds <= 60.0, command, f"{clean.numbers} numbers, {clean.drives} drives")  # fmt: skip


def planted(original: Path, count: int, work: Path, seed: int = 0) -> dict[str, int]:
    """Plant changes one at a time; how many of each kind were not found."""
    rng, kinds = random.Random(seed), list(CHANGES)
    missed: dict[str, int] = {}
    for number in range(count):
        kind = kinds[number % len(kinds)]
        shutil.rmtree(work, ignore_errors=True)
        folder = work / original.name
        shutil.copytree(original.parent, work)
        assert number or not verify_set(folder).problems, "the copy is as it was published"
        CHANGES[kind](folder, rng)
        if not verify_set(folder).problems:
            missed[kind] = missed.get(kind, 0) + 1
    return missed


def change_a_digit(folder: Path, rng: random.Random) -> None:
    """Another digit somewhere in the set."""
    file = rng.choice([*sorted(folder.glob("*.json")), folder / FILE, folder / SET])
    file.write_text(_other_digit(file.read_text(), rng))


def rehash_a_file(folder: Path, rng: random.Random) -> None:
    """Another digit in a cell, whose digest in the manifest is renewed."""
    file = rng.choice(sorted(folder.glob("*.json")))
    file.write_text(_other_digit(file.read_text(), rng))
    _renew_manifest(folder)


def drop_a_drive(folder: Path, rng: random.Random) -> None:
    """One drive fewer, with its totals."""
    file, data, domain, number = _some_drive(folder, rng)
    del data["kept"][domain][number]
    for name in ("total_cte_m", "off_track", "none_total_cte_m"):
        del data[domain][name][number]
    _put(folder, file, data)


def add_a_cell(folder: Path, rng: random.Random) -> None:
    """A search that was not registered and says that it was; in another's place or beside it."""
    file, data, _, _ = _some_drive(folder, rng)
    data["seed"] = 99
    _put(
        folder,
        file.with_name(f"{cell_name(data['scenario'], data['victim'], data['method'], 99)}.json"),
        data,
    )


def swap_the_victim(folder: Path, rng: random.Random) -> None:
    """Another policy than that of the other cells."""
    file, data, _, _ = _some_drive(folder, rng)
    if rng.random() < 0.5:
        data["policy_sha256"] = f"{rng.getrandbits(256):064x}"
    else:
        data["stages"] = {**data["stages"], "policy": f"{rng.getrandbits(256):064x}"}
    _put(folder, file, data)


def pick_a_start(folder: Path, rng: random.Random) -> None:
    """A drive from another start, moved by a decimetre or more, with consistent totals."""
    file, data, domain, number = _some_drive(folder, rng)
    registration = Registration.model_validate(read_json(folder / FILE))
    scenario = registration.scenarios[data["scenario"]]
    drive = KeptDrive.model_validate(data["kept"][domain][number])
    poses, turned = drive.poses(), rng.uniform(-np.pi, np.pi)
    poses[:, :2] += rng.uniform(0.1, 0.3) * np.array([np.cos(turned), np.sin(turned)])
    moved = KeptDrive.of(
        poses, drive.driven_ticks, np.array(drive.command.split(), float), drive.collided, drive.collided_with
    )
    found = moved.metrics(scenario.reference_path(), scenario.horizon)
    data["kept"][domain][number] = moved.model_dump()
    data[domain]["total_cte_m"][number] = found.total_cte_m
    data[domain]["off_track"][number] = found.off_track
    _put(folder, file, data)


CHANGES: dict[str, Change] = {
    "a digit": change_a_digit,
    "a file with its digest": rehash_a_file,
    "a dropped drive": drop_a_drive,
    "a cell that was not registered": add_a_cell,
    "another victim": swap_the_victim,
    "another start": pick_a_start,
}


def write_simulated_set(folder: Path, searches: int = 6, starts: int = 5, seed: int = 0) -> Path:
    """A registered set of drives about a square that leave it with an effect by method and some noise; returns its ``set.json``."""
    rng = np.random.default_rng(seed)
    registration = _registration(folder.name, searches, starts, rng)
    (folder / FILE).parent.mkdir(parents=True)
    (folder / FILE).write_text(registration.model_dump_json(indent=1) + "\n")
    scenario = registration.scenarios["track"]
    clean = [_drive(scenario, start, 0.0, rng) for start in scenario.starts]
    for cell in registration.cells:
        reach_m = {"none": 0.0, "random": 0.1, "gradient": 0.8}[cell.method]
        effect = reach_m * (1.0 + 0.2 * rng.standard_normal())
        drives = [
            each if cell.method == "none" else _drive(scenario, start, effect, rng)
            for start, each in zip(scenario.starts, clean, strict=True)
        ]
        _write_cell(folder, registration, cell, drives, clean)
    return write_set(folder)


def _registration(name: str, searches: int, starts: int, rng: np.random.Generator) -> Registration:
    path = DrivingPath.rounded_square(4.0, 1.0)
    poses = [path.pose_at(0.2) + 0.1 * rng.standard_normal(3) * [1, 1, 0.25] for _ in range(starts)]
    scenario = RegisteredScenario(
        settings_sha256="0" * 64,
        path=path.to_dict(),
        ticks=60,
        dt_s=0.1,
        off_track_m=0.4,
        held_cap_m=1.5,
        starts=tuple((float(x), float(y), float(yaw)) for x, y, yaw in poses),
        deployed_starts=starts,
        evaluations=50,
        space={},
        victims={},
        drives_well_mean_cte_m=0.08,
    )
    cells = [RegisteredCell(scenario="track", victim="hardened", method="none", seed=0)]
    cells += [
        RegisteredCell(scenario="track", victim="hardened", method=method, seed=seed)
        for method in ("random", "gradient")
        for seed in range(searches)
    ]
    test = PrimaryTest(scenario="track", victim="hardened", method="gradient", against=("random",))
    return Registration(
        name=name,
        file="simulated",
        setting="",
        date="2026-01-01T00:00:00+00:00",
        software_version="0",
        scenarios={"track": scenario},
        cells=tuple(cells),
        primary=(test,),
    )


def _drive(
    scenario: RegisteredScenario, start: tuple[float, float, float], effect_m: float, rng: np.random.Generator
) -> KeptDrive:
    """A drive that begins at its start, nears the path, and drifts off it by ``effect_m`` with noise."""
    path, time_s = scenario.reference_path(), np.linspace(0.0, 6.0, scenario.ticks + 1)
    along = path.pose_at(0.2 + 0.7 * time_s)
    begun = np.array(start) - along[0]
    poses = along + np.exp(-time_s)[:, None] * begun
    sideways = effect_m * (time_s / 6.0) ** 2 + 0.02 * np.cumsum(rng.standard_normal(len(time_s))) / 8.0
    sideways -= sideways[0]
    poses[:, 0] -= np.sin(along[:, 2]) * sideways
    poses[:, 1] += np.cos(along[:, 2]) * sideways
    return KeptDrive.of(poses, scenario.ticks, rng.uniform(-0.3, 0.3, scenario.ticks))


def _write_cell(
    folder: Path,
    registration: Registration,
    cell: RegisteredCell,
    drives: list[KeptDrive],
    clean: list[KeptDrive],
) -> None:
    scenario = registration.scenarios["track"]
    path = scenario.reference_path()
    found, none = (
        [drive_metrics(path, each.poses(), scenario.horizon, each.driven_ticks) for each in part]
        for part in (drives, clean)
    )
    totals = {
        "total_cte_m": [each.total_cte_m for each in found],
        "off_track": [each.off_track for each in found],
        "none_total_cte_m": [each.total_cte_m for each in none],
    }
    data = {
        **cell.model_dump(),
        "settings_hash": "0" * 64,
        "registration": registration.digest,
        "policy_sha256": "1" * 64,
        "stages": {"policy": "2" * 64},
        "seconds": 1.0,
        "machine": "simulated",
        "date": registration.date,
        "surrogate": totals,
        "deployed": totals,
        "kept": {domain: [each.model_dump() for each in drives] for domain in ("surrogate", "deployed")},
    }
    name = cell_name(cell.scenario, cell.victim, cell.method, cell.seed)
    (folder / f"{name}.json").write_text(json.dumps(data, indent=1) + "\n")


def _some_drive(folder: Path, rng: random.Random) -> tuple[Path, dict[str, Any], str, int]:
    file = rng.choice(sorted(folder.glob("*.json")))
    data: dict[str, Any] = read_json(file)
    domain = rng.choice(sorted(data["kept"]))
    return file, data, domain, rng.randrange(len(data["kept"][domain]))


def _put(folder: Path, file: Path, data: dict[str, Any]) -> None:
    """Write a cell, and renew the manifest and the digest of the set."""
    file.write_text(json.dumps(data, indent=1) + "\n")
    _renew_manifest(folder)
    known = read_json(folder.parent / DIGESTS)
    known[folder.name] = sha256_of(folder / SET)
    (folder.parent / DIGESTS).write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")


def _renew_manifest(folder: Path) -> None:
    manifest = read_json(folder / SET)
    manifest["files"] = digests_of(folder)
    (folder / SET).write_text(json.dumps(manifest, indent=1) + "\n")


def _other_digit(text: str, rng: random.Random) -> str:
    places = [place for place, letter in enumerate(text) if letter.isdigit()]
    place = rng.choice(places)
    other = rng.choice([digit for digit in "0123456789" if digit != text[place]])
    return text[:place] + other + text[place + 1 :]


if __name__ == "__main__":
    main()
