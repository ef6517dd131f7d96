"""Cells over machines, with Ray. Every machine needs this package and the folders of the experiment, under the same paths."""

from __future__ import annotations

import logging
import os
import socket
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from nodes.runtime.errors import ConfigError

_CONNECT_S = 5.0
Wanted = TypeVar("Wanted")
Done = TypeVar("Done")


@contextmanager
def ray_session(address: str, cores: int) -> Iterator[int]:
    """Join a Ray cluster, or start one on this machine; yields the number of its cores.

    Args:
        address: ``host:port`` or ``auto``; empty takes the one in RAY_ADDRESS, or else starts one here.
        cores: Number of cores of a cluster that is started here.

    Raises:
        ConfigError: Ray is not installed, or no cluster answers at the address.
    """
    try:
        import ray
    except ModuleNotFoundError:
        raise ConfigError(
            "a Ray cluster needs ray, which is not installed: pip install 'advnerf[cluster]'"
        ) from None
    joining = address or os.environ.get("RAY_ADDRESS", "")
    _require_reachable(joining)
    try:
        if joining:
            ray.init(address=joining, log_to_driver=False, logging_level=logging.ERROR)
        else:
            ray.init(
                num_cpus=cores, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR
            )
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        raise ConfigError(
            f"expected a Ray cluster at {joining or 'this machine'}, got {' '.join(str(error).split())}; start one with ray start --head"
        ) from None
    try:
        yield int(ray.cluster_resources().get("CPU", 1))
    finally:
        ray.shutdown()


def _require_reachable(address: str) -> None:
    """Raise at once if no cluster answers: Ray itself tries for minutes."""
    host, separator, port = address.removeprefix("ray://").rpartition(":")
    if not separator or not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), _CONNECT_S).close()
    except OSError as error:
        raise ConfigError(
            f"expected a Ray cluster at {address}, got {error}; start one with ray start --head"
        ) from None


def run_on_ray(
    work: Callable[[Wanted], Done], jobs: Sequence[Wanted], at_a_time: int
) -> Iterator[tuple[Wanted, Done | None]]:
    """Run jobs on the current cluster.

    Args:
        work: Function of one job, which runs in a worker and returns something else than None.

    Yields:
        Each finished job, with the result; None if its machine was lost.

    Raises:
        ConfigError: A machine cannot run a job at all, for example without this package.
    """
    import ray
    from ray.exceptions import NodeDiedError, ObjectLostError, RayError, WorkerCrashedError

    run: Any = ray.remote(num_cpus=1, max_retries=0, scheduling_strategy="SPREAD")(
        lambda job: work(job)  # Ray takes a function, not any callable
    )
    waiting = deque(jobs)
    running: dict[Any, Wanted] = {}
    while waiting or running:
        while waiting and len(running) < at_a_time:
            job = waiting.popleft()
            running[run.remote(job)] = job
        ready, _ = ray.wait(list(running))
        job = running.pop(ready[0])
        try:
            end = ray.get(ready[0])
        except (NodeDiedError, ObjectLostError, WorkerCrashedError):
            end = None
        except RayError as error:
            raise ConfigError(
                f"expected every machine of the cluster to have this package and the experiment's folders, got {' '.join(str(error).split())[-500:]}"
            ) from None
        yield job, end
