"""The last part of an audit: the chosen attack is driven from unused starts, beside the controls, and filmed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from advnerf_core.attack.artifact import face_texture, load_attack
from advnerf_core.geometry import Array, planar_poses
from advnerf_core.policies.network import tensor_to_images
from advnerf_core.report.audit_result import (
    AuditControl,
    AuditedDrives,
    Control,
    ControlKind,
    DisturbedDrives,
    Evidence,
    JudgedStart,
    RoutePoint,
)
from advnerf_core.report.clips import ClipTrack, write_film
from advnerf_core.report.data import Film
from advnerf_core.scene.surrogate import Surrogate
from hardware.worlds.world import World
from nodes.audit.drives import (
    FOUND,
    FOUND_DISTURBED,
    NO_OBJECT,
    PICTURE,
    PLAIN_DISTURBED,
    PLAIN_OBJECT,
    Arm,
    arm_of,
    camera_effects,
    driven,
    learned,
    with_starts,
)
from nodes.audit.verdict import ArmDrives, EffectJudgement, change_of, effect_of, judge
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.learned_scene import load_background
from nodes.experiment.show.placing import clean_poses
from nodes.experiment.show.spaces import dress, shown_there
from nodes.experiment.steps.films import filmed
from nodes.runtime.progress import Report

CONTROLS: tuple[Control, ...] = ("no_object", "plain_object")
WORLD_ARMS = (NO_OBJECT, PLAIN_OBJECT, PICTURE, FOUND)
LEARNED_ARMS = (*WORLD_ARMS, PLAIN_DISTURBED, FOUND_DISTURBED)
FILMED = COMPARED = (NO_OBJECT, PLAIN_OBJECT, FOUND)
TITLES = {
    NO_OBJECT: "no object",
    PLAIN_OBJECT: "plain object",
    PICTURE: "a picture of the place",
    FOUND: "the object that was found",
    PLAIN_DISTURBED: "plain object, a worse camera",
    FOUND_DISTURBED: "the object that was found, a worse camera",
}
# Films and plots use the colours of conditions.
CONDITIONS = {NO_OBJECT: "empty", PLAIN_OBJECT: "none", PICTURE: "random", FOUND: "gradient"}


@dataclass(frozen=True, eq=False)
class Judged:
    """Result of judging one attack.

    Attributes:
        drives: Drives of each arm, by name.
        experiment: Experiment with the judging starts.
        limit_m: |CTE| beyond which the car has left its lane [m].
    """

    evidence: Evidence
    arms: Mapping[str, Arm]
    drives: Mapping[str, ArmDrives]
    judgement: EffectJudgement
    experiment: Experiment
    limit_m: float

    def controls(self) -> list[AuditControl]:
        """The drives without an attack."""
        return controls_of(self.evidence, self.drives, self.limit_m)

    @property
    def shown_start(self) -> int:
        """The start for pictures and films: the one with the median effect."""
        return _shown_start(self.drives[FOUND], self.drives[self.judgement.control])

    def as_result(self) -> AuditedDrives:
        """The same in the form of the audit's result."""
        dt_s = self.experiment.config.dt_s
        return AuditedDrives(
            evidence=self.evidence,
            measure="max_abs_cte",
            disturbed=self._disturbed(),
            path=_route(clean_poses(self.experiment, self.experiment.config.paths[0]), dt_s),
            **numbers_of(self.drives, self.limit_m, dt_s),
        )

    def _disturbed(self) -> DisturbedDrives | None:
        if FOUND_DISTURBED not in self.drives:
            return None
        effects = camera_effects(self.limit_m, self.experiment.config.measure.seed)
        return DisturbedDrives(
            noise=effects.noise,
            gain=effects.gain,
            brightness=effects.brightness,
            jitter_m=effects.jitter_m,
            jitter_rad=effects.jitter_rad,
            **disturbed_numbers_of(self.drives, self.limit_m),
        )


def judgement_of(drives: Mapping[str, ArmDrives], limit_m: float) -> EffectJudgement:
    """The judgement of the drives of all arms; the car has left its lane beyond a |CTE| of ``limit_m`` [m]."""
    return judge(drives[FOUND], {name: drives[name] for name in CONTROLS}, limit_m)


def numbers_of(drives: Mapping[str, ArmDrives], limit_m: float, dt_s: float) -> dict[str, Any]:
    """The fields of `AuditedDrives` that follow from the drives of all arms: control, effect, starts and route."""
    judgement = judgement_of(drives, limit_m)
    found, control = drives[FOUND], drives[judgement.control]
    starts = tuple(
        JudgedStart(
            x_m=start[0],
            y_m=start[1],
            yaw_rad=start[2],
            off_path_m=float(found.largest_m[number]),
            control_off_path_m=float(control.largest_m[number]),
            off_track=bool(found.left(limit_m)[number]),
            control_off_track=bool(control.left(limit_m)[number]),
        )
        for number, start in enumerate(found.states[:, 0, :3].tolist())
    )
    route = _route(found.states[_shown_start(found, control)], dt_s)
    return {"control": judgement.control, "effect": judgement.effect, "starts": starts, "route": route}


def disturbed_numbers_of(drives: Mapping[str, ArmDrives], limit_m: float) -> dict[str, Any]:
    """The fields of `DisturbedDrives` that follow from the drives under a worse camera."""
    found, plain = drives[FOUND_DISTURBED], drives[PLAIN_DISTURBED]
    return {
        "effect": effect_of(found, plain),
        "off_track": int(found.left(limit_m).sum()),
        "plain_off_track": int(plain.left(limit_m).sum()),
    }


