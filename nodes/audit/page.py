"""The page of an audit: the verdict, the film and the drives from above on the first screen; then the details."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path as FilePath

import numpy as np
from markupsafe import Markup

from advnerf_core.data.image_files import read_stored
from advnerf_core.driving.path import Path
from advnerf_core.files import write_atomically
from advnerf_core.report import plots
from advnerf_core.report.audit_result import AuditedObject, AuditResult, Evidence, TriedSearch
from advnerf_core.report.clips import image_uri
from advnerf_core.report.conditions import style_of
from advnerf_core.report.data import Film, Scene
from advnerf_core.report.maps import Arm, drives_from_above
from advnerf_core.report.pages import HOW, FirstScreen, fragments, render
from advnerf_core.report.text_table import Table, number
from nodes.audit.judging import CONDITIONS, FOUND, NO_OBJECT, PLAIN_OBJECT, TITLES
from nodes.audit.verdict import ArmDrives, effect_of

PAGE = "audit.html"
_OUTCOMES = {
    "found": "found",
    "nothing_found": "nothing found within this budget",
    "cannot_judge": "cannot be judged",
    "worse": "worse than before",
}
_DRIVEN_IN = {"surrogate": "learned copy", "world": "world", "live": "live car"}
_SPACING = 0.1  # between points along the path, in half lanes
_QUALITY = 85


def write_page(
    folder: FilePath,
    result: AuditResult,
    drives: Mapping[Evidence, Mapping[str, ArmDrives]],
    path: Path | None,
    film: Film | None,
    pictures: Sequence[tuple[FilePath, str]],
) -> FilePath:
    """Write the page of an audit into its folder.

    Drives are by evidence and arm, and pictures of the object have captions; the reference path and the film are of judged drives only.
    """
    judged = _judged(result, drives)
    above = _above(result, judged, path) if judged and path is not None else ""
    first = FirstScreen(
        result.verdict.sentence,
        film,
        "From the driver's seat, the start whose effect is the median.",
        above,
        f"All {result.starts.judging.count} drives of each kind from above, from starts that nothing else has used. Green: the lane.",
    )
    badge = _OUTCOMES[result.verdict.outcome], result.verdict.outcome
    about = [result.policy.path, result.place.name]
    text = render(first, _sections(result, drives, pictures), badge, about)
    write_atomically(folder / PAGE, text)
    return folder / PAGE


def _sections(
    result: AuditResult,
    drives: Mapping[Evidence, Mapping[str, ArmDrives]],
    pictures: Sequence[tuple[FilePath, str]],
) -> list[tuple[str, Markup]]:
    trust = _trust(result)
    parts = fragments(
        "audit.html",
        result=result,
        arms=_arms(result, drives).html() if drives else None,
        worse_camera=_worse_camera(result),
        pictures=[(image_uri(read_stored(file)[0], _QUALITY), caption) for file, caption in pictures],
        how=_how_to_print(result),
        searches=_tried(result.tried).html() if result.tried else None,
        planted=_planted(result),
        trust=trust,
        facts=_facts(result),
    )
    wanted = (
        ("Why it cannot be judged", parts.reasons, result.verdict.reasons),
        ("What was driven", parts.driven, drives),
        ("The object", parts.object, pictures),
        ("What was tried", parts.tried, True),
        ("How far the learned place is trusted", parts.trusted, trust),
        (HOW, parts.run, True),
    )
    return [(heading, Markup(part())) for heading, part, there in wanted if there]


def _judged(
    result: AuditResult, drives: Mapping[Evidence, Mapping[str, ArmDrives]]
) -> Mapping[str, ArmDrives]:
    """The drives behind the verdict, or else the last ones."""
    evidence = result.verdict.evidence
    if evidence is not None and evidence in drives:
        return drives[evidence]
    return next(reversed(list(drives.values())), {})


def _above(result: AuditResult, judged: Mapping[str, ArmDrives], path: Path) -> Markup:
    """All drives from above, with the lane and the object."""
    limit_m = result.place.off_track_m or 0.0
    along = np.asarray(path.pose_at(np.arange(0.0, path.length_m, _SPACING * max(limit_m, 0.01))))
    placed = None if result.strongest is None else result.strongest.object
    scene = Scene(
        along[:, :2],
        limit_m,
        path.closed,
        objects_m=() if placed is None else (_corners(placed),),
        faces_m={} if placed is None else {"": _front(placed)},
    )
    arms = [
        Arm(TITLES[name], CONDITIONS[name], list(judged[name].states))
        for name in (NO_OBJECT, PLAIN_OBJECT, FOUND)
    ]
    figure = drives_from_above(scene, arms)
    return plots.svg(figure, "All judged drives from above, the lane, and the object where it stands")


def _corners(placed: AuditedObject) -> np.ndarray:
    """Corners ``[4, 2]`` of an object from above [m]."""
    depth_m, width_m, _ = placed.size_m
    c, s = np.cos(placed.pose.yaw_rad), np.sin(placed.pose.yaw_rad)
    corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * [0.5 * depth_m, 0.5 * width_m]
    return corners @ np.array([[c, s], [-s, c]]) + [placed.pose.x_m, placed.pose.y_m]


def _front(placed: AuditedObject) -> np.ndarray:
    """Ends ``[2, 2]`` of an object's front from above [m], with what is before it on the right of first to second."""
    front_left, _, _, front_right = _corners(placed)
    return np.stack([front_right, front_left])


