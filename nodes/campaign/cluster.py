"""Cells over machines: joblib with its Ray backend. Every machine needs this package and the folders of the campaign, under the same paths."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import joblib

from nodes.campaign.worker import Ended, Job, run_in_process
from nodes.runtime.errors import ConfigError


@contextmanager
def ray_session(address: str, cores: int) -> Iterator[int]:
    """Join a Ray cluster, or start one on this machine; gives the number of its cores.

    Args:
        address: ``host:port`` or ``auto``; empty takes the one in RAY_ADDRESS, or else starts one here.
        cores: Of a cluster that is started here.

    Raises:
        ConfigError: Ray is not installed, or there is no cluster at the address.
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise ConfigError("--backend ray needs ray, which is not installed: pip install 'advnerf[cluster]'") from None
    joining = address or os.environ.get("RAY_ADDRESS", "")
    try:
        if joining:
            ray.init(address=joining, log_to_driver=False, logging_level=logging.ERROR)
        else:
            ray.init(num_cpus=cores, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        raise ConfigError(
            f"expected a Ray cluster at {joining or 'this machine'}, got {' '.join(str(error).split())}; start one with ray start --head"
        ) from None
    try:
        yield int(ray.cluster_resources().get("CPU", 1))
    finally:
        ray.shutdown()


def collect_on_ray(jobs: list[Job], at_a_time: int, tell: Callable[[Ended], Ended]) -> list[Ended]:
    """Run jobs on the cluster in force; what a lost machine took with it is missing from what is returned."""
    from ray.exceptions import RayError
    from ray.util.joblib import register_ray

    register_ray()
    ended: list[Ended] = []
    with joblib.parallel_config(backend="ray", n_jobs=at_a_time):
        parallel = joblib.Parallel(batch_size=1, return_as="generator_unordered", pre_dispatch="all")
        try:
            for end in parallel(joblib.delayed(run_in_process)(job) for job in jobs):
                ended.append(tell(end))
        except RayError:
            return ended
    return ended