def controls_of(evidence: Evidence, drives: Mapping[str, ArmDrives], limit_m: float) -> list[AuditControl]:
    """The drives without an attack in the form of the audit's result."""
    return [
        AuditControl(
            kind=kind,
            name=TITLES[kind],
            evidence=evidence,
            mean_off_path_m=float(drives[kind].largest_m.mean()),
            off_track=int(drives[kind].left(limit_m).sum()),
            starts=len(drives[kind].largest_m),
        )
        for kind in get_args(ControlKind)
    ]


def comparison_of(
    now: Mapping[str, ArmDrives], then: Mapping[str, ArmDrives], limit_m: float
) -> dict[str, Any]:
    """The fields of `AuditComparison` that follow from drives of the same arms; the lane ends at a |CTE| of ``limit_m`` [m]."""
    changes = {name: change_of(now[name], then[name], len(COMPARED)) for name in COMPARED}
    past = max(changes, key=lambda name: changes[name].low_m)
    return {
        "past": past,
        "effect": changes[past],
        "off_track_alone": int(now[NO_OBJECT].left(limit_m).sum()),
        "off_track_alone_then": int(then[NO_OBJECT].left(limit_m).sum()),
    }


def _shown_start(found: ArmDrives, control: ArmDrives) -> int:
    differences = found.largest_m - control.largest_m
    return int(np.argsort(differences, kind="stable")[len(differences) // 2])


def _route(poses: Array, dt_s: float) -> tuple[RoutePoint, ...]:
    return tuple(
        RoutePoint(t_s=round(number * dt_s, 9), x_m=x, y_m=y, yaw_rad=yaw)
        for number, (x, y, yaw) in enumerate(np.asarray(poses)[:, :3].tolist())
    )


def judge_found(
    experiment: Experiment,
    found: Path,
    count: int,
    seed: int,
    limit_m: float,
    evidence: Evidence,
    report: Report,
) -> Judged:
    """Drive past the attacked object, and past the controls, from so many judging starts of a seed.

    The car has left its lane beyond a |CTE| of ``limit_m`` [m].
    """
    with_them = with_starts(experiment, count, seed)
    arms = {name: arm_of(with_them, name, found) for name in WORLD_ARMS}
    if evidence == "surrogate":
        effects = camera_effects(limit_m, seed)
        arms[PLAIN_DISTURBED] = replace(arms[PLAIN_OBJECT], disturbances=effects)
        arms[FOUND_DISTURBED] = replace(arms[FOUND], disturbances=effects)
    drives = drive_arms(with_them, arms, evidence, report)
    return Judged(evidence, arms, drives, judgement_of(drives, limit_m), with_them, limit_m)


def drive_arms(
    experiment: Experiment, arms: Mapping[str, Arm], evidence: Evidence, report: Report
) -> dict[str, ArmDrives]:
    """Drives of each arm from the measured starts; in the learned scene those of an arm advance together."""
    drives, count, total = {}, experiment.config.measure.starts, len(arms) * experiment.config.measure.starts
    with open_world(experiment, evidence) as world:
        for number, (name, arm) in enumerate(arms.items()):
            told = partial(_tell, report, TITLES[name], number * count, total)
            if world is None:
                drives[name] = learned(experiment, arm)
                told(count)
            else:
                drives[name] = driven(experiment, arm, world, told)
    return drives


def _tell(report: Report, title: str, before: int, total: int, done: int) -> None:
    report((before + done) / total, f"{before + done} of {total} drives, {title}")


@contextmanager
def open_world(experiment: Experiment, evidence: Evidence) -> Iterator[World | None]:
    """The open world of the drives; None for drives in the learned scene."""
    if evidence == "surrogate":
        yield None
        return
    with experiment.open_deployed_world() as world:
        yield world


def film(judged: Judged, file: Path, report: Report) -> Film:
    """The drives past no object, the plain one and the attacked one, side by side, from the shown start."""
    experiment, tracks = judged.experiment, []
    every, rate_hz = filmed(experiment.config.dt_s)
    path = experiment.paths[experiment.config.paths[0]]
    with open_world(experiment, judged.evidence) as world:
        for name in FILMED:
            states = judged.drives[name].states[judged.shown_start][::every]
            frames = seen_on(experiment, judged.arms[name], states, world)
            cte_m = path.project(states[:, :2]).cte_m
            tracks.append(ClipTrack(TITLES[name], CONDITIONS[name], frames, cte_m))
            report(len(tracks) / len(FILMED), f"filmed past {TITLES[name]}")
    return write_film(file, tracks, rate_hz, judged.limit_m)


def seen_on(experiment: Experiment, arm: Arm, states: Array, world: World | None) -> list[NDArray[np.uint8]]:
    """The driving camera's pictures ``[H, W, 3]`` from car states ``[N, 3]``; from the learned scene without a world."""
    if world is None:
        whole = Surrogate(load_background(experiment), experiment.camera, experiment.mount, arm.shown.objects)
        colours = arm.shown.colours if arm.shown.objects else None
        poses = planar_poses(np.asarray(states, dtype=np.float64)) @ experiment.mount
        return [tensor_to_images(whole.render(pose[None], colours).images)[0] for pose in poses]
    dressed = dress(experiment, world, arm.shown)
    attack = None if arm.attack is None else load_attack(arm.attack)
    colours = shown_there(experiment, arm.shown, attack)
    return [dressed.camera_image(state, colours) for state in states]


def texture_of(found: Path) -> NDArray[np.uint8] | None:
    """The picture ``[H, W, 3]`` of an attacked panel; None for other objects."""
    theta = load_attack(found).objects[0].theta
    return face_texture(theta) if theta.ndim == 3 else None
