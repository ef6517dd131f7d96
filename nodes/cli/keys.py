"""The commands ``advnerf car keys ...``: which keys may watch this host over the network, and which may drive."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import print_table, table

if TYPE_CHECKING:
    from nodes.linking.keys import KeyFolder

app = CommandGroup(
    no_args_is_help=True, help="Manage the keys that may watch or drive this host over the network."
)

Folder = Annotated[
    Path | None,
    typer.Option(
        "--folder", help="Key folder.", show_default="advnerf/keys in the user's configuration folder"
    ),
]
Name = Annotated[str, typer.Argument(help="Name of the key, such as a host or a person.")]


@app.command("new")
def keys_new(name: Name, folder: Folder = None) -> None:
    """Create a key pair for this host and print its public key. Allow that key on the other host."""
    keys = _folder(folder)
    print(keys.new(name))


@app.command("allow")
def keys_allow(
    name: Name,
    right: Annotated[
        str, typer.Option("--right", help="Its right: to watch alone, or to drive (which includes watching).")
    ] = "watch",
    public: Annotated[str | None, typer.Option(help="Public key, if this host does not have it yet.")] = None,
    folder: Folder = None,
) -> None:
    """Allow a key to watch or to drive. A running launch accepts the key at its next connection attempt."""
    keys = _folder(folder)
    if public is not None:
        keys.add(name, public)
    lost = keys.allow(name, right)
    print(f"{name} may {right}" + f", and no longer {' or '.join(lost)}" * bool(lost))


@app.command("add")
def keys_add(
    name: Name,
    public: Annotated[str, typer.Argument(help="Public key, as `advnerf car keys new` prints it.")],
    folder: Folder = None,
) -> None:
    """Store the public key of a host that this host connects to."""
    _folder(folder).add(name, public)


@app.command("revoke")
def keys_revoke(
    name: Name,
    right: Annotated[
        str | None, typer.Option("--right", help="Revoke only this right (drive).", show_default="all")
    ] = None,
    folder: Folder = None,
) -> None:
    """Revoke a key's rights. A running launch disconnects the key within a second."""
    taken = _folder(folder).revoke(name, right)
    print(f"{name} may no longer {' or '.join(taken)}")


@app.command("list")
def keys_list(folder: Folder = None) -> None:
    """List all keys and their rights."""
    rows = table("name", "may", "secret key here", "public key")
    for row in _folder(folder).rows():
        rows.add_row(row.name, ", ".join(row.rights) or "-", "yes" if row.ours else "no", row.public)
    print_table(rows)


def _folder(given: Path | None) -> KeyFolder:
    from nodes.linking.keys import KeyFolder, default_folder

    return KeyFolder(given or default_folder())
