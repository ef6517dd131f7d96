"""Whether the published drives are possible drives of this car from the registered starts, with matching totals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from advnerf_core.geometry import wrap_angle
from advnerf_core.report.cells import CellResult
from advnerf_core.report.evidence.kept import KeptDrive
from advnerf_core.report.evidence.registration import RegisteredScenario
from advnerf_core.report.evidence.results import Evidence
from advnerf_core.report.reference import DOMAINS, Domain

# Published poses are rounded; a total of some hundred ticks then differs by less.
_TOTAL_TOLERANCE_M = 2e-3
# A set may be continued on another machine, where the control is driven again: its sums are taken in another order. 2.5 mm were seen.
_MACHINES_TOLERANCE_M = 0.05
# A surrogate drive begins at its start to the bit. Live, a car is put down with this accuracy [m, rad].
_SURROGATE_START, _DEPLOYED_START = (2e-5, 2e-5), (0.05, 0.1)
# An attack affects only the wheel angle: no step is longer than without attack, up to noise of motion capture.
_LONGEST_STEP = 1.25
# A rear axle rolls along the car's heading. Its tyres slip as far as without attack, a few times at most [rad].
_LEAST_SLIP_RAD: Mapping[Domain, float] = {"surrogate": 2e-3, "deployed": 1.5e-2}
_SLIP_RATIO = 3.0
_ROUNDING_M, _MOVING = 2e-5, 0.2


@dataclass(frozen=True)
class Motion:
    """Limits of a car's motion in a tick.

    Attributes:
        step_m: Longest distance between two poses [m].
        slip_rad: Largest angle between its motion and its heading [rad].
    """

    step_m: float
    slip_rad: float


def drive_problems(evidence: Evidence) -> Iterator[str]:
    """Whether each cell has one possible drive from each registered start in each domain, with matching totals."""
    able: dict[tuple[str, Domain], Motion] = {}
    for cell in evidence.cells.values():
        if not evidence.is_registered(cell) and cell.registration:
            continue  # reported already
        for domain in DOMAINS:
            yield from _in_domain(evidence, cell, domain, able)
        yield from _largest(evidence, cell)


def _in_domain(
    evidence: Evidence, cell: CellResult, domain: Domain, able: dict[tuple[str, Domain], Motion]
) -> Iterator[str]:
    """One cell in one domain; ``able`` caches the car's motion without attack, by name of that cell."""
    scenario = evidence.scenario_of(cell)
    count = len(scenario.starts) if domain == "surrogate" else scenario.deployed_starts
    kept, where = cell.kept.get(domain, ()), f"{cell.name}, {domain}"
    if len(kept) != count:
        yield f"{where}: expected drives from {count} registered starts, got {len(kept)}"
        return
    if len({drive.x_m + drive.y_m for drive in kept}) != len(kept):
        yield f"{where}: two drives are the same"
    try:
        yield from _starts(scenario, kept, domain, where)
        clean = evidence.without(cell)
        if clean is not None and clean.kept.get(domain):
            key = (clean.name, domain)
            able[key] = able.get(key) or _able(clean, domain)
            yield from _motion(cell, domain, able[key], where)
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
            continue
        off_m = float(np.hypot(*(poses[0, :2] - start[:2])))
        turned_rad = abs(float(wrap_angle(poses[0, 2] - start[2])))
        if off_m > near_m or turned_rad > near_rad:
            yield f"{where}, start {number}: begins {off_m:.3f} m and {turned_rad:.3f} rad from the registered start"


def _motion(cell: CellResult, domain: Domain, able: Motion, where: str) -> Iterator[str]:
    """Whether the motion is possible: no further in a tick than without attack, and along the car's heading."""
    for number, drive in enumerate(cell.kept[domain]):
        found = _moved(drive, able.step_m)
        if found.step_m > _LONGEST_STEP * able.step_m:
            yield f"{where}, start {number}: a step of {found.step_m:.3f} m, and without attack the car drives {able.step_m:.3f} m in a tick"
        elif found.slip_rad > able.slip_rad:
            yield f"{where}, start {number}: moves {found.slip_rad:.3f} rad off its heading, and the car slips {able.slip_rad:.3f} rad at most"


def _able(clean: CellResult, domain: Domain) -> Motion:
    """The car's motion without attack: the median over drives, so that one bad drive does not excuse the others."""
    longest_m = float(np.median([_moved(drive, 0.0).step_m for drive in clean.kept[domain]]))
    slip_rad = float(np.median([_moved(drive, longest_m).slip_rad for drive in clean.kept[domain]]))
    return Motion(longest_m, max(_LEAST_SLIP_RAD[domain], _SLIP_RATIO * slip_rad))


def _moved(drive: KeptDrive, longest_m: float) -> Motion:
    """The longest step of a drive until it stopped, and the largest slip of its steps that are a fifth of ``longest_m`` or more."""
    poses = drive.poses()[: drive.driven_ticks + 1]
    steps, turned = np.diff(poses[:, :2], axis=0), wrap_angle(np.diff(poses[:, 2]))
    lengths_m = np.hypot(*steps.T)
    heading = poses[:-1, 2] + turned / 2.0
    sideways_m = np.abs(steps[:, 1] * np.cos(heading) - steps[:, 0] * np.sin(heading))
    moving = lengths_m > max(_MOVING * longest_m, _ROUNDING_M)
    slip = np.maximum(sideways_m - _ROUNDING_M, 0.0)[moving] / lengths_m[moving]
    return Motion(float(lengths_m.max(initial=0.0)), float(slip.max(initial=0.0)))


def _totals(evidence: Evidence, cell: CellResult, domain: Domain, where: str) -> Iterator[str]:
    said = cell.drives(domain)
    if said is None:
        return
    clean = evidence.without(cell)
    none = {} if clean is None else dict(enumerate(evidence.metrics(clean, domain)))
    here = clean is None or clean.machine == cell.machine
    for number, found in enumerate(evidence.metrics(cell, domain)):
        control = none.get(number)
        apart_m = 0.0 if control is None else abs(said.none_total_cte_m[number] - control.total_cte_m)
        if abs(said.total_cte_m[number] - found.total_cte_m) > _TOTAL_TOLERANCE_M:
            yield f"{where}, start {number}: its total CTE is not that of its poses"
        elif apart_m > (_TOTAL_TOLERANCE_M if here else _MACHINES_TOLERANCE_M):
            yield f"{where}, start {number}: its total CTE without attack is not that of the control's poses"
        elif said.off_track[number] != found.off_track:
            yield f"{where}, start {number}: whether it left the track is not what its poses say"


def _largest(evidence: Evidence, cell: CellResult) -> Iterator[str]:
    """Whether a cell's further values of its deployed drives agree with the poses."""
    try:
        found = evidence.metrics(cell, "deployed")
    except ValueError:
        return  # reported already
    said_m = cell.extra.get("max_abs_cte_m")
    if said_m is not None and found:
        largest_m = max(each.max_cte_m for each in found)
        # NaN, and what is no number, are not near.
        if not isinstance(said_m, int | float) or not abs(largest_m - said_m) <= _TOTAL_TOLERANCE_M:
            yield f"{cell.name}: expected a largest |CTE| of {largest_m:.3f} m as its poses say, got {said_m!r}"
    blocked = cell.extra.get("blocked_tick")
    ended = [each.collided for each in cell.kept.get("deployed", ())]
    if blocked is not None and (
        not isinstance(blocked, list) or [each is not None for each in blocked] != ended
    ):
        yield f"{cell.name}: whether its drives ended against something is not what it says of them"
