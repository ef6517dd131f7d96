"""Mitsuba, imported when it is first needed, with the newest LLVM of the machine and no more threads than it may use."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from advnerf_core.errors import AdvnerfError
from advnerf_core.parallel import thread_count

VARIANT = "llvm_ad_rgb"
OLDEST_LLVM = 17  # 15 and 16 crash on processors with AVX-512
_LIBRARY = "DRJIT_LIBLLVM_PATH"
_FOLDERS = (
    "/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64", "/usr/lib", "/usr/local/lib", "/usr/lib/llvm-*/lib",
    "/opt/homebrew/opt/llvm*/lib",
)  # fmt: skip
_VERSION = re.compile(r"libLLVM(?:-|\.so\.|\.)(\d+)(?:\.(\d+))?")
_WHAT_TO_DO = f"install it (Debian, Ubuntu: sudo apt-get install libllvm19), or set {_LIBRARY} to a libLLVM of version {OLDEST_LLVM} or newer"


class MeshEngineError(AdvnerfError, RuntimeError):
    """Mitsuba, or the LLVM that it compiles with, is missing."""


@dataclass(frozen=True)
class Engine:
    """The modules of Mitsuba and of its compiler; the variant of ``mi`` is set."""

    mi: Any
    dr: Any


def engine(in_order: bool = False) -> Engine:
    """Mitsuba, ready for use.

    Args:
        in_order: Run on one thread, so that sums have the same bits each time; else on all available ones.

    Raises:
        MeshEngineError: The package or LLVM is missing.
    """
    loaded = _load()
    threads = 1 if in_order else _threads()
    if loaded.dr.thread_count() != threads:
        loaded.dr.set_thread_count(threads)
    return loaded


def newest_llvm(folders: Iterable[str] = _FOLDERS) -> Path | None:
    """The newest LLVM library in some folders (patterns); None if none is new enough."""
    found: list[tuple[tuple[int, int], str]] = []
    for folder in folders:
        for parent in sorted(Path("/").glob(folder.lstrip("/"))):
            for file in parent.glob("libLLVM*"):
                match = _VERSION.match(file.name)
                if match is not None and file.exists() and int(match[1]) >= OLDEST_LLVM:
                    found.append(((int(match[1]), int(match[2] or 0)), str(file)))
    return Path(max(found)[1]) if found else None


def _threads() -> int:
    """As many threads as the machine and OMP_NUM_THREADS allow."""
    asked = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    return min(int(asked), thread_count()) if asked.isdigit() and int(asked) else thread_count()


@lru_cache(maxsize=1)
def _load() -> Engine:
    newest = newest_llvm()
    if newest is not None:
        os.environ.setdefault(_LIBRARY, str(newest))
    try:
        import drjit
        import mitsuba
    except ImportError as error:
        raise MeshEngineError(
            f"attacks on meshes need Mitsuba, which cannot be imported ({error}): pip install 'advnerf[mesh]'"
        ) from error
    try:
        mitsuba.set_variant(VARIANT)
        drjit.eval(mitsuba.Float([0.0, 1.0]) + 1.0)
        version = drjit.detail.llvm_version()
    except (ImportError, RuntimeError) as error:
        raise MeshEngineError(
            f"attacks on meshes need LLVM, which Mitsuba cannot use here ({error}): {_WHAT_TO_DO}"
        ) from error
    if version[0] < OLDEST_LLVM:
        found = ".".join(map(str, version))
        raise MeshEngineError(
            f"attacks on meshes need LLVM {OLDEST_LLVM} or newer, Mitsuba found {found}: {_WHAT_TO_DO}"
        )
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return Engine(mitsuba, drjit)
