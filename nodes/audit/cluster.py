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
from nodes.audit.searching import SearchJob
from nodes.experiment.run.cells import search_cell
from nodes.experiment.run.cluster import ray_session, run_on_ray

HERE = "here"


@dataclass(frozen=True)
class Cluster:
    """The cluster that runs the searches of a round in parallel.

    Attributes:
        address: ``HOST:PORT`` of the head, ``auto`` for this machine's, or ``here`` to start one.
    """

    address: str

    def search(self, searches: Sequence[SearchJob]) -> None:
        """Run searches until all have written their results to their folders.

        Raises:
            ConfigError: The cluster does not answer, or a machine in it cannot run a search.
        """
        session = ray_session("" if self.address == HERE else self.address, os.cpu_count() or 1)
        with session as cores:
            for _ in run_on_ray(partial(_search, os.getcwd()), searches, cores):
                pass  # a lost search has no results in its folder, and runs here


def _search(folder: str, wanted: SearchJob) -> bool:
    """One search, in a worker of the cluster; one that fails does so again where its results are read, with its error."""
    os.environ.setdefault("MUJOCO_GL", "egl")  # as the command line does, for users' worlds
    search_folder_last(folder)
    with contextlib.suppress(AdvnerfError):
        search_cell(wanted.experiment(), wanted.cell, Path(wanted.folder), lambda *told: None)
    return True
