"""User options of a black-box method's student. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from advnerf_core.errors import AdvnerfError
from advnerf_core.policies.architecture import PILOTNET, Architecture, require_architecture


@dataclass(frozen=True)
class StudentOptions:
    """Options of the methods ``distilled`` and ``guided``.

    Attributes:
        student: Architecture of the student: a name, or ``file.py:Class`` relative to the working folder.
    """

    student: str = PILOTNET
    configuration: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        try:
            require_architecture(self.student, None, self.configuration)
        except AdvnerfError as error:
            raise ValueError(str(error)) from None

    @property
    def architecture(self) -> Architecture:
        """The architecture with its settings."""
        return Architecture(self.student, self.configuration)
