"""Start Python modules so that a folder's own ``hardware.py`` or ``nodes/`` never replaces ours.

``python -m`` searches the working folder first, and ``python -P`` does not exist before Python 3.11. This file, run as a script, searches
installed packages first and the working folder last: ``python run_module.py MODULE ARGUMENTS...``. It imports only built-in modules
before the search path is set, as its own folder comes first until then.
"""

from __future__ import annotations

import sys

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from importlib.machinery import ModuleSpec
    from types import ModuleType


class _LastOfAll:
    """Finds modules in folders that are searched after everything else.

    A folder at the end of ``sys.path`` is not last: the finder of an editable installation comes after the whole path.
    """

    folders: list[str] = []  # noqa: RUF012 - one list for the process

    @classmethod
    def find_spec(
        cls, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        from importlib.machinery import PathFinder

        return PathFinder.find_spec(name, cls.folders, target) if path is None else None


def module_command(module: str, *arguments: str) -> list[str]:
    """Command line that runs a module, ours or one in the user's working folder, in a separate Python."""
    return [sys.executable, __file__, module, *arguments]


def search_working_folder_last() -> None:
    """Let this process find modules in the working folder too, except for names of installed ones."""
    import os

    try:
        here = os.getcwd()
    except FileNotFoundError:  # the folder was removed
        return
    search_folder_last(here)


def search_folder_last(folder: str) -> None:
    """Let this process find modules in a folder too, except for names that it finds already."""
    if folder not in _LastOfAll.folders:
        _LastOfAll.folders.append(folder)
    if _LastOfAll not in sys.meta_path:
        sys.meta_path.append(_LastOfAll)


def main() -> None:
    """Run the module named by the first argument, as ``python -m`` does."""
    del sys.path[0]  # the folder of this file
    search_working_folder_last()
    # An empty entry, as of PYTHONPATH=":/other", is the working folder too.
    sys.path[:] = [folder for folder in sys.path if folder not in ("", *_LastOfAll.folders)]
    import runpy

    del sys.argv[0]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
