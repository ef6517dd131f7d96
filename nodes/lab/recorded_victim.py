"""The recorded victim: a policy of the reference build, and a texture that a search found for it.

A demonstration shows its drive within a minute, while an experiment makes results of its own. Its pictures are labelled, and no
result of the experiment contains them.
"""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.attack.artifact import load_attack
from advnerf_core.documents import read_json
from advnerf_core.run_module import module_command
from nodes.runtime.paths import shipped
from nodes.runtime.termination import wait_or_kill

# In the run folder: the newest picture of the drive, its description, and the film, which has the suffix of its container.
FOLDER, NOW, ABOUT, FILM = "recorded", "now.jpg", "about.json", "clip"
LABEL = "Recorded victim: the policy and the texture are from the reference build, not from this run."
MISSING = "recorded victim: none comes with this installation; the first pictures are those of this run"
_END_S = 20.0

Say = Callable[[str], None]


@dataclass(frozen=True)
class RecordedVictim:
    """A policy and an attack on it.

    Attributes:
        attack: Attack file of the lab's board.
    """

    policy: Path
    attack: Path


def find_recorded(reference: Path | None = None) -> RecordedVictim | None:
    """The recorded victim of a reference build; None if it has no attack, or not the attacked policy.

    Args:
        reference: Folder of the build; None uses the one that comes with advnerf.
    """
    build = shipped("docs/results/reference") if reference is None else reference
    policies = {
        read_json(file)["sha256"]: file.with_suffix(".safetensors")
        for file in build.glob("policy_*/policy.json")
    }
    for file in sorted(build.glob("attack_*/attack.safetensors")):
        policy = policies.get(load_attack(file).policy_sha256)
        if policy is not None:
            return RecordedVictim(policy, file)
    return None


def recorded_state(run_folder: Path) -> dict[str, Any] | None:
    """Description of the recorded victim's drive in a run folder, for a page; None without one. Its file is named once it is there."""
    try:
        data = dict(read_json(run_folder / FOLDER / ABOUT))
        return data if (run_folder / data["file"]).is_file() else {**data, "file": ""}
    except (OSError, ValueError, KeyError, TypeError):
        return None


class FirstPicture:
    """Drives the recorded victim in a process of its own. Leaving the context ends it.

    Args:
        run_folder: Folder of the experiment, which gets a folder with the pictures.
        say: Called with each message, also from another thread.
    """

    def __init__(self, run_folder: Path, say: Say) -> None:
        self._folder, self._say = run_folder / FOLDER, say
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> FirstPicture:
        if film := next(self._folder.glob(f"{FILM}.*"), None):
            self._say(f"{LABEL} Film of an earlier start: {film}")
            return self
        if find_recorded() is None:
            self._say(MISSING)
            return self
        self._folder.mkdir(parents=True, exist_ok=True)
        with (self._folder / "log.txt").open("w", encoding="utf-8") as log:
            self._process = subprocess.Popen(
                module_command("nodes.lab.recorded_drive", str(self._folder)),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                start_new_session=True,  # Ctrl-C is for the experiment, which ends this
            )
        threading.Thread(target=self._pass_on, args=(self._process,), daemon=True).start()
        return self

    def __exit__(self, *raised: object) -> None:
        if self._process is None:
            return
        self._process.terminate()
        wait_or_kill(self._process, _END_S)

    def _pass_on(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            self._say(line.rstrip())
        if process.wait() > 0:
            self._say(f"recorded victim: its drive failed, see {self._folder / 'log.txt'}")
