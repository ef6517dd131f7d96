"""The commands ``advnerf attack method ...``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import Overrides, fail_unless, print_findings

app = CommandGroup(no_args_is_help=True, help="Methods of attack: whether one keeps the contract.")


@app.callback()
def _group() -> None:
    """Methods of attack: whether one keeps the contract."""


@app.command("check")
def method_check(
    methods: Annotated[
        list[str],
        typer.Argument(
            metavar="METHOD...",
            help="A method of `advnerf experiment list methods`, or file.py:Name of your own.",
        ),
    ],
    overrides: Overrides = None,
) -> None:
    """Hold methods against the contract on a small attack: budget, seeds, resuming, what they write and what they need.

    --set gives the method's own options. Exit code 1 if a part of the contract is not met.
    """
    from advnerf_core.documents import Document
    from nodes.lab.method_check import check_method
    from nodes.lab.plugin_tables import say_code
    from nodes.runtime.config import apply_overrides

    document = Document({}, "command line")
    apply_overrides(document, overrides or [])
    met = True
    for reference in methods:
        say_code({"method": reference}, Path.cwd())
        findings = check_method(reference, document.data)
        print(f"{reference}:")
        met &= print_findings(findings)
    fail_unless(met)
