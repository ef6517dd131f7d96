"""Plans the order of runs: blocks of all conditions in random but balanced order, fixed before the first run.

Each block contains every condition once, so that a discharging battery or changing light affects all conditions alike. Across blocks,
the order follows a Williams design (E. J. Williams 1949, "Experimental designs balanced for the estimation of residual effects of
treatments"): after as many blocks as it has rows, every condition has been at every position, and after every other, equally often.
"""

from __future__ import annotations

import json
import random
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from advnerf_core.attack.artifact import load_attack
from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from nodes.runtime.errors import RuntimeFault

PLAN_NAME = "plan.json"
NONE = "none"


class CampaignError(RuntimeFault, ValueError):
    """A folder of trials does not fit the request, or a run was invalid."""


@dataclass(frozen=True)
class PlannedDrive:
    """One planned drive.

    Attributes:
        number: Position in the order, from 1.
        condition: ``none``, or the name of a group of attack files.
        repeat: Index among the condition's runs, from 0.
        attack: Attack file; empty for none.
    """

    number: int
    condition: str
    repeat: int
    attack: str = ""
    attack_id: str = ""

    @property
    def name(self) -> str:
        """Name of the run's folder and result file."""
        return f"{self.number:03d}_{self.condition}_{self.repeat}"


def williams_rows(count: int) -> list[list[int]]:
    """Rows of a Williams design of ``count`` treatments: ``count`` rows if ``count`` is even, twice as many if it is odd."""
    first = [
        0,
        *(value for pair in zip(range(1, count), range(count - 1, 0, -1), strict=True) for value in pair),
    ][:count]
    rows = [[(value + shift) % count for value in first] for shift in range(count)]
    return rows if count % 2 == 0 else rows + [row[::-1] for row in rows]


def make_order(conditions: list[str], repeats: int, seed: int) -> list[tuple[str, int]]:
    """Condition and repeat of every run, in driving order. Deterministic across machines."""
    if repeats < 1 or len(set(conditions)) != len(conditions) or not conditions:
        raise CampaignError(
            f"expected different conditions and at least one repeat, got {conditions} and {repeats}"
        )
    draw = random.Random(seed)
    labels = draw.sample(conditions, len(conditions))
    order: list[tuple[str, int]] = []
    rows: list[list[int]] = []
    for repeat in range(repeats):
        if not rows:
            rows = williams_rows(len(labels))
            draw.shuffle(rows)
        order += [(labels[index], repeat) for index in rows.pop()]
    return order


@dataclass(frozen=True)
class TrialsPlan:
    """The plan, which is fixed before the first run.

    Attributes:
        overrides: ``node.key=value`` and ``params.name=value``.
        ticks: Control ticks of each drive, at 10 Hz.
        start_pose: Start pose of each drive: x [m], y [m], yaw [rad].
        policy_sha256: Hash of the policy file; empty if the launch file names none.
        host: Host of the launch file that drives the trials; None if it has no hosts.
    """

    launch: str
    overrides: tuple[str, ...]
    seed: int
    ticks: int
    start_pose: tuple[float, float, float]
    room_sha256: str
    policy_sha256: str
    runs: tuple[PlannedDrive, ...]
    host: str | None = None


def make_runs(attacks: dict[str, list[Path]], repeats: int, seed: int) -> tuple[PlannedDrive, ...]:
    """Make all runs, in order. The attack files of a condition alternate.

    Args:
        attacks: Attack files of each condition besides ``none``.
    """
    ids = {str(file): load_attack(file).attack_id for files in attacks.values() for file in files}
    runs = []
    for number, (condition, repeat) in enumerate(make_order([NONE, *attacks], repeats, seed), start=1):
        file = str(attacks[condition][repeat % len(attacks[condition])]) if condition != NONE else ""
        runs.append(PlannedDrive(number, condition, repeat, file, ids.get(file, "")))
    return tuple(runs)


def keep_plan(folder: Path, plan: TrialsPlan) -> None:
    """Write the plan to a new folder, or check that it equals the folder's plan.

    Raises:
        CampaignError: The folder belongs to other trials. The message names the differences.
    """
    file, text = folder / PLAN_NAME, json.dumps(asdict(plan), indent=1) + "\n"
    if not file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(file, text)
        return
    then, now = _read(file), json.loads(text)
    changed = [key for key in now if then.get(key) != now[key]]
    if changed:
        raise CampaignError(
            f"{folder} has trials with another {', '.join(changed)}, and the settings of a series cannot change; give another --folder"
        )


def finished(folder: Path, plan: TrialsPlan) -> dict[str, dict[str, Any]]:
    """Results of the finished runs, by name."""
    return {
        run.name: _read(folder / f"{run.name}.json")
        for run in plan.runs
        if (folder / f"{run.name}.json").exists()
    }


def _read(file: Path) -> dict[str, Any]:
    try:
        data = read_json(file)
    except (OSError, ValueError) as error:
        raise CampaignError(f"cannot read {file}: {error}; remove it to drive that run again") from None
    if not isinstance(data, dict):
        raise CampaignError(f"expected keys and values in {file}, got {type(data).__name__}")
    return data
