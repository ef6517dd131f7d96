"""The command ``advnerf audit``: can an object drive this policy off its path at this place?"""

from __future__ import annotations

import re
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from advnerf_core.errors import AdvnerfError
from advnerf_core.unit_bounds import MOST_LENGTH_M, MOST_SPEED_MPS
from nodes.cli.endings import INTERRUPTED, text_for_people
from nodes.lab.importing.metric_options import MetricOptions
from nodes.runtime.errors import ConfigError
from nodes.runtime.terminal import Overrides, say_error

if TYPE_CHECKING:
    from nodes.audit.run import Audit

# Codes below are verdicts: see `advnerf_core.report.audit_result.EXIT_CODES`.
USAGE_EXIT, FAULT_EXIT, CANNOT_JUDGE_EXIT = 64, 70, 2
_PLACE, _SEARCH, _RESULT = "Place", "Search", "Result"
_UNITS_MIN = {"s": 1 / 60, "m": 1.0, "h": 60.0}
OFF_LANE = "off-lane"


def _option(panel: str, *names: str, **settings: Any) -> Any:
    return typer.Option(*names, rich_help_panel=panel, **settings)


@dataclass(frozen=True)
class PlaceOptions:
    """Where the policy drives, and how."""

    place: Annotated[
        Path | None,
        _option(
            _PLACE,
            "--place",
            exists=True,
            help="Photographs, a video, posed photographs (transforms.json), or a scan (Polycam, Record3D, COLMAP, ...).",
        ),
    ] = None
    world: Annotated[
        str | None,
        _option(
            _PLACE, "--world", help="Instead: a world that can be driven, as lab, metadrive or file.py:Class."
        ),
    ] = None
    in_metres: Annotated[
        bool,
        _option(
            _PLACE,
            "--in-metres",
            help="Posed photographs of other software are in metres, as from motion capture; else give a length.",
        ),
    ] = False
    limit: Annotated[
        str | None,
        _option(
            _PLACE, "--limit", help="Half the width of the lane in metres; off-lane: as the world declares."
        ),
    ] = None
    car: Annotated[
        str | None,
        _option(_PLACE, "--car", help="racecarj, roboracer, donkey, duckiebot, car, or a YAML file."),
    ] = None
    speed_mps: Annotated[
        float | None,
        _option(
            _PLACE,
            "--speed",
            min=0.01,
            max=MOST_SPEED_MPS,
            help="Speed of the drives in m/s.",
            show_default="the car's",
        ),
    ] = None
    camera_height_m: Annotated[
        float | None,
        _option(
            _PLACE,
            "--camera-height",
            min=0.01,
            max=MOST_LENGTH_M,
            help="Height of the driving camera in metres.",
        ),
    ] = None
    path: Annotated[
        str | None,
        _option(
            _PLACE, "--path", help="driven, a CSV file with x_m and y_m, transforms.json of a drive, or the name of a world's path.",
            show_default="driven; of a world that of its experiment file, or its first",
        ),
    ] = None  # fmt: skip
    declared: Annotated[
        list[str] | None,
        _option(
            _PLACE,
            "--declare",
            metavar="KEY=VALUE",
            help="What a policy file does not say of itself, as colour_space=BGR; see docs/policy_contract.md. May be repeated.",
        ),
    ] = None


@dataclass(frozen=True)
class SearchOptions:
    """What is searched, and for how long."""

    kind: Annotated[
        str, _option(_SEARCH, "--object", help="panel, or a .glb or .object.safetensors file.")
    ] = "panel"
    size_m: Annotated[
        float | None,
        _option(
            _SEARCH,
            "--object-size",
            min=0.01,
            help="Width of the object in metres.",
            show_default="0.8 of half the lane",
        ),
    ] = None
    budget: Annotated[
        str | None,
        _option(
            _SEARCH,
            "--budget",
            help="Time for the whole audit, as 90s, 10m or 2h; a smallest schedule is always finished.",
            show_default="15m",
        ),
    ] = None
    evaluations: Annotated[
        int | None,
        _option(
            _SEARCH,
            "--evaluations",
            min=1,
            help="The number of evaluations itself, the same on every machine.",
        ),
    ] = None
    cluster: Annotated[
        str | None,
        _option(
            _SEARCH,
            "--cluster",
            help="Search over a Ray cluster: HOST:PORT of its head, auto, or here to start one on this machine.",
        ),
    ] = None
    starts: Annotated[
        int | None,
        _option(
            _SEARCH, "--starts", min=5, help="Starts that are judged by.", show_default="20; 50 in a world"
        ),
    ] = None


