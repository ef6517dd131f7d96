"""The command ``advnerf``. Each command imports its modules when it is called, so that ``--help`` is fast."""

from __future__ import annotations

import contextlib
import errno
import signal
import time
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from advnerf_core.errors import AdvnerfError
from advnerf_core.places import use_writable_cache
from nodes.cli import arm as cli_arm
from nodes.cli import attack as cli_attack
from nodes.cli import attack_node as cli_attack_node
from nodes.cli import attack_poses as cli_attack_poses
from nodes.cli import audit as cli_audit
from nodes.cli import bag as cli_bag
from nodes.cli import calibrate as cli_calibrate
from nodes.cli import camera as cli_camera
from nodes.cli import carla as cli_carla
from nodes.cli import doctor as cli_doctor
from nodes.cli import experiment as cli_experiment
from nodes.cli import keys as cli_keys
from nodes.cli import lists as cli_lists
from nodes.cli import method as cli_method
from nodes.cli import motor as cli_motor
from nodes.cli import node as cli_node
from nodes.cli import object as cli_object
from nodes.cli import page as cli_page
from nodes.cli import policy as cli_policy
from nodes.cli import replay as cli_replay
from nodes.cli import room as cli_room
from nodes.cli import scene as cli_scene
from nodes.cli import start as cli_start
from nodes.cli import teleop as cli_teleop
from nodes.cli import topic as cli_topic
from nodes.cli import trial as cli_trial
from nodes.cli import verify as cli_verify
from nodes.cli import world as cli_world
from nodes.runtime.extras import installs
from nodes.runtime.terminal import LaunchFile, Overrides, print_table, say_error, table

if TYPE_CHECKING:
    from nodes.launching.launch import Launch

OUR_PACKAGES = ("advnerf_core", "hardware", "calibration", "nodes")
ERROR_EXIT, FAILURE_EXIT = 2, 1

app = typer.Typer(
    name="advnerf",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Find objects that drive a self-driving policy off its path, and prove it on the car or on its simulated lab.",
)
app.add_typer(cli_topic.app, name="topic")
app.add_typer(cli_bag.app, name="bag")
app.add_typer(cli_keys.app, name="keys")
app.add_typer(cli_node.app, name="node")
cli_node.add_to(app)
app.add_typer(cli_motor.app, name="motor")
app.add_typer(cli_calibrate.app, name="calibrate")
app.add_typer(cli_camera.app, name="camera")
cli_attack_node.add_to(cli_attack.app)
cli_attack_poses.add_to(cli_attack.app)
app.add_typer(cli_attack.app, name="attack")
app.add_typer(cli_method.app, name="method")
app.add_typer(cli_object.app, name="object")
app.add_typer(cli_policy.app, name="policy")
app.add_typer(cli_scene.app, name="scene")
app.add_typer(cli_room.app, name="room")
app.add_typer(cli_carla.app, name="carla")
app.add_typer(cli_world.app, name="world")
cli_start.add_to(app)
cli_audit.add_to(app)
cli_arm.add_to(app)
cli_doctor.add_to(app)
cli_experiment.add_to(app)
cli_lists.add_to(app)
cli_verify.add_to(app)
cli_page.add_to(app)
cli_replay.add_to(app)
cli_teleop.add_to(app)
cli_trial.add_to(app)
_debug = False


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"advnerf {version('advnerf')}")
        raise typer.Exit


@app.callback()
def options(
    show_version: Annotated[
        bool, typer.Option("--version", help="Show the version.", callback=_print_version, is_eager=True)
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
) -> None:
    """Options of all commands."""
    global _debug
    _debug = debug


@app.command()
def launch(
    file: LaunchFile,
    overrides: Overrides = None,
    run_dir: Annotated[
        Path | None, typer.Option(help="Folder for logs, sockets and bag.", show_default="runs/<name>-<time>")
    ] = None,
    duration_s: Annotated[
        float | None, typer.Option("--duration", min=0.0, help="Stop after this many seconds.")
    ] = None,
    host: Annotated[
        str | None, typer.Option(help="Host of the launch file that this computer is, or all.")
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Start nothing; list the nodes that would start and the problems found."
        ),
    ] = False,
) -> None:
    """Start the nodes of a launch file and supervise them. Ctrl-C stops them; a second Ctrl-C kills them."""
    from nodes.lab.plugin_tables import say_code
    from nodes.launching.launch import Launch
    from nodes.launching.launch_file import load_launch

    plan = load_launch(file, overrides or [], host=host)
    say_code(plan.resolved, file.parent)
    if check:
        _print_plan(plan)
        _say_problems(plan)
        return
    run_dir = run_dir or Path("runs") / f"{plan.launch.name}-{time.strftime('%Y%m%d-%H%M%S')}"
    started = Launch(file, overrides or [], run_dir, lambda line: print(f"[launch] {line}", flush=True), host)
    _watch_launch(started, duration_s)


def _watch_launch(started: Launch, duration_s: float | None) -> None:
    asked = 0

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked += 1
        started.request_stop(kill=asked > 1)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    print(f"[launch] {started.plan.launch.name} in {started.run_dir}", flush=True)
    started.start()
    try:
        if started.wait(duration_s) is None:
            started.request_stop()
    finally:
        code = started.stop()
    if code:
        say_error(started.failure)
        raise typer.Exit(code)


def _print_plan(plan: Any) -> None:
    rows = table("node", "module", "required", "config")
    for name, entry in plan.nodes.items():
        rows.add_row(name, entry.module, "yes" if entry.required else "no", str(plan.documents[name].data))
    print_table(rows)


def _say_problems(plan: Any) -> None:
    from nodes.lab.doctor.launch import policy_problems
    from nodes.launching.launch_check import check_nodes

    # The policies are loaded only if every node accepts its configuration.
    problems = list(check_nodes(plan).values()) or policy_problems(plan)
    for problem in problems:
        say_error(problem)
    if problems:
        raise typer.Exit(ERROR_EXIT)


def _is_for_people(error: Exception) -> bool:
    """Whether the message of an exception was written for the user."""
    return isinstance(error, AdvnerfError | OSError)


def main() -> None:
    """Run the command line. An error that the user can fix is printed as one line, with exit code 2 and no traceback."""
    with contextlib.suppress(
        AdvnerfError, OSError
    ):  # only what needs a cache fails without one; stopping the car does not
        use_writable_cache()
    try:
        app()
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except ModuleNotFoundError as error:
        missing = (error.name or "").split(".")[0]
        if _debug or missing in OUR_PACKAGES or (command := installs(missing)) is None:
            raise
        say_error(f"this command needs {missing}, which is not installed: {command}")
        raise SystemExit(ERROR_EXIT) from None
    except Exception as error:  # any other exception is a bug and keeps its traceback
        if _debug or not _is_for_people(error):
            raise
        say_error(_words(error))
        raise SystemExit(ERROR_EXIT) from None


def _words(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        where = f" of {error.filename}" if error.filename else ""
        return f"the disk{where} is full: free some space or choose another folder. Finished work is kept"
    return str(error) or type(error).__name__


if __name__ == "__main__":
    main()
