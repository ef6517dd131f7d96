"""A copy of what is published, in a repository of its own with registrations committed first, and the tools of whoever changes it."""

from __future__ import annotations

import json
import random
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.documents import read_json
from advnerf_core.errors import AdvnerfError
from advnerf_core.report.conditions import CONTROLS
from advnerf_core.report.evidence.kept import KeptDrive
from advnerf_core.report.evidence.publishing import write_page
from advnerf_core.report.evidence.registration import FILE, Registration, read_withdrawn
from advnerf_core.report.evidence.results import read_evidence
from advnerf_core.report.evidence.verifying.digests import digests_of, write_beside, write_known_digest
from advnerf_core.report.evidence.verifying.layout import SET, sets_in
from advnerf_core.report.evidence.verifying.numbers import published_numbers
from advnerf_core.report.evidence.verifying.victims import read_declared
from benchmarks.page_numbers import write_list
from benchmarks.results import LedgerRow, write_pages

Data = dict[str, Any]
_SAYS = "The attack moves the car"
_GIT = (
    "git",
    "-c",
    "user.name=planter",
    "-c",
    "user.email=planter@example.org",
    "-c",
    "commit.gpgsign=false",
)


@dataclass(frozen=True)
class World:
    """A repository with published results.

    Attributes:
        root: Of the repository.
        name: Of the set that is changed.
        rng: Of the changes.
        again: Rows of the ledger as its kept data gives them.
        base: The last commit.
    """

    root: Path
    name: str
    rng: random.Random
    again: Sequence[LedgerRow] = ()
    base: list[str] = field(default_factory=list)

    @property
    def published(self) -> Path:
        """Folder of all sets."""
        return self.root / "docs" / "results"

    @property
    def folder(self) -> Path:
        """Folder of the set."""
        return self.published / self.name

    @property
    def true_history(self) -> Path:
        """Where the history lies while another one stands in its place."""
        return self.root.parent / "true_history.git"

    @property
    def ledger(self) -> Path:
        """The file of the rows."""
        return self.root / "docs" / "results.json"

    def git(self, *arguments: str) -> str:
        """Run git in the repository."""
        command = [*_GIT, "-C", str(self.root), *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    def commit(self, *paths: str) -> None:
        """Commit some paths as they are."""
        self.git("add", "-A", "--", *paths)
        self.git("commit", "-q", "--allow-empty", "-m", "x")

    def begin(self) -> None:
        """Commit the registrations, then everything."""
        self.git("init", "-q")
        self.commit(*(f"docs/results/{name}/{FILE}" for name in sets_in(self.published)))
        self.commit(".")
        self.base[:] = [self.git("rev-parse", "HEAD").strip()]

    def restore(self) -> None:
        """Undo all changes, also committed ones and those of the whole history."""
        if self.true_history.exists():
            shutil.rmtree(self.root / ".git")
            shutil.move(self.true_history, self.root / ".git")
        self.git("reset", "-q", "--hard", self.base[0])
        self.git("clean", "-fdq")

    def registration(self) -> Registration:
        """Of the set."""
        return Registration.model_validate(read_json(self.folder / FILE))

    def some_cell(self, wanted: Callable[[Data], bool] = lambda cell: True) -> tuple[Path, Data]:
        """Some cell of the set, its file and its data."""
        files = sorted(self.folder.glob("*.json"))
        self.rng.shuffle(files)
        return next((file, data) for file in files if wanted(data := read_json(file)))

    def some_search(self) -> tuple[Path, Data]:
        """Some cell with an attack."""
        return self.some_cell(is_searched)

    def some_drive(self, data: Data, domain: str = "") -> tuple[str, int]:
        """A domain and a number of a drive of a cell."""
        domain = domain or self.rng.choice(sorted(data["kept"]))
        return domain, self.rng.randrange(len(data["kept"][domain]))

    def put(self, file: Path, data: object) -> None:
        """Write a file of the set or beside it."""
        file.write_text(json.dumps(data, indent=1) + "\n")

    def renew_digests(self) -> None:
        """Write all digests again."""
        manifest = read_json(self.folder / SET)
        self.put(self.folder / SET, {**manifest, "files": digests_of(self.folder)})
        write_known_digest(self.folder)
        write_beside(self.published)

    def renew_all(self) -> None:
        """Write numbers, page and digests again, with the project's own code."""
        try:
            evidence = read_evidence(self.folder)
            numbers = published_numbers(evidence, read_withdrawn(self.folder), read_declared(self.folder))
            self.put(self.folder / SET, {**numbers, "files": {}})
            self.renew_digests()
            write_page(self.published)
            self.write_readme()
            self.renew_rows(read_json(self.ledger))
            write_list(self.root / "docs", read_json(self.ledger))
        except (AdvnerfError, ValueError, StopIteration):  # no numbers of what is damaged
            self.renew_digests()

    def write_readme(self) -> None:
        """Tell a result of the set at the end of README."""
        excess_m = read_json(self.folder / SET)["rows"][-1]["excess_m"]
        file = self.root / "README.md"
        lines = file.read_text().splitlines()
        before = [line for line in lines if not line.startswith(_SAYS)]
        file.write_text("\n".join([*before, f"{_SAYS} {excess_m:.3f} m per tick."]) + "\n")

    def renew_rows(self, rows: list[Data]) -> None:
        """Write other rows and the pages of them."""
        self.put(self.ledger, rows)
        write_pages(rows, self.ledger.with_suffix(".md"), self.published)

    def register_again(self, data: Data) -> None:
        """Write another registration, under which all cells say that they were run."""
        digest = Registration.model_validate(data).digest
        self.put(self.folder / FILE, data)
        for file in self.folder.glob("*.json"):
            cell = read_json(file)
            if cell.get("registration"):
                self.put(file, {**cell, "registration": digest})

    def set_drive(self, data: Data, domain: str, number: int, poses: NDArray[np.float64]) -> None:
        """Give a cell another drive, with the totals and notes that it has."""
        scenario = self.registration().scenarios[data["scenario"]]
        old = KeptDrive.model_validate(data["kept"][domain][number])
        command = np.array(old.command.split(), float)
        drive = KeptDrive.of(poses, old.driven_ticks, command, old.collided, old.collided_with)
        found = drive.metrics(scenario.reference_path(), scenario.horizon)
        data["kept"][domain][number] = drive.model_dump()
        data[domain]["total_cte_m"][number] = found.total_cte_m
        data[domain]["off_track"][number] = found.off_track
        if domain == "deployed":
            drives = [KeptDrive.model_validate(each) for each in data["kept"]["deployed"]]
            largest = [each.metrics(scenario.reference_path(), scenario.horizon).max_cte_m for each in drives]
            data["extra"]["max_abs_cte_m"] = max(largest)


def is_searched(data: Data) -> bool:
    """Whether a cell has an attack."""
    return data["method"] not in CONTROLS


def poses_of(data: Data, domain: str, number: int) -> NDArray[np.float64]:
    """Poses ``[T + 1, 3]`` of a drive of a cell."""
    return KeptDrive.model_validate(data["kept"][domain][number]).poses()


def copy_published(source: Path, root: Path) -> None:
    """Copy the pages, rows and results of a repository."""
    shutil.copytree(source / "docs", root / "docs")
    shutil.copy(source / "README.md", root / "README.md")


__all__ = ["Data", "World", "copy_published", "is_searched", "poses_of"]
