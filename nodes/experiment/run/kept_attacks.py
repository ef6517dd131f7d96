"""Attacks that are published with their cells: the attack of each search, once, as it was deployed.

Textures of many objects are large. Of those only the ones of claimed methods are published; `redrive` searches for the others again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from advnerf_core.attack.artifact import AttackFile, AttackFileError, load_attack, save_attack
from advnerf_core.report.cells import CellResult, read_cell
from advnerf_core.report.evidence.registration import read_registration
from advnerf_core.report.evidence.verify import Verified
from nodes.experiment.engine.run_folder import ATTACK, THETA
from nodes.experiment.run.store import CellStatus, Store
from nodes.experiment.show.context import Experiment

FOLDER = "attacks"
# A larger attack is published only if its set claims something about its method.
SMALL_BYTES = 100_000


def is_published_with_its_attack(cell: CellResult) -> bool:
    """Whether a cell's attack must be published with it; cells from before textures were rounded have none."""
    return cell.attack_id is not None and cell.extra.get("theta") == THETA


def attack_file(folder: Path, attack_id: str) -> Path:
    """File of an attack, by its short hash, in the folder of a published set."""
    return folder / FOLDER / f"{attack_id}.safetensors"


def publish_attacks(experiment: Experiment, found: Sequence[CellStatus], folder: Path) -> list[Path]:
    """Copy the attacks of finished cells that this machine has into the folder of a published set; returns the new files there."""
    written, claimed = [], _claimed(folder)
    for each in found:
        if each.state != "done" or each.result is None or not is_published_with_its_attack(each.result):
            continue
        attack_id = str(each.result.attack_id)
        target = attack_file(folder, attack_id)
        source = next((file for file in _sources(experiment, each) if _id_of(file) == attack_id), None)
        if source is None or target.exists():
            continue
        attack = load_attack(source)
        if _bytes(attack) <= SMALL_BYTES or _is_of(each.result, claimed):
            save_attack(target, attack, small=True)
            written.append(target)
    return written


def attack_problems(folder: Path) -> Iterator[str]:
    """Problems of a published set's attacks, as text.

    Cells from before attacks were published have none.
    """
    used, claimed = set(), _claimed(folder)
    for file in sorted(folder.glob("*.json")):
        cell = read_cell(file)
        if is_published_with_its_attack(cell):
            used.add(str(cell.attack_id))
            attack = attack_file(folder, str(cell.attack_id))
            if attack.exists() or _is_of(cell, claimed):
                yield from _problems_of(cell, attack)
    for file in sorted((folder / FOLDER).glob("*")):
        if file.stem not in used:
            yield f"{file}: no cell was driven with this attack"


def with_attacks(verified: Verified, folder: Path) -> Verified:
    """The result of verifying a set, with the problems of its attacks."""
    if verified.problems:  # cells that cannot be read show nothing about attacks
        return verified
    return replace(verified, problems=tuple(attack_problems(folder)))


def _claimed(folder: Path) -> set[str]:
    """Methods that a set's registration claims something about; none if nothing is registered or claimed."""
    registration = read_registration(folder)
    if registration is None:
        return set()
    return {each.method for each in registration.primary} | {each.method for each in registration.claims}


def _is_of(cell: CellResult, methods: set[str]) -> bool:
    """Whether a cell is of one of these methods; of none is every cell."""
    return not methods or cell.method in methods


def _bytes(attack: AttackFile) -> int:
    """Size of its textures in half precision."""
    return sum(2 * each.theta.size for each in attack.objects)


def _problems_of(cell: CellResult, file: Path) -> Iterator[str]:
    try:
        attack = load_attack(file)
    except AttackFileError as error:
        yield f"{cell.name}: {error}"
        return
    wanted = (cell.attack_id, cell.policy_sha256, cell.method, cell.seed)
    if wanted != (got := (attack.attack_id, attack.policy_sha256, attack.method, attack.seed)):
        yield f"{cell.name}: expected attack, victim, method and seed {wanted} in {file}, got {got}"


def _sources(experiment: Experiment, found: CellStatus) -> list[Path]:
    """Possible files of a cell's attack: beside the cell's result, or in the run folder of its variant."""
    own = [Store(experiment.folder).work(found.cell.name)]
    if found.file is not None:
        own.append(found.file.with_suffix(""))
    own.append(Store(experiment.folder_of(found.cell)).work(found.cell.inside.name))
    return [folder / ATTACK for folder in own]


def _id_of(file: Path) -> str | None:
    try:
        return load_attack(file).attack_id
    except AttackFileError:
        return None
