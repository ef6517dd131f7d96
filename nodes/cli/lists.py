"""The command ``advnerf experiment list``: what can be named in files and commands."""

from __future__ import annotations

from typing import Annotated

import typer

from nodes.runtime.terminal import fail_unless, print_table, say_error, table


def list_command(
    what: Annotated[
        str,
        typer.Argument(
            metavar="WHAT", help="methods, policies, worlds, cameras, ...; see the error of a wrong one."
        ),
    ],
) -> None:
    """List what can be named: built in, and of installed packages, with one line each and where it comes from.

    Exit code 1 if a name occurs twice.
    """
    from advnerf_core.plugins import PluginError, unknown
    from nodes.lab.plugin_tables import TABLES, names_twice, rows_of

    if what not in TABLES:
        raise PluginError(unknown(what, "list", TABLES))
    found = rows_of(TABLES[what])
    rows = table("name", "from", "what it is")
    for row in found:
        rows.add_row(row.name, row.origin, row.line)
    print_table(rows)
    problems = names_twice(found)
    for problem in problems:
        say_error(problem)
    fail_unless(not problems)
