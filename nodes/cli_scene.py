"""The commands ``advnerf scene ...``: from photographs to a scene field."""

from __future__ import annotations

import typer

from nodes import cli_scene_import

app = typer.Typer(
    no_args_is_help=True, help="Scenes: posed images from videos, photographs and bags, and what is learned from them."
)
app.add_typer(cli_scene_import.app)