@dataclass(frozen=True)
class ResultOptions:
    """What is written."""

    output: Annotated[
        Path, _option(_RESULT, "--output", "-o", help="Folder of the audit; one that was stopped goes on.")
    ] = Path("runs/audit")
    ci: Annotated[
        bool,
        _option(
            _RESULT,
            "--ci",
            help="A small audit of a fixed number of evaluations: the same verdict and bytes on every run.",
        ),
    ] = False
    against: Annotated[
        Path | None,
        _option(
            _RESULT,
            "--against",
            help="audit.json of an earlier audit; exit code 3 if the policy is worse.",
            exists=True,
        ),
    ] = None
    harden: Annotated[
        bool,
        _option(
            _RESULT,
            "--harden",
            help="Export camera frames past the object, with the steering that keeps the path.",
        ),
    ] = False


def _print_schema(wanted: bool) -> None:
    if wanted:
        import json

        from advnerf_core.report.audit_result import audit_schema

        print(json.dumps(audit_schema(), indent=1))
        raise typer.Exit


def _minutes(text: str | None) -> float | None:
    if text is None:
        return None
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smh]?)", text.strip())
    if found is None or float(found[1]) <= 0.0:
        raise ConfigError(f"--budget: expected a time such as 90s, 10m or 2h, got {text!r}")
    return float(found[1]) * _UNITS_MIN[found[2] or "m"]


def _limit_m(options: PlaceOptions) -> float | None:
    """What the user said; None where nothing was, or as the world declares."""
    text = options.limit
    if text is None or (text == OFF_LANE and options.world is not None):
        return None
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 < value <= MOST_LENGTH_M:
        raise ConfigError(
            f"--limit: expected metres above 0 and at most {MOST_LENGTH_M:g}, not cm or mm, or {OFF_LANE} with a world, which declares its lanes, got {text!r}"
        )
    return value


def _refuse_unused(
    place: PlaceOptions,
    metric: MetricOptions,
    search: SearchOptions,
    result: ResultOptions,
    overrides: list[str],
) -> None:
    """Raise for options that would have no effect at all, or beside others."""
    if gates := [each for each in overrides if re.match(r"\s*gate\s*[.=]", each)]:
        raise ConfigError(
            f"expected --set of what an audit uses, got --set {gates[0]}: it judges by a check of its own that has no settings; leave it out"
        )
    if search.budget is not None and (search.evaluations is not None or result.ci):
        other = (
            "--evaluations"
            if search.evaluations is not None
            else "--ci, whose number of evaluations is fixed"
        )
        raise ConfigError(f"expected one budget, got --budget and {other}; leave one out")
    if place.world is None:
        return
    given = {
        "--car": place.car is not None,
        "--speed": place.speed_mps is not None,
        "--camera-height": place.camera_height_m is not None,
        "--in-metres": place.in_metres,
        "--length, --positions, --marker, --dictionary or --up": metric != MetricOptions(),
    }
    if unused := [name for name, is_given in given.items() if is_given]:
        raise ConfigError(
            f"expected {', '.join(unused)} only with --place: a world has a car, a camera and metres of its own; change them with --set world.KEY=VALUE"
        )


def _say(text: str) -> None:
    print(text, flush=True)


def audit(
    policy: Annotated[
        str,
        typer.Argument(
            help="A .onnx, .pt2 or .safetensors file, package.module:factory, or grpc://HOST:PORT of a driver."
        ),
    ],
    place: PlaceOptions,
    metric: MetricOptions,
    search: SearchOptions,
    result: ResultOptions,
    overrides: Overrides = None,
    schema: Annotated[
        bool,
        _option(
            _RESULT,
            "--schema",
            help="Print the JSON schema of audit.json.",
            is_eager=True,
            callback=_print_schema,
        ),
    ] = False,
) -> None:
    """Find out whether an object can drive a policy off its path at a place.

    Exit code 0: nothing was found within the budget. 1: found. 2: it cannot be judged. 3: worse than --against. 64 and above: usage and faults.
    """
    del schema
    began_s = time.monotonic()
    if (place.place is None) == (place.world is None):
        say_error("expected either --place or --world")
        raise typer.Exit(USAGE_EXIT)
    from nodes.audit.asking import UnansweredError

    try:
        found = _audit(policy, place, metric, search, result, overrides or [], began_s).run()
    except UnansweredError as error:
        say_error(str(error))
        raise typer.Exit(CANNOT_JUDGE_EXIT) from None
    except typer.Abort:  # Ctrl-C at a question
        raise typer.Exit(INTERRUPTED) from None
    except Exception as error:
        if (text := text_for_people(error)) is None:
            traceback.print_exc()  # a fault of ours must not end as the verdict that Python's own code 1 stands for
            raise typer.Exit(FAULT_EXIT) from None
        say_error(text)
        raise typer.Exit(USAGE_EXIT) from None
    print(f"\n{found.verdict.sentence}\n{result.output / 'audit.html'}")
    raise typer.Exit(found.exit_code)


