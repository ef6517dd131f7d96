"""Which settings of an experiment each stage reads while it runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from nodes.experiment.plan.config import ExperimentConfig
from tests.support.stage_versions import models_in


class Reads:
    """What was read of the experiment file, ``section.key``, by stage; given to `make_ready` as its watcher."""

    def __init__(self) -> None:
        self.of: dict[str, set[str]] = {}
        self._stage = ""

    def start(self, stage: str) -> Callable[..., None]:
        """A stage begins."""
        self._stage = stage
        self.of[stage] = set()
        return lambda *progress: None

    def finish(self, stage: str, seconds: float, cached: bool) -> None:
        """A stage has ended."""
        self._stage = ""

    def note(self, key: str) -> None:
        """A key was read."""
        if self._stage:
            self.of[self._stage].add(key)


@contextmanager
def recording() -> Iterator[Reads]:
    """Note what is read of sections that are models, until the end of the block."""
    reads = Reads()
    sections = {
        model: f"{name}."
        for name, field in ExperimentConfig.model_fields.items()
        for model in models_in(field.annotation)
    }
    own = {model: model.__dict__.get("__getattribute__") for model in (ExperimentConfig, *sections)}

    def watch(model: Any, section: str) -> None:
        def read(self: Any, name: str) -> Any:
            if name in model.model_fields and not (section == "" and f"{name}." in sections.values()):
                reads.note(section + name)
            return object.__getattribute__(self, name)

        model.__getattribute__ = read

    try:
        for model, section in {ExperimentConfig: "", **sections}.items():
            watch(model, section)
        yield reads
    finally:
        for model, before in own.items():
            if before is None:
                del model.__getattribute__
            else:
                model.__getattribute__ = before
