"""Cameras of users: an entry point of the group ``advnerf.cameras``, or ``file.py:Class``.

The class derives from `hardware.cameras.interface.Camera`. Its attribute ``Config``, a pydantic model or a dataclass, defines the keys
beside ``kind``; the class is called with it. See docs/cameras.md.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NoReturn

from pydantic import BaseModel, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from advnerf_core.plugins import PluginError, require_known, resolve
from advnerf_core.strict import COMPLETE, is_of_settings, strict_validator
from hardware.cameras.interface import Camera
from hardware.cameras.source import Source

GROUP = "advnerf.cameras"
_PAGE = "docs/cameras.md"


class ForeignSource(Source):
    """A camera of a user or of another package.

    Attributes:
        kind: Entry point or ``file.py:Class``, as the user wrote it.
        camera_class: The camera's class.
        config: The class's validated ``Config``.
    """

    kind: str
    camera_class: Any
    config: Any

    def camera(self) -> Camera:
        """Make the camera."""
        made: Camera = self.camera_class(self.config)
        return made

    def period_s(self) -> float:
        """Time between two frames by the key ``rate_hz``, if the camera has one [s]."""
        rate_hz = getattr(self.config, "rate_hz", None)
        return 1.0 / rate_hz if rate_hz else 0.0


def foreign_source(
    written: Mapping[str, Any], built_in: Collection[str], folder: Path | None = None
) -> ForeignSource | None:
    """The settings of a camera that is not built in.

    Args:
        written: The section ``source``: ``kind``, the camera's own keys, and the keys of every source.
        built_in: Kinds of the built-in cameras.
        folder: Folder that a relative ``file.py`` is relative to; the working folder if it is not given.

    Returns:
        The settings; None for a built-in kind.

    Raises:
        ValidationError: The camera is unknown or cannot be loaded, or one of its keys is unknown or wrong.
    """
    kind = written["kind"]
    try:
        require_known(kind, "camera", built_in, GROUP, folder)
        if kind in built_in:
            return None
        found = find_camera(kind, folder)
    except PluginError as error:
        _refuse("kind", str(error), kind)
    common = {name: value for name, value in written.items() if name in Source.model_fields}
    own = {name: value for name, value in written.items() if name not in (*common, "kind")}
    names = _keys_of(found.Config)
    for name, value in own.items():
        if name not in names:
            known = sorted((*names, "kind", *Source.model_fields))
            _refuse(name, f"unknown key of this camera; valid keys here: {', '.join(known)}", value)
    config = strict_validator(found.Config).validate_python(own, context={"folder": folder})
    return ForeignSource(kind=kind, camera_class=found, config=config, **common)


def find_camera(name: str, folder: Path | None = None) -> Any:
    """The class behind a camera's name.

    Raises:
        PluginError: The camera is unknown, cannot be loaded, or is not a class with a ``Config``.
    """
    found: Any = resolve(name, "camera", {}, GROUP, folder)
    if not (isinstance(found, type) and Camera in found.__mro__):
        what = f"the class {found.__name__}" if isinstance(found, type) else f"{found!r:.60}"
        raise PluginError(
            f"camera {name}: expected a class that derives from hardware.cameras.interface.Camera, got {what}; see {_PAGE}"
        )
    if not is_of_settings(getattr(found, "Config", None)):
        raise PluginError(
            f"camera {name}: expected an attribute Config with its keys, a pydantic model or a dataclass (empty if it has none), got none; see {_PAGE}"
        )
    missing = [name for name in ("open", "read", "close") if getattr(found, name) is getattr(Camera, name)]
    if missing:
        raise PluginError(
            f"camera {name}: expected a class that defines open, read and close, got none of {', '.join(missing)}; see {_PAGE}"
        )
    try:
        inspect.signature(found).bind(None)
    except TypeError as error:
        raise PluginError(
            f"camera {name}: expected a class that is called with its Config alone, got another __init__ ({error}); see {_PAGE}"
        ) from None
    return found


def _keys_of(config: Any) -> list[str]:
    if issubclass(config, BaseModel):
        return [each.alias or name for name, each in config.model_fields.items()]
    return [each.name for each in dataclasses.fields(config) if each.init]


def _refuse(key: str, message: str, value: Any) -> NoReturn:
    problem = PydanticCustomError(COMPLETE, "{text}", {"text": message})
    raise ValidationError.from_exception_data(
        "source", [InitErrorDetails(type=problem, loc=(key,), input=value)]
    )
