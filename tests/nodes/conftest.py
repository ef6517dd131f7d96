"""What tests of nodes in this process share."""

from pathlib import Path

import pytest

from nodes.runtime.clock import SystemClock
from nodes.runtime.node import NodeContext


@pytest.fixture
def node_context(tmp_path: Path) -> NodeContext:
    """What the runtime gives a node that is built, with a run folder of its own and the real clock."""
    return NodeContext("node", tmp_path, SystemClock())
