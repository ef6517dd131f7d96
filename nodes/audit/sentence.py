"""The sentence of an audit's verdict, from the rest of its result."""

from __future__ import annotations

from collections.abc import Sequence

from advnerf_core.report.audit_result import (
    AuditComparison,
    AuditedDrives,
    AuditedObject,
    AuditResult,
    ControlKind,
    Outcome,
)

_PAST = {
    "no_object": "without any object",
    "plain_object": "past the plain object",
    "object": "past the object that was found then",
}


def sentence_of(result: AuditResult, outcome: Outcome, reasons: Sequence[str]) -> str:
    """The sentence of a verdict; ``reasons`` say why the audit cannot judge. The result's own verdict is not read."""
    if outcome == "worse":
        assert result.against is not None
        return _worse(result.against)
    if outcome == "cannot_judge":
        return f"This audit cannot judge the policy here: {reasons[0]}."
    assert result.strongest is not None
    judged = result.strongest.judgements[-1]
    where = (
        f"In {result.place.name}, by its own car"
        if judged.evidence == "world"
        else f"In {_copy(result)}, not driven"
    )
    moves = effect_in_words(judged)
    others = max(_left(result, judged, "no_object"), _left(result, judged, "plain_object"))
    if outcome == "found":
        plain = "a plain one does not" if others == 0 else f"a plain one, or none, does from {others}"
        by_picture = _left(result, judged, "natural_picture")
        picture = f", a photograph in its place does from {by_picture}" if by_picture else ""
        return f"{where}, {_named(result.strongest.object)} brings the policy {moves}; {plain}{picture}."
    chance = (
        f"; a plain one, or none, does from {others}, so that this may be chance" if judged.off_track else ""
    )
    return (
        f"{where}, no object was found within this budget that drives the policy out of its lane: the strongest of {len(result.tried)} brings it "
        f"{moves}{chance}."
    )


def effect_in_words(judged: AuditedDrives) -> str:
    """The effect with its interval, and how often the car left its lane."""
    effect = judged.effect
    interval = f"95 % {effect.low_m:.2f} to {effect.high_m:.2f}"
    farther = f"{effect.mean_m:.2f} m farther off its path ({interval})"
    if round(effect.mean_m, 2) <= 0.0:
        farther = f"no farther off its path ({round(effect.mean_m, 2) + 0.0:.2f} m, {interval})"
    return f"{farther} and out of its lane from {judged.off_track} of {len(judged.starts)} starts"


def _left(result: AuditResult, judged: AuditedDrives, kind: ControlKind) -> int:
    """Starts from which a control left the lane."""
    return next(
        each.off_track for each in result.controls if (each.kind, each.evidence) == (kind, judged.evidence)
    )


def _worse(against: AuditComparison) -> str:
    effect = against.effect
    past = "" if against.past is None else f" {_PAST[against.past]}"
    alone = ""
    if against.off_track_alone is not None:
        alone = f"; without any object it leaves its lane from {against.off_track_alone}, then from {against.off_track_alone_then}"
    return (
        f"The policy is worse than in {against.file}: from the same {against.starts} starts it comes {effect.mean_m:.2f} m farther off its path{past} "
        f"({effect.level:.0%} {effect.low_m:.2f} to {effect.high_m:.2f}), more than the margin of {against.margin_m:.2f} m{alone}."
    )


def _copy(result: AuditResult) -> str:
    quality = f" of {result.fidelity.psnr_db:.1f} dB" if result.fidelity else ""
    return f"a learned copy{quality} of {result.place.name}"


def _named(thing: AuditedObject) -> str:
    return f"a {thing.size_m[1]:.2g} m {thing.kind} at x {thing.pose.x_m:.2f}, y {thing.pose.y_m:.2f}"
