"""How a command ends: one line for every error, and how to resume what was interrupted."""

from __future__ import annotations

import errno
import os
import re
import shlex
import traceback
from collections.abc import Sequence
from typing import Any

from advnerf_core.errors import AdvnerfError
from advnerf_core.files import PART, not_writable

INTERRUPTED = 130
# Commands that continue where they were stopped when they are given again. ``scene from-...`` say so themselves, with the folder.
_RESUMABLE = (
    ("demo",),
    ("audit",),
    ("experiment", "run"),
    ("experiment", "predict"),
    ("experiment", "maps"),
    ("attack", "run"),
    ("attack", "maps"),
    ("scene", "train"),
    ("policy", "train"),
    ("car", "trial"),
)

# Of outputs; inputs are checked as they are parsed.
_IN_THE_WAY = {
    FileExistsError: "a folder at {}, or nothing, got a file or a link to nothing",
    NotADirectoryError: "folders on the way to {}, got a file",
    IsADirectoryError: "a file at {}, or nothing, got a folder",
}
_FULL = (errno.ENOSPC, errno.EDQUOT)
_SHORT = re.compile(r"\d+ requested and \d+ written")  # what NumPy says of a full disk, without a number


def is_resumable(words: Sequence[str]) -> bool:
    """Whether the command with these words continues where it was stopped."""
    named = tuple(word for word in words if not word.startswith("-"))
    return any(named[: len(each)] == each for each in _RESUMABLE)


def how_to_resume(words: Sequence[str]) -> str:
    """Text for a command that was stopped."""
    return f"stopped; the same command continues: {shlex.join(['advnerf', *words])}"


def usage_text(error: Exception) -> str | None:
    """Text of an error in the words of a command line; None for another exception.

    These are errors of click. Some versions of typer contain a copy of click, so that the class is not fixed.
    """
    if not hasattr(error, "format_message"):
        return None
    if type(error).__name__ == "NoArgsIsHelpError":
        return ""  # the help was printed
    text = _with_value(error, str(error.format_message()).strip().rstrip("."))
    context = getattr(error, "ctx", None)
    help_of = "" if context is None else f"; see {context.command_path} --help"
    return f"{text[:1].lower()}{text[1:]}{help_of}"


def _with_value(error: Exception, text: str) -> str:
    """The text with the value that pydantic, which newer versions of typer parse with, leaves out; and how several are written."""
    found: list[dict[str, Any]] = getattr(error.__cause__, "errors", list)()
    text = text.replace(": Value error, ", ": ")
    about, short, wanted = text.partition(": Input should be ")
    if found and short:
        wanted = wanted.partition(", unable to parse")[0]
        kind = "" if wanted.startswith(("a ", "an ")) else "a value "
        text = f"{about}: expected {kind}{wanted}, got {found[0]['input']!r}"
    count = getattr(getattr(error, "param", None), "nargs", 1)
    if count > 1:
        text += f"; separate its {count} values by spaces"
    return re.sub(r"(requires \d+ arguments)$", r"\1, separated by spaces", text)


def text_for_people(error: Exception) -> str | None:
    """Text of an error that the user can fix; None if the exception is a bug, which keeps its traceback."""
    if isinstance(error, OSError) and (error.errno in _FULL or _SHORT.fullmatch(str(error))):
        where = f" of {error.filename}" if error.filename else ""
        return f"the disk{where} is full: free some space or choose another folder. Finished work is kept"
    if isinstance(error, OSError) and not isinstance(error, AdvnerfError) and error.filename:
        if _is_unwritable(error):
            return not_writable(error.filename, error)
        for kind, wanted in _IN_THE_WAY.items():
            if isinstance(error, kind):
                return f"expected {wanted.format(error.filename)}; choose another name"
    if isinstance(error, AdvnerfError | OSError):
        return str(error) or type(error).__name__
    from advnerf_core.code_files import was_raised_by_a_user  # as most commands end without

    if was_raised_by_a_user(error):
        from advnerf_core.plugins import in_one_line

        return f"your code has failed: {in_one_line(error)}; correct it, and give the same command again"
    return None


def _is_unwritable(error: OSError) -> bool:
    """Whether a file or folder could not be made. An input that cannot be read, which may have the same number, is there."""
    making = [frame.name for frame in traceback.extract_tb(error.__traceback__)][-1:]
    if making in (["mkdir"], ["makedirs"]) or os.fsdecode(error.filename).endswith(PART):
        return not isinstance(error, FileExistsError | NotADirectoryError)
    is_denied = error.errno in (errno.EACCES, errno.EPERM) and not os.path.isfile(error.filename)
    return error.errno == errno.EROFS or is_denied
