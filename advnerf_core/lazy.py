"""Public names of a package, imported when they are first asked for (PEP 562): ``import advnerf_core`` loads neither torch nor numpy."""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping


def lazy_names(
    package: str, names: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """The ``__getattr__`` and the ``__dir__`` of a package that has ``__all__``.

    Args:
        package: The package's ``__name__``.
        names: Public names, separated by spaces, by the module that defines them.
    """
    module_of = {name: module for module, found in names.items() for name in found.split()}

    def import_name(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(
                f"module {package!r} has no attribute {name!r}", name=name, obj=sys.modules[package]
            )
        value = getattr(importlib.import_module(module_of[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    return import_name, lambda: sorted(sys.modules[package].__all__)
