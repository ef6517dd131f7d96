"""The worlds of an experiment, captured and deployed: read, described, opened, and stored in its run folder."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path as FilePath
from typing import Any

from advnerf_core.documents import Document, read_json
from advnerf_core.driving.solids import Solids
from advnerf_core.files import write_json
from hardware.worlds.world import HasSolids, NotOpenError, Traits, World, WorldDescription
from nodes.experiment.engine.run_folder import RunFolder
from nodes.experiment.show.kept_worlds import KeptWorld, is_users, kept_world
from nodes.lab.worlds.named import NamedWorld, read_world, without
from nodes.runtime.errors import ConfigError

WORLD = "world.json"
# Fields in which two worlds must agree for the same attack to be deployed in both.
_SHARED = ("paths", "off_track_m", "car", "camera", "T_car_from_camera", "fence_m")


class NotCapturedError(ConfigError):
    """A world that must be open to be described was not captured yet."""


@dataclass(frozen=True)
class ExperimentWorld(RunFolder):
    """One resolved experiment, or one of its variants, with its worlds."""

    @cached_property
    def named_world(self) -> NamedWorld:
        """The world of the file, with its changes; its code is executed."""
        return self._read(self.config.world)

    def _read(self, section: dict[str, Any]) -> NamedWorld:
        return read_world(Document(section, str(self.file)), self.file.parent)

    @property
    def world_settings(self) -> dict[str, Any]:
        """The world's settings that results depend on, as JSON data."""
        return self._known_world.settings

    @cached_property
    def _known_world(self) -> NamedWorld | KeptWorld:
        return self._known(self.config.world)

    def _known(self, section: dict[str, Any]) -> NamedWorld | KeptWorld:
        if self.executes or not is_users(section):
            return self._read(section)
        return kept_world(self.folder, section, self.file.parent)

    @cached_property
    def traits(self) -> Traits:
        """Properties of the world that are known before it is opened."""
        return self._known_world.traits

    @cached_property
    def known_deployed(self) -> NamedWorld | KeptWorld:
        """The deployment's world, of which settings and traits are known before it is opened."""
        return self._known(self.config.deploy.world or self.config.world)

    @cached_property
    def solids(self) -> Solids | None:
        """Obstacles of the car, walls included; None if the world does not define them."""
        world = self.named_world.make()
        if not isinstance(world, HasSolids):
            return None
        return Solids(tuple(world.solids), world.car_body) if world.solids else None

    @property
    def seen_settings(self) -> dict[str, Any]:
        """The world's settings that its pictures and its description depend on, as JSON data."""
        return without(self.world_settings, self.traits.unseen)

    @cached_property
    def world(self) -> WorldDescription:
        """Paths, lanes, car and camera. The capture stage stores the description of a world that must be open for it.

        Raises:
            NotCapturedError: The world must be open for it, and nothing is captured yet.
        """
        try:
            return self._known_world.describe()
        except NotOpenError:
            kept = self._captured()
            if kept is None or kept["settings"] != self.seen_settings:
                raise NotCapturedError(
                    f"expected {self._kept_world} of this configuration, which the capture stage writes when the world {self.world_settings['kind']} is "
                    "open; run that stage first"
                ) from None
            return WorldDescription.from_dict(kept["description"])

    @property
    def is_described(self) -> bool:
        """Whether the world's description is available: not before the capture stage if the world must be open for it."""
        try:
            _ = self.world
        except NotCapturedError:
            return False
        return True

    def ask_world(self) -> None:
        """Open a world that must be open for its description, before the capture stage stores it; nothing is photographed."""
        if not self.is_described:
            with self.named_world.make() as world:
                vars(self)["world"] = world.describe()  # the place of the cached property

    @contextmanager
    def open_world(self) -> Iterator[World]:
        """The world, open; closed at the end.

        Raises:
            ConfigError: The world differs from the captured one.
        """
        with self.named_world.make() as world:
            kept, found = self._captured(), as_json(world.describe())
            if kept is not None and kept["settings"] == self.seen_settings and kept["description"] != found:
                differ = [name for name, value in found.items() if kept["description"].get(name) != value]
                raise ConfigError(
                    f"expected the world of {self._kept_world}, got one with other {', '.join(differ)}: open the world that was captured, or name "
                    "another run folder"
                )
            yield world

    @cached_property
    def deployed_world(self) -> NamedWorld:
        """The world of the deployment."""
        wanted = self.config.deploy.world
        return self.named_world if wanted is None else self._read(wanted)

    @property
    def named_worlds(self) -> list[tuple[dict[str, Any], NamedWorld]]:
        """The sections of the file that name a world, each with that world."""
        deployed = self.config.deploy.world
        found = [(self.config.world, self.named_world)]
        return found if deployed is None else [*found, (deployed, self.deployed_world)]

    @contextmanager
    def open_deployed_world(self) -> Iterator[World]:
        """The world of the deployment, open; closed at the end.

        Raises:
            ConfigError: The world has other paths, another camera or another car than the captured one.
        """
        if self.config.deploy.world is None:
            with self.open_world() as world:
                yield world
            return
        with self.deployed_world.make() as world:
            captured, found = as_json(self.world), as_json(world.describe())
            if differ := [name for name in _SHARED if captured[name] != found[name]]:
                raise ConfigError(
                    f"{self.file}: deploy.world: expected a world with the {', '.join(_SHARED)} of {self.named_world.kind}, got "
                    f"{self.deployed_world.kind} with other {', '.join(differ)}"
                )
            yield world

    def keep_world(self, world: World) -> None:
        """Write an open world's description into the capture stage's folder.

        Raises:
            ConfigError: The description has changed.
        """
        found = as_json(world.describe())
        write_json(self._kept_world, {"settings": self.seen_settings, "description": found})
        if as_json(self.world) != found:
            raise ConfigError(
                f"expected the world {self.named_world.kind} to say the same about itself every time, got something else once it was open; a world "
                "that must be asked raises NotOpenError before"
            )

    @property
    def _kept_world(self) -> FilePath:
        return self.stage_folder("capture") / WORLD

    def _captured(self) -> dict[str, Any] | None:
        if not self._kept_world.exists():
            return None
        kept: dict[str, Any] = read_json(self._kept_world)
        return kept


def as_json(description: WorldDescription) -> dict[str, Any]:
    """A description after a round trip through JSON."""
    data: dict[str, Any] = json.loads(json.dumps(description.to_dict()))
    return data
