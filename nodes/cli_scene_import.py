"""The commands ``advnerf scene from-...``: posed images (``transforms.json``) out of what a person has recorded."""

from __future__ import annotations

import typer

app = typer.Typer()
