"""No stop is lost when something has run out. In full 20 stops of each kind; small, one."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.campaigns.campaign import Campaign
from tests.campaigns.stops import CELLS, RESOURCES, measure, rig_of

VERDICT_LIMIT_MS = 1000.0
# Nodes that are late on a busy computer stop the car, as they should, and then no request is needed.
TRIES = 5


def stops(repeats: int) -> Iterator[dict[str, Any]]:
    """Stops of all origins, kinds and exhausted resources."""
    for teleop in (False, True):
        with rig_of(teleop) as (rig, browser, keys):
            for origin, kind in (cell for cell in CELLS if (cell[0] == "teleop") == teleop):
                for what in RESOURCES:
                    for _ in range(repeats):
                        for _ in range(TRIES):
                            row = measure(rig, origin, kind, what, browser, keys)
                            if row["brake_ms"] is not None or not row["stopped_before"]:
                                break
                        row = {"origin": origin, "kind": kind, "resource": what, **row}
                        print(json.dumps(row), flush=True)
                        yield row


@pytest.mark.campaign
def test_no_stop_is_lost_when_something_has_run_out(campaign: Campaign) -> None:
    rows = list(stops(campaign.size(1, 20)))
    lost = [row for row in rows if row["brake_ms"] is None]
    brakes = [row["brake_ms"] for row in rows if row["brake_ms"] is not None]
    # A command and a trial first start a Python process; their brake is counted from the start of that process.
    nodes = [
        row["brake_ms"]
        for row in rows
        if row["brake_ms"] is not None and row["origin"].startswith(("page", "teleop"))
    ]
    late = [row for row in rows if row["origin"] != "trial" and row["word_ms"] > VERDICT_LIMIT_MS]
    campaign.record(
        "stops with an exhausted resource, brake at the controller",
        len(brakes),
        f"of {len(rows)}",
        f"{len(rows)} of {len(rows)}, every caller answered within a second",
        not lost and not late,
        f"{len(CELLS) * len(RESOURCES)} cells of origin, kind and resource; brake p99 {np.percentile(brakes, 99):.0f} ms, "
        f"worst {max(brakes):.0f} ms; from page and teleop p99 {np.percentile(nodes, 99):.0f} ms, worst {max(nodes):.0f} ms; "
        f"{sum(row['word'] == 'CONFIRMED' for row in rows)} read CONFIRMED, {len(late)} read nothing within a second",
    )
    assert lost == []