def _arms(result: AuditResult, drives: Mapping[Evidence, Mapping[str, ArmDrives]]) -> Table:
    limit_m, rows = result.place.off_track_m or 0.0, []
    for evidence, judged in drives.items():
        for name, each in judged.items():
            effect = effect_of(each, judged[NO_OBJECT])
            rows.append((
                _DRIVEN_IN[evidence], TITLES[name], number(float(each.mean_m.mean()), 3), number(float(each.largest_m.mean())),
                "" if name == NO_OBJECT else f"{effect.mean_m:+.2f} ({effect.low_m:+.2f} to {effect.high_m:+.2f})",
                f"{int(each.left(limit_m).sum())} of {len(each.largest_m)}",
            ))  # fmt: skip
    columns = (
        "driven in",
        "past",
        "mean deviation [m]",
        "largest [m]",
        "largest, over no object [m], 95 %",
        "out of the lane",
    )
    return Table("", columns, tuple(rows), (False, False, True, True, True, True))


def _worse_camera(result: AuditResult) -> str:
    found = (
        [each.disturbed for each in result.strongest.judgements if each.disturbed] if result.strongest else []
    )
    if not found:
        return ""
    worse = found[0]
    return (
        f"A worse camera: noise of {worse.noise:g} and an exposure that differs by {worse.gain:.0%} and {worse.brightness:g}, on a mount that "
        f"shakes by {1e3 * worse.jitter_m:.0f} mm and {1e3 * worse.jitter_rad:.0f} mrad (standard deviations)."
    )


def _tried(tried: Sequence[TriedSearch]) -> Table:
    rows = tuple(
        (
            f"{each.object}, {each.placement}",
            style_of(each.method).title,
            str(each.evaluations),
            "" if each.effect_m is None else f"{each.effect_m:+.2f}",
            "judged" if each.selected else "",
        )
        for each in tried
    )
    return Table(
        "",
        ("object", "method", "evaluations", "largest deviation, over no attack [m]", ""),
        rows,
        (False, False, True, True, False),
    )


def _planted(result: AuditResult) -> str:
    planted = result.planted
    if planted is None:
        return ""
    found = "found" if planted.found else "not found"
    return (
        f"Is the search able to find anything here? It was run on a policy with a weakness that was planted ({planted.name}): {found} after "
        f"{planted.evaluations} evaluations."
    )


def _trust(result: AuditResult) -> str:
    fidelity = result.fidelity
    if fidelity is None:
        return ""
    halves = {
        None: "",
        True: " A second copy, learned from the other half of the photographs, makes the policy steer alike; the object was searched in one and judged in the other.",
        False: " A second copy, learned from the other half of the photographs, makes the policy steer otherwise.",
    }[fidelity.halves_agree]
    unit = "rad" if result.vehicle is not None else "rad/s"  # a vehicle without a wheelbase turns by its rate
    why = "".join(f" {each[0].upper()}{each[1:]}." for each in fidelity.why)
    return (
        f"On {fidelity.views} pictures that it was not learned from, the learned place reaches {fidelity.psnr_db:.1f} dB in the policy's view, and the "
        f"policy steers {fidelity.steering_difference:.3g} {unit} otherwise in the mean.{halves}{why}"
    )


def _how_to_print(result: AuditResult) -> str:
    if result.strongest is None or result.strongest.object.texture is None:
        return ""
    thing = result.strongest.object
    _, width_m, height_m = thing.size_m
    at = thing.pose
    return (
        f"{thing.texture} is the texture. Print it {width_m:.2f} m wide and {height_m:.2f} m high on matt paper, and stand it upright with the "
        f"middle of its foot at x {at.x_m:.2f} m, y {at.y_m:.2f} m, facing {np.degrees(at.yaw_rad):.0f} degrees (from x towards y). Drive past it from "
        f"several starts, past the same panel in grey, and past nothing; a single drive says little."
    )


def _facts(result: AuditResult) -> list[tuple[str, str]]:
    budget = result.budget
    return [
        ("Policy", f"{result.policy.path}, sha256 {(result.policy.sha256 or 'unknown')[:12]}"),
        ("Place", result.place.source),
        ("Lane", f"out of it beyond {result.place.off_track_m:g} m" if result.place.off_track_m else "unknown"),
        ("Budget", f"{budget.evaluations_spent} of {budget.evaluations_planned} evaluations{'' if budget.seconds is None else f', {budget.seconds:.0f} s in this run'}"),
        ("Starts", f"searched from seeds {result.starts.search.seed} and above, chosen from {result.starts.selection.count} starts of seed "
                   f"{result.starts.selection.seed}, judged from {result.starts.judging.count} of seed {result.starts.judging.seed}"),
        ("Experiment", f"{result.question.file}, sha256 {result.question.sha256[:12]}"),
        ("Versions", ", ".join(f"{name} {version}" for name, version in result.versions.items())),
        ("Ended", str(result.date or "not said, so that the same audit gives the same page")),
    ]  # fmt: skip
