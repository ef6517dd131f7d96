"""Messages for tests: as with ROS's own classes, fields that are not named are zero."""

from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from nodes.runtime.messages import fields_of, message_class


def filled(kind: Any, **fields: Any) -> Any:
    """A message of a class of ``types`` with these fields; the others are zero, empty or False."""
    zeros = {name: _zero(node) for name, node in fields_of(kind.__msgtype__) or [] if name not in fields}
    return kind(**zeros, **fields)


def _zero(node: Any) -> Any:
    kind, what = node
    if kind == Nodetype.NAME:
        return filled(message_class(what))
    if kind == Nodetype.BASE:
        name = what[0]
        return "" if name == "string" else np.zeros((), name)[()].item()
    element, count = what[0], what[1] if kind == Nodetype.ARRAY else 0
    if element[0] == Nodetype.BASE and element[1][0] != "string":
        return np.zeros(count, element[1][0])
    return [_zero(element) for _ in range(count)]
