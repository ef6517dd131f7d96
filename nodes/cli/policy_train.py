"""The commands ``advnerf policy train`` and ``advnerf policy eval``: train a policy on recordings, and test it on one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from nodes.runtime.options import with_groups
from nodes.runtime.terminal import PolicyName, experiment_argument, print_table, table

if TYPE_CHECKING:
    from advnerf_core.driving.expert import Expert
    from advnerf_core.learning.recipe import SourcePlan
    from advnerf_core.policies.architecture import Architecture
    from advnerf_core.policies.view import PolicyView
    from nodes.lab.policy_data.frames import RecordedFrames
    from nodes.lab.policy_data.train import TrainingRecording

Camera = Annotated[
    Path | None,
    typer.Option(
        "--camera", exists=True, help="Camera calibration.", show_default="the one in the first bag"
    ),
]
Labels = Literal["expert", "recorded"]
ImageTopic = Annotated[
    str | None,
    typer.Option(
        "--image-topic",
        help="Topic of the images in a bag.",
        show_default="the compositor's, else the camera's",
    ),
]


@dataclass(frozen=True)
class ExpertOptions:
    """The expert that labels recordings."""

    room: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            help="Room calibration with the reference path.",
            show_default="the one in the first bag",
        ),
    ] = None
    speed_mps: Annotated[
        float, typer.Option("--speed", min=0.1, help="Speed at which the policy will drive [m/s].")
    ] = 0.8
    delay_s: Annotated[
        float,
        typer.Option(
            "--delay",
            min=0.0,
            help="Delay from an image to the resulting wheel angle that the labels account for [s].",
        ),
    ] = 0.16
    stiffness_1pm: Annotated[
        float,
        typer.Option("--stiffness", min=0.1, help="Gain with which the expert returns to the path [1/m]."),
    ] = 1.0

    def expert(self, bags: list[Path], needed: bool) -> Expert:
        """The expert on the room's path, which is the path of the first bag unless a file is given."""
        from advnerf_core.driving.expert import Expert, ExpertConfig
        from advnerf_core.driving.path import Path as DrivingPath
        from calibration.schema import RoomCalibration

        config = ExpertConfig(
            speed_mps=self.speed_mps, delay_s=self.delay_s, stiffness_1pm=self.stiffness_1pm
        )
        if not needed and self.room is None:
            # Not used for labels: the labels are recorded.
            return Expert(DrivingPath.rounded_square(4.0, 1.1), config)
        return Expert(_calibration(RoomCalibration, self.room, bags, "room").reference_path, config)


@dataclass(frozen=True)
class LogOptions:
    """How the CSV file of a log is read."""

    log_columns: Annotated[
        tuple[str, str], typer.Option(help="CSV columns of the image file and of the steering.")
    ] = ("image", "steering")
    log_scale: Annotated[
        float,
        typer.Option(help="Factor from the logs' steering to radians, left positive; for example -0.26."),
    ] = 1.0

    def frames(self, log: Path, view: PolicyView | None) -> tuple[RecordedFrames, PolicyView]:
        """Frames of a log; None makes the view of its images."""
        from nodes.lab.policy_data.frames import frames_of_log

        return frames_of_log(log, view, *self.log_columns, self.log_scale)

    def cropped(self, log: Path, view: PolicyView) -> RecordedFrames:
        """The policy's view for another camera: images of another size are cropped at the same fraction of the image."""
        from advnerf_core.data.image_files import image_size
        from nodes.lab.policy_data.frames import first_image

        same = image_size(first_image(log, self.log_columns[0])) == (view.camera.width, view.camera.height)
        return self.frames(log, view if same else None)[0]


