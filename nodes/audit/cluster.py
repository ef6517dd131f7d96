"""The searches of a round on the machines of a Ray cluster; all of them need this package and the audit's folder, under the same path."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from advnerf_core.run_module import search_folder_last
from nodes.audit.searching import SearchJob
from nodes.experiment.run.cells import search_cell
from nodes.experiment.run.cluster import ray_session
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError

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
        with ray_session("" if self.address == HERE else self.address, os.cpu_count() or 1):
            import ray
            from ray.exceptions import RayError

            run = ray.remote(num_cpus=1, scheduling_strategy="SPREAD")(_search)
            try:
                ray.get([run.remote(each, os.getcwd()) for each in searches])
            except RayError as error:
                raise ConfigError(
                    f"expected every machine of the cluster to have this package and the audit's folder, got {' '.join(str(error).split())[-500:]}"
                ) from None


def _search(wanted: SearchJob, folder: str) -> None:
    """One search, in a worker of the cluster."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    search_folder_last(folder)
    experiment = load_experiment(
        Path(wanted.file), wanted.setting, list(wanted.overrides), Path(wanted.run_folder)
    )
    search_cell(experiment, wanted.cell, Path(wanted.folder), lambda *told: None)
