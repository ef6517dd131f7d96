"""The searches of a round on the machines of a Ray cluster; all of them need this package and the audit's folder, under the same path."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from advnerf_core.errors import AdvnerfError
from advnerf_core.run_module import search_folder_last
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import search_cell
from nodes.experiment.run.cluster import ray_session, run_on_ray
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.run import load_experiment

HERE = "here"


@dataclass(frozen=True)
class SearchJob:
    """A search to run; plain data, so that it can go to another machine.

    Its run folder is that of the copy for searching; the search itself writes to ``folder``.
    """

    file: str
    setting: str
    overrides: tuple[str, ...]
    run_folder: str
    cell: Cell
    folder: str

    def experiment(self) -> Experiment:
        """The experiment of the setting."""
        return load_experiment(Path(self.file), self.setting, self.overrides, Path(self.run_folder))


def search_on_cluster(address: str, searches: Sequence[SearchJob]) -> None:
    """Run searches in parallel until all have written their results to their folders.

    Args:
        address: ``HOST:PORT`` of the head, ``auto`` for this machine's, or ``here`` to start one.

    Raises:
        ConfigError: The cluster does not answer, or a machine in it cannot run a search.
    """
    with ray_session("" if address == HERE else address, os.cpu_count() or 1) as cores:
        for _ in run_on_ray(partial(_search, os.getcwd()), searches, cores):
            pass  # a lost search has no results in its folder, and runs here


def _search(folder: str, wanted: SearchJob) -> bool:
    """One search, in a worker of the cluster; one that fails does so again where its results are read, with its error."""
    os.environ.setdefault("MUJOCO_GL", "egl")  # as the command line does, for users' worlds
    search_folder_last(folder)
    with contextlib.suppress(AdvnerfError):
        search_cell(wanted.experiment(), wanted.cell, Path(wanted.folder), lambda *told: None)
    return True