def train(
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
    bags: Annotated[
        list[Path] | None,
        typer.Option(
            exists=True,
            help="Bag of a drive; may be repeated. The expert labels it, no matter which driver recorded it.",
        ),
    ] = None,
    logs: Annotated[
        list[Path] | None,
        typer.Option("--log", exists=True, help="CSV file of a log from another car; may be repeated."),
    ] = None,
    labels: Annotated[
        Labels,
        typer.Option(help="Source of the labels: the expert at the measured pose, or the recorded commands."),
    ] = "expert",
    image_topic: ImageTopic = None,
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
    seed: Annotated[int, typer.Option(help="Random seed.")] = 0,
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
    """Train a policy on recordings: laps of the expert, relabelled drives of the policy (DAgger), logs of other cars."""
    from advnerf_core.learning.recipe import ImitationConfig
    from nodes.lab.policy_data.train import train_from_recordings
    from nodes.runtime.errors import ConfigError
    from nodes.runtime.progress import ProgressDisplay

    bags, logs = bags or [], logs or []
    if not bags and not logs:
        raise ConfigError(
            "expected --bags BAG or --log FILE.csv, got neither. Give at least one recording; see docs/driving.md"
        )
    network = _architecture(architecture, configuration or [])
    view = _view(camera, bags, logs, log_options)
    expert = expert_options.expert(bags, needed=labels == "expert" and bool(bags))
    parts = [_of_bag(bag, view, expert, labels, image_topic) for bag in bags]
    parts += [_of_log(log, view, log_options) for log in logs]
    config = ImitationConfig(
        seed=seed,
        dagger_rounds=1 if surrogate else 0,
        first_steps=steps,
        round_steps=max(steps // 3, 1),
        architecture=network,
    )
    plan = None if surrogate is None else _surrogate(surrogate, experiment, setting, view)
    with ProgressDisplay() as display:
        done = train_from_recordings(parts, view, expert, config, output, plan, display.start("policy"))
    rows = table("recording", "frames", "left out")
    for name, count in done.frames.items():
        left_out = ", ".join(f"{n} {why}" for why, n in done.left_out.get(name, {}).items() if n)
        rows.add_row(name, str(count), left_out)
    print_table(rows)
    print(
        f"{done.path} {done.sha256[:12]}, {1e3 * done.validation_mae_rad:.1f} mrad from the labels on held-out frames"
        + "".join(f"; {name} unchecked: {reason}" for name, reason in done.unchecked.items())
    )


def evaluate(
    policy: PolicyName,
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="BAG", exists=True, help="Bag of a drive, or CSV file of a log from another car."
        ),
    ],
    expert_options: ExpertOptions,
    log_options: LogOptions,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Folder for the plot and the saliency maps.",
            show_default="runs/eval_<bag>",
        ),
    ] = None,
    labels: Annotated[
        Labels,
        typer.Option(
            help="Source of the reference steering: the expert at the measured pose, or the recorded commands."
        ),
    ] = "recorded",
    image_topic: ImageTopic = None,
    maps: Annotated[
        int, typer.Option("--saliency", min=0, help="Number of frames for which a saliency map is drawn.")
    ] = 8,
    video: Annotated[bool, typer.Option("--video", help="Also write all saliency maps as a video.")] = False,
    goal: Annotated[
        list[float] | None, typer.Option(help="One number of the goal vector. Repeat for each number.")
    ] = None,
) -> None:
    """Compare the steering of a policy with a recording: table, plot and saliency maps."""
    import numpy as np

    from advnerf_core.policies.load import load_any_policy
    from nodes.lab.policy_data import evaluate as measure
    from nodes.lab.policy_data.frames import frames_of_bag

    loaded = load_any_policy(policy)
    if recording.suffix == ".csv":
        found = log_options.frames(recording, loaded.view)[0]
    else:
        expert = expert_options.expert([recording], needed=labels == "expert")
        found = frames_of_bag(recording, loaded.view, expert, labels, image_topic)
    goals = tuple(goal or ())
    predicted = measure.predict(loaded.policy, found.frames.images, goals)
    rows = table("predicted against", "frames", "mean |error|", "RMS", "worst", "bias", "r", "straight on")
    pairs: list[tuple[str, Any]] = [(labels, np.asarray(found.frames.steering_rad))]
    if labels == "expert" and np.isfinite(found.recorded_rad).any():
        pairs.append(("recorded", found.recorded_rad))
    for name, true in pairs:
        e = measure.compare(predicted, true)
        angles = (e.mean_abs_rad, e.rms_rad, e.worst_rad, e.bias_rad)
        numbers = [f"{1e3 * v:.1f} mrad" for v in angles] + [
            f"{e.correlation:.3f}",
            f"{1e3 * e.zero_rad:.1f} mrad",
        ]
        rows.add_row(name, str(e.count), *numbers)
    print_table(rows)
    folder = output or Path("runs") / f"eval_{recording.resolve().parent.name}_{recording.stem}"
    folder.mkdir(parents=True, exist_ok=True)
    measure.draw(found, predicted, f"{policy} on {recording}", folder / "steering.png")
    files = measure.write_saliency(loaded.policy, found, folder, maps, video, goals)
    print(f"{folder / 'steering.png'}, {len(files)} saliency files in {folder}")


