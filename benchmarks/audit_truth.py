"""Do audits tell the truth? Many judgements of one object whose effect is known, and policies that were made worse by known amounts.

An audit finds an object in a small place (`tests.support.circle_place`). It is then judged again and again, from 20 fresh starts each; the truth is its
effect over all of these starts. ``--against`` is asked in the same groups, of the unchanged policy and of planted regressions.
``python -m benchmarks.audit_truth``.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from advnerf_core.run_module import search_folder_last
from benchmarks.results import record_row
from nodes.audit.comparing import ATTACK_KEPT, MARGIN
from nodes.audit.drives import FOUND, NO_OBJECT, PLAIN_OBJECT, Arm, arm_of, learned, with_starts
from nodes.audit.judging import CONTROLS
from nodes.audit.learning import OTHER_HALF
from nodes.audit.question import FILE
from nodes.audit.verdict import ArmDrives, change_of, judge
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.victims import look_at_given
from nodes.experiment.steps.run import load_experiment
from tests.support.circle_place import CHANGES, LIMIT_M, audit, make_folder

COMMAND = "python -m benchmarks.audit_truth"
GROUPS, STARTS, FIRST_SEED = 120, 20, 1_000_000
COMPARED = 60
BIASES_RAD = (0.0025, 0.005, 0.01, 0.02)
_ARMS = (NO_OBJECT, PLAIN_OBJECT, FOUND)


def experiment_of(folder: Path, policy: str) -> Experiment:
    """The judged copy with the object that the audit found, for a policy ``module:factory``."""
    file = folder / "seduced" / FILE
    changed = file.with_name(f"{policy.replace(':', '_')}.experiment.yaml")
    changed.write_text(file.read_text().replace("drivers:seduced", policy))
    setting = (folder / "seduced" / "best").read_text()
    arguments = (
        changed,
        setting,
        ["world.half=odd", "scene.seed=1", *CHANGES],
        folder / "seduced" / OTHER_HALF,
    )
    look_at_given(load_experiment(*arguments))
    return load_experiment(*arguments)


def groups_of(experiment: Experiment, folder: Path, count: int) -> list[dict[str, ArmDrives]]:
    """Drives past nothing, the plain object and the one that was found, from the starts of each group."""
    arms = {name: arm_of(experiment, name, folder / "seduced" / ATTACK_KEPT) for name in _ARMS}
    return [_group(experiment, arms, number) for number in range(count)]


def _group(experiment: Experiment, arms: dict[str, Arm], number: int) -> dict[str, ArmDrives]:
    there = with_starts(experiment, STARTS, FIRST_SEED + number)
    return {name: learned(there, arm) for name, arm in arms.items()}


def joined(groups: list[dict[str, ArmDrives]], name: str) -> ArmDrives:
    """The drives of all groups as one."""
    first = groups[0][name]
    fields = ("states", "largest_m", "mean_m", "driven_ticks")
    return replace(
        first, **{field: np.concatenate([getattr(each[name], field) for each in groups]) for field in fields}
    )


def record_coverage(groups: list[dict[str, ArmDrives]]) -> None:
    """How often the interval holds the truth, and how wide it is."""
    judged = [judge(each[FOUND], {name: each[name] for name in CONTROLS}, LIMIT_M) for each in groups]
    everything = judge(joined(groups, FOUND), {name: joined(groups, name) for name in CONTROLS}, LIMIT_M)
    truth_m = everything.effect.mean_m
    held = sum(each.effect.low_m <= truth_m <= each.effect.high_m for each in judged)
    half_m = float(np.median([0.5 * (each.effect.high_m - each.effect.low_m) for each in judged]))
    share = 100.0 * held / len(judged)
    record_row(
        "audits of known truth: intervals that hold it",
        round(share, 1), "%", "90 to 99 %", 90.0 <= share <= 99.0, COMMAND,
        f"{len(judged)} judgements of one object from {STARTS} fresh starts each; truth {truth_m:.3f} m, the mean over all {len(judged) * STARTS} starts; "
        f"found in {sum(each.found for each in judged)}",
    )  # fmt: skip
    record_row(
        "audits of known truth: median half width of the interval, of the effect",
        round(100.0 * half_m / truth_m, 1), "%", "<= 25 %", half_m <= 0.25 * truth_m, COMMAND, f"{half_m:.3f} m of {truth_m:.3f} m",
    )  # fmt: skip


def alarms(now: list[dict[str, ArmDrives]], then: list[dict[str, ArmDrives]]) -> int:
    """In how many groups ``--against`` says that the policy is worse."""
    count = 0
    for new, old in zip(now, then, strict=False):
        changes = [change_of(new[name], old[name], len(_ARMS)) for name in _ARMS]
        count += max(each.low_m for each in changes) > MARGIN * LIMIT_M
    return count


def main() -> None:
    """Command line."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_folder(folder)
        ended = audit(folder, "seduced")
        print(ended.stdout + ended.stderr, flush=True)
        assert ended.returncode == 1, "the audit finds what red does to this policy"
        best = next(line.split()[1] for line in ended.stdout.splitlines() if line.startswith("judging "))
        (folder / "seduced" / "best").write_text(best)
        sys.path.append(str(folder))
        search_folder_last(str(folder))
        groups = groups_of(experiment_of(folder, "drivers:seduced"), folder, GROUPS)
        record_coverage(groups)
        then = groups[:COMPARED]
        same = alarms(groups_of(experiment_of(folder, "drivers:seduced"), folder, COMPARED), then)
        record_row(
            "audit --against, unchanged policy: alarms", same, f"of {COMPARED}", "0", same == 0, COMMAND,
            "groups of 20 starts; the same starts give the same drives",
        )  # fmt: skip
        _record_regressions(folder, then)


def _record_regressions(folder: Path, then: list[dict[str, ArmDrives]]) -> None:
    text = (folder / "drivers.py").read_text()
    named = {f"bias_{1e4 * bias:.0f}": bias for bias in BIASES_RAD}
    text += "".join(f"\ndef {name}():\n    return biased({bias})\n" for name, bias in named.items())
    (folder / "regressions.py").write_text(text)
    found = {}
    for policy in (*named, "swapped", "late"):
        there = experiment_of(folder, f"regressions:{policy}")
        found[policy] = alarms(groups_of(there, folder, COMPARED), then)
        print(policy, found[policy], flush=True)
    smallest = next((bias for name, bias in named.items() if found[name] >= 0.95 * COMPARED), None)
    record_row(
        "audit --against: smallest bias of the steering that 95 % of audits find",
        smallest if smallest is not None else max(BIASES_RAD), "rad", "reported", None, COMMAND,
        "; ".join(f"{bias:g} rad: {found[name]} of {COMPARED}" for name, bias in named.items())
        + ("" if smallest is not None else "; none of these was found in 95 %"),
    )  # fmt: skip
    for policy, what in (("swapped", "BGR for RGB"), ("late", "one tick of lag")):
        share = found[policy] / COMPARED
        record_row(
            f"audit --against: {what}, audits that find it", found[policy], f"of {COMPARED}", "reported", None, COMMAND,
            "a policy that holds its line by a constant and is led astray by red alone" + ("; it is worse in neither sense" if share == 0 else ""),
        )  # fmt: skip


if __name__ == "__main__":
    main()
