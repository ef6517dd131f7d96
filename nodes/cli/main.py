"""The command ``advnerf``. Each command imports its modules when it is called, so that ``--help`` is fast."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from advnerf_core.errors import AdvnerfError
from advnerf_core.places import use_writable_cache
from nodes.cli import arm as cli_arm
from nodes.cli import attack as cli_attack
from nodes.cli import attack_node as cli_attack_node
from nodes.cli import attack_print as cli_attack_print
from nodes.cli import audit as cli_audit
from nodes.cli import bag as cli_bag
from nodes.cli import car as cli_car
from nodes.cli import demo as cli_demo
from nodes.cli import doctor as cli_doctor
from nodes.cli import experiment as cli_experiment
from nodes.cli import log as cli_log
from nodes.cli import method as cli_method
from nodes.cli import policy as cli_policy
from nodes.cli import scene as cli_scene
from nodes.cli import verify as cli_verify
from nodes.cli.endings import (
    INTERRUPTED,
    how_to_resume,
    is_resumable,
    text_for_people,
    usage_text,
)
from nodes.cli.panels import in_panels
from nodes.runtime.extras import installs
from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import FAILURE_EXIT, LaunchFile, Overrides, print_table, say_error, table
from nodes.runtime.termination import ending_signals, ends_in_order

if TYPE_CHECKING:
    from nodes.launching.launch import Launch

OUR_PACKAGES = ("advnerf_core", "hardware", "calibration", "nodes")
ERROR_EXIT = 2

PANELS = {
    "Audit and experiments": ("audit", "demo", "experiment", "verify"),
    "Places and objects": ("scene",),
    "Policies": ("policy", "attack"),
    "The car": ("launch", "car", "disarm"),
    "Bags and tools": ("bag", "doctor"),
}

app = CommandGroup(
    name="advnerf",
    no_args_is_help=True,
    cls=in_panels(PANELS),
    pretty_exceptions_enable=False,
    help="Find objects that drive a self-driving policy off its path, and prove it on the car or on its simulated lab.",
)
app.command(cls=cli_audit.AuditCommand)(cli_audit.audit)
app.command()(cli_demo.demo)
app.command()(cli_verify.verify)
app.add_typer(cli_experiment.app, name="experiment")
app.add_typer(cli_scene.app, name="scene")
cli_policy.app.add_typer(cli_log.app, name="log")
app.add_typer(cli_policy.app, name="policy")
cli_attack.app.command("request")(cli_attack_node.attack_request)
cli_attack.app.command("cancel")(cli_attack_node.attack_cancel)
cli_attack.app.command("print")(cli_attack_print.attack_print)
cli_attack.app.command("measure")(cli_attack_print.attack_measure)
cli_attack.app.add_typer(cli_method.app, name="method")
app.add_typer(cli_attack.app, name="attack")
app.add_typer(cli_car.app, name="car")
app.command("disarm")(cli_arm.disarm)
app.add_typer(cli_bag.app, name="bag")
app.command("doctor")(cli_doctor.doctor)
_debug = False
_is_in_command = False


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
    global _debug, _is_in_command
    _debug, _is_in_command = debug, True


@app.command()
def launch(
    file: LaunchFile,
    overrides: Overrides = None,
    run_dir: Annotated[
        Path | None,
        typer.Option(
            "--folder",
            help="Folder of the run: logs, sockets and bag.",
            show_default="runs/<name>-<time>",
        ),
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
    """Start the nodes of a launch file and supervise them. Ctrl-C stops them; a second Ctrl-C kills them.

    Nothing is started if a node refuses its configuration, or a calibration, attack or policy file is missing.
    """
    from advnerf_core.places import require_utf8
    from nodes.lab.plugin_tables import say_code
    from nodes.launching.launch import Launch
    from nodes.launching.launch_file import load_launch

    # As text: the folder is made only when the checks have passed.
    place = "<run_dir>" if run_dir is None else str(run_dir.resolve())
    plan = load_launch(file, overrides or [], place, host)
    say_code(plan.resolved, file.parent)
    if check:
        _print_plan(plan)
        _refuse(_problems(plan))
        return
    run_dir = run_dir or Path("runs") / f"{plan.launch.name}-{time.strftime('%Y%m%d-%H%M%S')}"
    require_utf8(run_dir.absolute())
    _refuse(_cheap_problems(plan))
    started = Launch(file, overrides or [], run_dir, _say, host)
    _watch_launch(started, duration_s)


def _say(line: str) -> None:
    with contextlib.suppress(OSError):  # a closed terminal must not keep the launch from stopping the car
        print(f"[launch] {line}", flush=True)


def _watch_launch(started: Launch, duration_s: float | None) -> None:
    asked = 0

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked += number != signal.SIGHUP  # a closed terminal sends it twice, itself and through the shell
        started.request_stop(kill=asked > 1)

    for number in (signal.SIGINT, *ending_signals()):
        signal.signal(number, stop)
    _say(f"{started.plan.launch.name} in {started.run_dir}")
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


def _cheap_problems(plan: Any) -> list[str]:
    """Errors that show in a second: of the nodes' configurations, calibrations and attacks, and policy files that are not there."""
    from nodes.lab.doctor import files
    from nodes.lab.doctor.launch import missing_policies
    from nodes.launching.launch_check import check_nodes

    return list(check_nodes(plan).values()) or missing_policies(plan) or files.unusable(plan)


