"""The commands ``advnerf keys ...``: who may watch this host over the network, and who may drive."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.runtime.terminal import print_table, table

if TYPE_CHECKING:
    from nodes.linking.keys import KeyFolder

app = typer.Typer(no_args_is_help=True, help="Keys of hosts, and who may watch or drive over the network.")

Folder = Annotated[
    Path | None, typer.Option("--keys", help="Key folder.", show_default="advnerf/keys in the user's configuration")
]
Name = Annotated[str, typer.Argument(help="Name of the key: of a host or a person.")]


@app.command("new")
def keys_new(name: Name, folder: Folder = None) -> None:
    """Make a key pair for this host; prints the public half, to be allowed on the other host."""
    keys = _folder(folder)
    print(keys.new(name))


@app.command("allow")
def keys_allow(
    name: Name,
    right: Annotated[str, typer.Option("--to", help="watch, or drive (which includes watch).")] = "watch",
    public: Annotated[str | None, typer.Option("--public", help="Its public key, if it is not known here yet.")] = None,
    folder: Folder = None,
) -> None:
    """Let a key watch, or drive; a running launch takes it at its next try."""
    from nodes.linking.keys import RIGHTS
    from nodes.runtime.errors import SecurityError

    if right not in RIGHTS:
        raise SecurityError(f"--to {right}: expected {' or '.join(RIGHTS)}")
    keys = _folder(folder)
    if public is not None:
        keys.add(name, public)
    keys.allow(name, right)
    print(f"{name} may {right}")


@app.command("add")
def keys_add(name: Name, public: str, folder: Folder = None) -> None:
    """Remember the public key of a host that this one connects to."""
    _folder(folder).add(name, public)


@app.command("revoke")
def keys_revoke(
    name: Name,
    right: Annotated[str | None, typer.Option("--to", help="Only the right to drive.", show_default="all")] = None,
    folder: Folder = None,
) -> None:
    """Take a key's rights away; a running launch cuts it off within a second."""
    taken = _folder(folder).revoke(name, right)
    print(f"{name} may no longer {' or '.join(taken)}")


@app.command("list")
def keys_list(folder: Folder = None) -> None:
    """Show all keys and their rights."""
    rows = table("name", "may", "secret half here", "public key")
    for row in _folder(folder).rows():
        rows.add_row(row.name, ", ".join(row.rights) or "-", "yes" if row.ours else "no", row.public)
    print_table(rows)


def _folder(given: Path | None) -> KeyFolder:
    from nodes.linking.keys import KeyFolder, default_folder

    return KeyFolder(given or default_folder())
