"""Groups of commands whose ``--help`` lists them in titled panels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rich.markup import escape
from typer.core import TyperGroup


def in_panels(panels: Mapping[str, tuple[str, ...]]) -> type[TyperGroup]:
    """Make the class of a group that lists its commands by panel.

    Args:
        panels: Names of commands by the title of their panel, both in the order of ``--help``. Every command of the group has a panel.
    """
    title_of = {name: title for title, names in panels.items() for name in names}

    class PanelGroup(TyperGroup):
        def list_commands(self, ctx: Any) -> list[str]:
            return sorted(self.commands, key=list(title_of).index)

        def get_command(self, ctx: Any, cmd_name: str) -> Any:
            command: Any = super().get_command(ctx, cmd_name)
            if command is not None:
                command.rich_help_panel = title_of[cmd_name]
                _escape(command)
            return command

    return PanelGroup


def _escape(command: Any) -> None:
    """Keep units such as ``[s]`` in the help of a command and of those below it: Rich takes them for markup, and drops them."""
    for each in (command, *command.params):
        if getattr(each, "help", None):
            each.help = escape(each.help.replace("\\[", "["))  # groups in groups come here twice
    for below in getattr(command, "commands", {}).values():
        _escape(below)
