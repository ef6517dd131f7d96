"""Environments of third-party simulators: where they are installed, and whether they match their lock file.

``advnerf scene world install NAME`` creates one (`nodes.lab.worlds.install`); the worlds only look for its interpreter.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from advnerf_core.documents import read_json
from advnerf_core.files import sha256_of
from advnerf_core.places import user_place
from hardware.worlds.remote import SERVERS
from hardware.worlds.remote_errors import WorldNotInstalled

FOLDER_VARIABLE = "ADVNERF_WORLDS"
MADE = "advnerf.json"


@dataclass(frozen=True)
class Environment:
    """What a third-party world needs to run.

    Attributes:
        licence: Licence that the user accepts by installing it.
        pythons: Supported Python versions, the preferred one first.
        size_mb: Approximate installed size [MB].
        system: Debian packages that it also needs.
    """

    name: str
    title: str
    licence: str
    pythons: tuple[str, ...]
    size_mb: int
    system: tuple[str, ...] = ()

    @property
    def lock(self) -> Path:
        """The lock file: its packages with their versions."""
        return SERVERS / f"{self.name}.lock.txt"

    @property
    def simulator(self) -> Path:
        """The simulator's file for ``serve.py``."""
        return SERVERS / f"{self.name}.py"

    @property
    def folder(self) -> Path:
        """Installation folder: in ``$ADVNERF_WORLDS``, or in the user's data folder."""
        chosen = os.environ.get(FOLDER_VARIABLE)
        return (Path(chosen) if chosen else user_place("data") / "worlds") / self.name

    @property
    def interpreter(self) -> Path:
        """Path of its Python, whether installed or not."""
        return self.folder / "bin" / "python"

    @property
    def state(self) -> str:
        """``installed``, ``not installed``, or ``installed from another lock file``."""
        made = self.folder / MADE
        if not made.exists() or not self.interpreter.exists():
            return "not installed"
        fits = read_json(made).get("lock_sha256") == sha256_of(self.lock)
        return "installed" if fits else "installed from another lock file"

    def python(self) -> Path:
        """Path of its installed Python.

        Raises:
            WorldNotInstalled: It is not installed, or was installed from another lock file.
        """
        if (state := self.state) != "installed":
            raise WorldNotInstalled(
                f"expected the environment of the world {self.name} in {self.folder}; it is {state}: run `advnerf scene world install {self.name}`"
            )
        return self.interpreter


ENVIRONMENTS = {
    each.name: each
    for each in (
        Environment(
            "metadrive",
            "MetaDrive 0.3.0.1, with its models and textures",
            "MetaDrive is published under the Apache License 2.0 (https://github.com/metadriverse/metadrive). Single models and textures in it "
            "may be under terms of their own.",
            ("3.11", "3.10"),
            950,
            ("libegl1", "libgl1", "libgl1-mesa-dri"),
        ),
        Environment(
            "duckietown",
            "Duckietown's simulator (duckietown-gym-daffy 6.1.34), with its maps",
            "Duckietown's software is licensed for research and teaching only: commercial use is not allowed without a licence of the Duckietown "
            "Foundation. Read https://www.duckietown.org/about/sw-license before you install it.",
            ("3.11", "3.10"),
            870,
            ("libegl1", "libgl1", "libgl1-mesa-dri", "libglu1-mesa"),
        ),
        Environment(
            "filament",
            "MuJoCo 4.0.0 with its renderer Filament, which draws the lab",
            "MuJoCo and Filament are published under the Apache License 2.0 (https://github.com/google-deepmind/mujoco).",
            ("3.11", "3.12", "3.13"),
            200,
            ("libvulkan1", "mesa-vulkan-drivers"),
        ),
    )
}
"""Foreign worlds by kind."""
