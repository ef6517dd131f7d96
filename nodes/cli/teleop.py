"""The command ``advnerf car teleop``, which lets the car drive while a button is held."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nodes.runtime.terminal import RunDir


def teleop(
    gamepad: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            help="Path of a gamepad: /dev/input/by-id/...-event-joystick.",
            show_default="the keyboard",
        ),
    ] = None,
    run_dir: RunDir = None,
    speed_mps: Annotated[
        float, typer.Option("--speed", min=0.05, max=2.0, help="Speed at full throttle [m/s].")
    ] = 0.8,
) -> None:
    """Drive the car of a running launch while a button is held. Releasing the button stops it."""
    import sys

    from hardware.operator.keyboard import HELP
    from nodes.launching.watching import find_run_dir
    from nodes.runtime.errors import ConfigError
    from nodes.runtime.node import NodeContext
    from nodes.runtime.process import run_node
    from nodes.teleop import TeleopConfig, TeleopNode

    if gamepad is None and not sys.stdin.isatty():
        raise ConfigError(
            "expected a terminal to read keys from, got none; run the command in a terminal, or give --gamepad"
        )
    config = TeleopConfig(device=gamepad or "keyboard", speed_mps=speed_mps)
    folder = find_run_dir(run_dir)
    print(
        HELP
        if gamepad is None
        else "hold LB: drive by hand, hold RB: let the software drive, B: e-stop, Start: re-arm"
    )

    def build(context: NodeContext) -> TeleopNode:
        return TeleopNode.build(config, context)

    raise typer.Exit(run_node(build, "teleop", folder))