def _audit(
    policy: str,
    place: PlaceOptions,
    metric: MetricOptions,
    search: SearchOptions,
    result: ResultOptions,
    overrides: list[str],
    began_s: float,
) -> Audit:
    # What is wrong in the command is told before seconds of imports.
    wanted_m, minutes = _limit_m(place), _minutes(search.budget)
    _refuse_unused(place, metric, search, result, overrides)
    if search.kind != "panel" and not Path(search.kind).is_file():
        raise ConfigError(
            f"--object: expected panel, or a .glb or .object.safetensors file, got {search.kind}, which is not there"
        )
    from nodes.audit.asking import answer
    from nodes.audit.cars import car_of
    from nodes.audit.images import posed
    from nodes.audit.places import Answers, AuditedWorld, camera_of, place_of_photographs
    from nodes.audit.policies import resolve_policy
    from nodes.audit.question import CI_SECTIONS, AuditedQuestion
    from nodes.audit.run import CI_EVALUATIONS, Audit
    from nodes.runtime.console import plain_console

    answers = Answers(wanted_m, place.speed_mps, place.camera_height_m, place.path)
    limit_m, declared, folder = answers.limit_m, place.declared or [], result.output
    if place.place is not None:
        named = answer(
            place.car, "--car", "Which car: racecarj, roboracer, donkey, duckiebot, car, or a YAML file", str
        )
        car, there = car_of(named), posed(place.place, folder, metric, place.in_metres)
        spec, wanted = resolve_policy(
            policy, lambda: (camera_of(there, place.path), car.car.max_steering_rad), declared, folder, _say
        )
        where, limit_m = place_of_photographs(place.place, there, answers, car, wanted, overrides)
    else:
        assert place.world is not None, "one of the two is given"
        world = AuditedWorld(place.world)
        where = world.place(place.path)
        spec, _ = resolve_policy(
            policy,
            lambda: (world.description.camera, world.description.car.largest_control),
            declared,
            folder,
            _say,
        )
    question = AuditedQuestion(
        policy=spec,
        given=policy,
        place=where,
        limit_m=limit_m,
        kind=search.kind if search.kind == "panel" else str(Path(search.kind).resolve()),
        size_m=search.size_m,
        overrides=tuple(overrides),
        judging=search.starts or (50 if where.is_driven and not result.ci else 20),
        sections=CI_SECTIONS if result.ci else {},
    )
    return Audit(
        question,
        folder,
        _say,
        plain_console(),
        minutes=minutes,
        evaluations=search.evaluations or (CI_EVALUATIONS if result.ci else None),
        against=result.against,
        harden=result.harden,
        timed=not result.ci,
        cluster=search.cluster,
        began_s=began_s,
    )


class AuditCommand(TyperCommand):
    """The command with exit code 64 for wrong options, as 2 is a verdict."""

    def invoke(self, *given: Any) -> Any:
        """As typer's; options that contradict each other are told here, when they are put together."""
        try:
            return super().invoke(*given)
        except AdvnerfError as error:
            say_error(str(error))
            raise typer.Exit(USAGE_EXIT) from None

    def make_context(self, *given: Any, **settings: Any) -> Any:
        """As typer's; only the exit code is another."""
        try:
            return super().make_context(*given, **settings)
        except Exception as error:
            if getattr(error, "exit_code", 0) == CANNOT_JUDGE_EXIT:
                error.exit_code = USAGE_EXIT  # type: ignore[attr-defined]
            raise