def add_to(app: typer.Typer) -> None:
    """Register the commands with ``advnerf policy``."""
    app.command("train")(with_groups(train))
    app.command("eval")(with_groups(evaluate))


def _of_bag(
    bag: Path, view: PolicyView, expert: Expert, labels: Labels, image_topic: str | None
) -> TrainingRecording:
    from nodes.bags.reader import read_info
    from nodes.lab.policy_data.frames import frames_of_bag
    from nodes.lab.policy_data.train import TrainingRecording

    cut, info = partial(frames_of_bag, bag, view, expert, labels, image_topic), read_info(bag)
    options = {"labels": labels, "images": image_topic}
    return TrainingRecording(str(bag), info.parts, options, cut, info.unchecked)


def _of_log(log: Path, view: PolicyView, options: LogOptions) -> TrainingRecording:
    from nodes.lab.policy_data.train import TrainingRecording

    named = {"columns": options.log_columns, "scale": options.log_scale}
    return TrainingRecording(str(log), (log,), named, partial(options.cropped, log, view))


def _architecture(name: str, configuration: list[str]) -> Architecture:
    """The architecture with its settings, checked before recordings are read."""
    from advnerf_core.documents import parse_yaml
    from advnerf_core.policies.architecture import Architecture, require_architecture
    from nodes.runtime.errors import ConfigError

    settings = {}
    for text in configuration:
        key, separator, value = text.partition("=")
        if not separator:
            raise ConfigError(
                f"--configuration {text}: expected KEY=VALUE, for example --configuration 'widths=[16, 32]'"
            )
        settings[key.strip()] = parse_yaml(value, f"--configuration {text}").data
    require_architecture(name, None, settings)
    found = Architecture(name, settings)
    found.check()
    return found


def _view(camera: Path | None, bags: list[Path], logs: list[Path], options: LogOptions) -> PolicyView:
    from advnerf_core.policies.view import PolicyView
    from calibration.schema import CameraCalibration

    if camera is None and not bags:
        return options.frames(logs[0], None)[1]
    calibration = _calibration(CameraCalibration, camera, bags, "camera")
    return PolicyView(calibration.pinhole, distortion=calibration.distortion)


def _calibration(model: Any, given: Path | None, bags: list[Path], name: str) -> Any:
    """Load the given calibration file, or else the one attached to the first bag."""
    import tempfile

    from calibration.schema import load_calibration
    from nodes.bags.reader import read_attachments
    from nodes.runtime.errors import ConfigError

    if given is not None:
        return load_calibration(model, given)
    if f"{name}.yaml" not in (attached := read_attachments(bags[0])):
        raise ConfigError(
            f"expected {name}.yaml attached to {bags[0]}, got {', '.join(attached) or 'no attachment'}; give the file with --{name}"
        )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"{name}.yaml"
        file.write_bytes(attached[f"{name}.yaml"])
        return load_calibration(model, file)


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
