"""A Zenoh router for tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from nodes.linking.ros2.zenoh_settings import ZenohSettings
from tests.support.live.processes import free_ports

ENDPOINT = "ADVNERF_TEST_ZENOH"
"""Environment variable with the router's endpoint, for the programs that a test starts."""


def settings_of(transport: str) -> ZenohSettings:
    """Settings of a session that connects to the tests' router."""
    return ZenohSettings(connect=(os.environ[ENDPOINT],)) if transport == "zenoh" else ZenohSettings()


@contextmanager
def zenoh_router() -> Iterator[str]:
    """Run a router as ``rmw_zenohd`` does: the library of the same makers, in the mode of a router."""
    import zenoh

    from tests.support.live.strange_zenoh import config

    endpoint = f"tcp/localhost:{free_ports(1)[0]}"
    router, before = zenoh.open(config("router", listen=[endpoint])), os.environ.get(ENDPOINT)
    os.environ[ENDPOINT] = endpoint
    try:
        yield endpoint
    finally:
        router.close()
        os.environ.pop(ENDPOINT)
        if before is not None:
            os.environ[ENDPOINT] = before
