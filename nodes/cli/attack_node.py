"""The commands ``advnerf attack request`` and ``advnerf attack cancel``: they speak to a running attack node."""

from __future__ import annotations

import math
from typing import Annotated, Any

import typer

from advnerf_core.attack.objectives import CTE
from nodes.cli.attack import RequestFile
from nodes.runtime.terminal import Overrides, RunDir, fail_unless


def attack_request(
    file: RequestFile,
    run_dir: RunDir = None,
    request_id: Annotated[
        str,
        typer.Option(
            "--id", help="Name of the request; the same again goes on.", show_default="<name>-<time>"
        ),
    ] = "",
    follow: Annotated[bool, typer.Option(help="Wait for the end; Ctrl-C only stops waiting.")] = True,
    overrides: Overrides = None,
) -> None:
    """Ask the attack node of a running launch for an attack; the compositor takes it over when it is found."""
    from nodes.experiment.node.client import ask_for_attack, new_request_id
    from nodes.experiment.node.prepare import load_request, request_text
    from nodes.launching.watching import find_run_dir

    request = load_request(file, overrides or [])
    name = request_id or new_request_id(request.config.name)
    print(f"request {name}", flush=True)
    seen: set[Any] = set()

    def tell(progress: Any) -> None:
        key = (progress.state, progress.seed, progress.evaluation)
        if key not in seen:
            seen.add(key)
            print(in_words(progress), flush=True)

    last = ask_for_attack(find_run_dir(run_dir), request_text(request), name, tell, follow)
    fail_unless(last.state not in ("failed", "refused", "cancelled"))


def attack_cancel(
    run_dir: RunDir = None,
    request_id: Annotated[
        str, typer.Option("--id", help="Only this request.", show_default="whichever it is")
    ] = "",
    reason: Annotated[str, typer.Option(help="Why, for the record.")] = "",
) -> None:
    """End the search of a running attack node; its results up to then stay in its folder."""
    from nodes.experiment.node.client import cancel_attack
    from nodes.launching.watching import find_run_dir

    answer = cancel_attack(find_run_dir(run_dir), request_id, reason)
    print(in_words(answer))
    fail_unless(answer.state != "refused")


def in_words(progress: Any) -> str:
    """A line about an ``AttackProgress``; values of its objective stand beside that without an attack."""
    what = " ".join(filter(None, (progress.state, progress.text)))
    objective = "total CTE" if progress.objective in ("", CTE) else progress.objective
    if progress.state == "done":
        return f"done: attack {progress.attack_id}, best {objective} {_value(progress, progress.best_value)}{_beside(progress)} ({progress.text})"
    if progress.evaluation:
        return (
            f"{what} seed {progress.seed}: {progress.evaluation}/{progress.evaluations}, {objective} "
            f"{_value(progress, progress.value)}, best {_value(progress, progress.best_value)}{_beside(progress)}"
        )
    return what


def _value(progress: Any, value: float) -> str:
    digits = f"{value:.2f}" if progress.objective in ("", CTE) else f"{value:.4g}"
    return f"{digits} {progress.unit}"


def _beside(progress: Any) -> str:
    """The drive without an attack; empty before it is known."""
    if math.isnan(progress.clean_value):
        return ""
    none = "" if progress.clean_drives else ": NO DRIVE, so the value of an attack proves nothing"
    return f", without attack {_value(progress, progress.clean_value)}{none}"