def _problems(plan: Any) -> list[str]:
    """All errors. The policies are loaded, in seconds, only if nothing else is wrong."""
    from nodes.lab.doctor import files
    from nodes.lab.doctor.launch import policy_problems
    from nodes.launching.one_car import unprovided

    return _cheap_problems(plan) or unprovided(plan) or files.missing(plan) or policy_problems(plan)


def _refuse(problems: Sequence[str]) -> None:
    for problem in problems:
        say_error(problem)
    if problems:
        raise typer.Exit(ERROR_EXIT)


def main() -> None:
    """Run the command line. An error that the user can fix is printed as one line, without a traceback."""
    with contextlib.suppress(
        AdvnerfError, OSError
    ):  # only what needs a cache fails without one; stopping the car does not
        use_writable_cache()
    os.environ.setdefault("MUJOCO_GL", "egl")  # for users' worlds that import MuJoCo themselves: no window
    words = sys.argv[1:]
    resumable = is_resumable(words)
    with ends_in_order() if resumable else contextlib.nullcontext():
        code = _exit_code()
    if resumable and code and _is_signal(code):
        say_error(how_to_resume(words))
    raise SystemExit(code)


def _is_signal(code: object) -> bool:
    from advnerf_core.plugins import is_signal  # for what ends early, too much to load at each start

    return is_signal(code)


def _exit_code() -> int:
    try:
        ended = app(standalone_mode=False)
    except KeyboardInterrupt:
        return INTERRUPTED
    except SystemExit as asked:
        # rich and click end so where `head` has read enough
        if isinstance(asked.__context__, BrokenPipeError):
            return FAILURE_EXIT
        return _code_of_exit(asked.code)
    except typer.Abort:
        say_error("aborted")
        return FAILURE_EXIT
    except ModuleNotFoundError as error:
        missing = (error.name or "").split(".")[0]
        if _debug or missing in OUR_PACKAGES or (command := installs(missing)) is None:
            raise
        say_error(f"this command needs {missing}, which is not installed: {command}")
        return ERROR_EXIT
    except Exception as error:
        return _code_of(error)
    return ended if isinstance(ended, int) else 0


def _code_of_exit(code: str | int | None) -> int:
    """Exit code of what ended by ``sys.exit``: a signal, the shell's completion before a command, or a user's code inside one."""
    if not _is_in_command:
        return code if isinstance(code, int) else FAILURE_EXIT if code else 0
    from advnerf_core.plugins import EXITED

    if isinstance(code, int) and _is_signal(code):
        return code

    say_error(f"{EXITED}({code or ''})")
    return ERROR_EXIT


def _code_of(error: Exception) -> int:
    """Print an error that the user can fix, and return its exit code; raise any other again."""
    if (usage := usage_text(error)) is not None:
        if usage:
            say_error(usage)
        return int(getattr(error, "exit_code", ERROR_EXIT))
    text = text_for_people(error)
    if _debug or text is None:
        raise error
    say_error(text)
    return ERROR_EXIT


if __name__ == "__main__":
    main()
