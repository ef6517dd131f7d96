"""The commands ``advnerf policy train`` and ``advnerf policy eval``: train a policy on logs of drives, and test it on them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from advnerf_core.unit_bounds import MOST_LAG_S, MOST_SPEED_MPS
from nodes.cli.log_options import LogOptions, Logs
from nodes.runtime.terminal import PolicyName, experiment_argument, print_table, table

if TYPE_CHECKING:
    from advnerf_core.driving.expert import Expert
    from advnerf_core.learning.recipe import SourcePlan
    from advnerf_core.policies.architecture import Architecture
    from advnerf_core.policies.view import PolicyView
    from nodes.lab.policy_data.evaluate import Errors
    from nodes.lab.policy_data.logs import OpenLog

Camera = Annotated[
    Path | None,
    typer.Option(
        "--camera", exists=True, help="Camera calibration.", show_default="the first one in the logs"
    ),
]
Goal = Annotated[
    list[float] | None, typer.Option(help="One number of the goal vector. Repeat for each number.")
]
Labels = Literal["expert", "recorded"]


@dataclass(frozen=True)
class ExpertOptions:
    """The expert that labels recordings."""

    room: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            help="Room calibration with the reference path.",
            show_default="the one in the logs",
        ),
    ] = None
    speed_mps: Annotated[
        float,
        typer.Option(
            "--speed", min=0.1, max=MOST_SPEED_MPS, help="Speed at which the policy will drive [m/s]."
        ),
    ] = 0.8
    delay_s: Annotated[
        float,
        typer.Option(
            "--delay",
            min=0.0,
            max=MOST_LAG_S,
            help="Delay from an image to the resulting wheel angle that the labels account for [s].",
        ),
    ] = 0.16
    stiffness_1pm: Annotated[
        float,
        typer.Option("--stiffness", min=0.1, help="Gain with which the expert returns to the path [1/m]."),
    ] = 1.0

    def expert(self, logs: list[OpenLog]) -> Expert:
        """The expert on the room's path: the given file's, or else the one that the logs agree on."""
        from advnerf_core.driving.expert import Expert, ExpertConfig
        from advnerf_core.driving.path import Path as DrivingPath
        from nodes.lab.policy_data.recordings import room_of
        from nodes.runtime.errors import ConfigError

        config = ExpertConfig(
            speed_mps=self.speed_mps, delay_s=self.delay_s, stiffness_1pm=self.stiffness_1pm
        )
        room = room_of(self.room, logs)
        if room is not None:
            return Expert(room.reference_path, config)
        if any(each.labels == "expert" for each in logs):
            raise ConfigError(
                "expected room.yaml attached to one of the logs for the expert's labels, got none; "
                "give the file with --room, or use --labels recorded"
            )
        # Not used for labels: the labels are recorded.
        return Expert(DrivingPath.rounded_square(4.0, 1.1), config)


def train(
    logs: Logs,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help="Folder of the policy. Run the same command again to resume a stopped training.",
        ),
    ],
    expert_options: ExpertOptions,
    log_options: LogOptions,
    labels: Annotated[
        Labels | None,
        typer.Option(
            help="Source of the labels: the expert at the measured pose, or the recorded steering.",
            show_default="expert for logs with poses, else recorded",
        ),
    ] = None,
    camera: Camera = None,
    surrogate: Annotated[
        Path | None,
        typer.Option(
            "--folder",
            exists=True,
            help="Run folder of an experiment. Views of its learned room are added to the training data.",
        ),
    ] = None,
    experiment: Annotated[
        Path, typer.Option(help="Experiment file of that run, or its name.", parser=experiment_argument)
    ] = Path("room"),
    setting: Annotated[str, typer.Option(help="Setting of that run.")] = "demo",
    steps: Annotated[int, typer.Option(min=1, help="Optimiser steps.")] = 800,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Random seed.")] = 0,
    architecture: Annotated[
        str, typer.Option(help="pilotnet, resnet, vit_tiny, or file.py:Class of your own.")
    ] = "pilotnet",
    configuration: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUE",
            help="Setting of the architecture, for example 'widths=[16, 32]'; may be repeated.",
        ),
    ] = None,
) -> None:
    """Train a policy on logs of drives: laps of the expert, relabelled drives of the policy (DAgger), drives of other cars."""
    from advnerf_core.learning.recipe import ImitationConfig
    from nodes.lab.policy_data.frames import HOLDOUT_EVERY
    from nodes.lab.policy_data.logs import open_logs
    from nodes.lab.policy_data.recordings import (
        crop_notes,
        policy_view,
        steering_bound_rad,
    )
    from nodes.lab.policy_data.train import train_from_recordings
    from nodes.runtime.progress import ProgressDisplay

    network = _architecture(architecture, configuration or [])
    opened = open_logs(logs, log_options.choice(), labels)
    view = policy_view(camera, opened)
    expert = expert_options.expert(opened)
    config = ImitationConfig(
        seed=seed,
        dagger_rounds=1 if surrogate else 0,
        first_steps=steps,
        round_steps=max(steps // 3, 1),
        architecture=network,
        max_steering_rad=steering_bound_rad(opened),
        holdout_every=HOLDOUT_EVERY,
    )
    plan = None if surrogate is None else _surrogate(surrogate, experiment, setting, view)
    with ProgressDisplay() as display:
        done = train_from_recordings(opened, view, expert, config, output, plan, display.start("policy"))
    labels_of = {
        each.name: f"{each.labels}: {each.log.unit}" if each.labels == "recorded" else "expert"
        for each in opened
    }
    rows = table("log", "labels", "frames", "left out")
    for name, count in done.frames.items():
        left_out = ", ".join(f"{n} {why}" for why, n in done.left_out.get(name, {}).items() if n)
        rows.add_row(name, labels_of.get(name, "expert"), str(count), left_out)
    print_table(rows)
    print("".join(f"{note}\n" for note in crop_notes(opened, view)), end="")
    for each in opened:
        if not each.log.rate_hz:
            print(f"{each.name}: {each.log.rate_in_words}; frames are held out in the order of the log")
        print("".join(f"{each.name}: {note}\n" for note in each.log.notes), end="")
    print(
        f"{done.path} {done.sha256[:12]}, {1e3 * done.validation_mae_rad:.1f} mrad from the labels on held-out frames"
        + "".join(f"; {name} unchecked: {reason}" for name, reason in done.unchecked.items())
    )


def evaluate(
    policy: PolicyName,
    logs: Logs,
    expert_options: ExpertOptions,
    log_options: LogOptions,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Folder for the plots and the saliency maps, one folder in it for each of several logs.",
            show_default="runs/eval_<log>",
        ),
    ] = None,
    labels: Annotated[
        Labels,
        typer.Option(
            help="Source of the reference steering: the expert at the measured pose, or the recorded steering."
        ),
    ] = "recorded",
    held_out: Annotated[
        bool,
        typer.Option("--held-out", help="Compare only the frames that a training on this log keeps out."),
    ] = False,
    maps: Annotated[
        int | None,
        typer.Option(
            "--saliency",
            min=0,
            help="Number of frames for which a saliency map is drawn.",
            show_default="8, or 0 for a policy without a gradient",
        ),
    ] = None,
    video: Annotated[bool, typer.Option("--video", help="Also write all saliency maps as a video.")] = False,
    goal: Goal = None,
) -> None:
    """Compare the steering of a policy with logs of drives: table, plots and saliency maps."""
    from advnerf_core.policies.driver import require_goal
    from advnerf_core.policies.load import load_any_policy
    from nodes.lab.policy_data import evaluate as measure
    from nodes.lab.policy_data.logs import open_logs
    from nodes.lab.policy_data.recordings import crop_notes, recorded_frames
    from nodes.runtime.errors import ConfigError

    loaded = load_any_policy(policy)
    goals = tuple(goal or ())
    has_gradient = bool(getattr(loaded.policy, "differentiable", True))
    require_goal(goals, loaded.policy.goal_size, "give --goal for each number")
    if (maps or video) and not has_gradient:
        raise ConfigError(
            "expected a policy with a gradient for --saliency and --video, got one without; leave them out, or give the policy that it was "
            "exported from"
        )
    count = (8 if has_gradient else 0) if maps is None else maps
    opened = open_logs(logs, log_options.choice(), labels)
    expert = expert_options.expert(opened)
    folders = _folders(output, opened)
    rows = table(
        "log", "predicted against", "frames", "mean |error|", "RMS", "worst", "bias", "r", "straight on"
    )
    written, problems = [], list[str]()
    for each, folder in zip(opened, folders, strict=True):
        found = recorded_frames(each, loaded.view, expert)
        predicted = measure.predict(loaded.policy, found.frames.images, goals, found.drive_starts())
        for name, errors in measure.compared(found, predicted, labels, held_out).items():
            rows.add_row(each.name, name, *_error_cells(errors))
            problems += [f"warning: {each.name}, {name}: {errors.problem}"] if errors.problem else []
        folder.mkdir(parents=True, exist_ok=True)
        measure.draw(found, predicted, f"{policy} on {each.name}", folder / "steering.png")
        files = measure.write_saliency(loaded.policy, found, folder, count, video, goals)
        written.append(f"{folder / 'steering.png'}, {len(files)} saliency files in {folder}")
    print_table(rows)
    notes = [f"{each.name}: {note}" for each in opened for note in each.log.notes]
    print("\n".join([*problems, *notes, *crop_notes(opened, loaded.view), *written]))


def _folders(output: Path | None, logs: list[OpenLog]) -> list[Path]:
    """One folder for each log; logs of the same name are numbered."""
    if output is not None and len(logs) == 1:
        return [output]
    folders: list[Path] = []
    for each in logs:
        folder = first = (
            output or Path("runs")
        ) / f"eval_{each.log.path.resolve().parent.name}_{each.log.path.stem}"
        number = 1
        while folder in folders:
            number += 1
            folder = first.with_name(f"{first.name}_{number}")
        folders.append(folder)
    return folders


def _error_cells(e: Errors) -> list[str]:
    angles = (e.mean_abs_rad, e.rms_rad, e.worst_rad, e.bias_rad)
    texts = [f"{1e3 * value:.1f} mrad" for value in angles]
    return [str(e.count), *texts, f"{e.correlation:.3f}", f"{1e3 * e.zero_rad:.1f} mrad"]


def _architecture(name: str, configuration: list[str]) -> Architecture:
    """The architecture with its settings, checked before recordings are read."""
    from advnerf_core.policies.architecture import Architecture, require_architecture
    from nodes.runtime.config import typed_values

    settings = typed_values("--configuration", configuration, "'widths=[16, 32]'")
    require_architecture(name, None, settings)
    found = Architecture(name, settings)
    found.check()
    return found


def _surrogate(folder: Path, file: Path, setting: str, view: PolicyView) -> SourcePlan:
    from nodes.experiment.steps.policy import surrogate_plan
    from nodes.experiment.steps.run import load_experiment
    from nodes.runtime.errors import ConfigError

    run = load_experiment(file, setting, [], folder)
    if run.view != view:
        raise ConfigError(
            f"expected the run in {folder} to have the camera of the recordings, got another; use bags of that run and its --camera"
        )
    return surrogate_plan(run)
