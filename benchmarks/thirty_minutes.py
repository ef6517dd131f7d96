"""Half an hour live on the simulated lab: ``python -m benchmarks.thirty_minutes`` (35 minutes, real time).

The car drives a circle. Every ten seconds the counters and the memory of every node are noted in ``samples.jsonl`` of the run
folder. Asked afterwards: do nodes miss more ticks late than early, does memory grow after the warm-up, and is every message that
a topic's publisher numbered found again at every subscriber, as received, dropped, lost or refused?
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.car_nodes import resident_mb
from benchmarks.fault_campaign import VICTIMS, Graph
from benchmarks.results import record_row
from nodes.runtime.bus import Bus
from nodes.runtime.topics import topic

COMMAND = "python -m benchmarks.thirty_minutes"
# A circle of 1.23 m about the middle of the room: 0.25 m / tan(0.2).
START, STEERING_RAD = (0.0, -1.23, 0.0), 0.2
SETTINGS = ("record=true", "policy.module=benchmarks.straight_policy", f"policy.steering_rad={STEERING_RAD}")
NODES = (*VICTIMS, "recorder")
TOPICS = (
    "/camera/image_raw",
    "/vicon/car",
    "/compositor/image",
    "/policy/drive",
    "/safety/drive",
    "/motor/sent",
    "/motor/state",
)
SAMPLE_S, WARM_UP_S, GROWTH_LIMIT = 10.0, 180.0, 0.02
# Missed ticks in a hundred, late against early, that no trend explains.
TREND_LIMIT = 0.5
_OUTCOMES = ("received", "dropped", "lost", "refused")


class Numbers:
    """Sequence numbers of the topics, as a listener of its own sees them."""

    def __init__(self, folder: Path) -> None:
        self._bus = Bus(folder)
        for name in TOPICS:
            self._bus.subscribe(name)
        self.last: dict[str, int] = {}

    def look(self) -> None:
        """Take in what has come."""
        for received in self._bus.receive():
            self.last[received.topic] = received.info.sequence

    def close(self) -> None:
        """Stop listening."""
        self._bus.close()


def sample(graph: Graph, numbers: Numbers, began: float) -> dict[str, Any]:
    """Counters and memory of all nodes, with the numbers of the topics, now."""
    nodes = {}
    for name in NODES:
        status = graph.operator.seen[f"/status/{name}"]
        counters = dict(zip(status.counter_names, map(float, status.counter_values), strict=True))
        nodes[name] = {"rss_mb": resident_mb(int(status.pid)), "counters": counters}
    return {"t_s": time.monotonic() - began, "nodes": nodes, "numbers": dict(numbers.last)}


def live(graph: Graph, duration_s: float) -> tuple[list[dict[str, Any]], int]:
    """Drive for so long; the samples, and how often the car stopped and was armed again by a person."""
    numbers, stops, samples = Numbers(graph.folder), 0, []
    try:
        graph.operator.bus.subscribe("/status/recorder")
        graph.ready()
        graph.put_back(START)
        graph.operator.arm(20.0)
        began = time.monotonic()
        with (graph.folder / "samples.jsonl").open("w", buffering=1) as log:
            while (elapsed_s := time.monotonic() - began) < duration_s:
                due_s = began + (len(samples) + 1) * SAMPLE_S
                while time.monotonic() < due_s:
                    graph.operator.watch(0.1)
                    numbers.look()
                    if not graph.operator.armed:
                        stops += 1
                        print(f"{elapsed_s:.0f} s: stopped: {graph.operator.describe()}", flush=True)
                        graph.operator.arm(20.0)
                samples.append(sample(graph, numbers, began))
                log.write(json.dumps(samples[-1]) + "\n")
        return samples, stops
    finally:
        numbers.close()


def missed_trend(samples: list[dict[str, Any]]) -> dict[str, float]:
    """Missed ticks of each node in the last third, less those in the first, per hundred ticks."""
    third = max(1, len(samples) // 3)
    found = {}
    for name in NODES:
        counters = [s["nodes"][name]["counters"] for s in samples]
        if "ticks" in counters[0]:
            found[name] = _share(counters[-1 - third], counters[-1]) - _share(counters[0], counters[third])
    return found


def _share(a: dict[str, float], b: dict[str, float]) -> float:
    missed, done = b["ticks_missed"] - a["ticks_missed"], b["ticks"] - a["ticks"]
    return 100.0 * missed / max(1.0, missed + done)


def growth(samples: list[dict[str, Any]], warm_up_s: float) -> dict[str, float]:
    """Relative growth of each node's memory, from the minute after the warm-up to the last minute."""
    first = [s for s in samples if warm_up_s <= s["t_s"] <= warm_up_s + 60.0]
    last = [s for s in samples if s["t_s"] >= samples[-1]["t_s"] - 60.0]
    sizes = {
        name: [statistics.median(s["nodes"][name]["rss_mb"] for s in part) for part in (first, last)] for name in NODES
    }
    return {name: after / before - 1.0 for name, (before, after) in sizes.items()}


def unaccounted(samples: list[dict[str, Any]]) -> dict[str, float]:
    """Messages of each subscription that were numbered and not counted, beyond what was on its way; 0 where all were."""
    first, last, found = samples[0], samples[-1], {}
    for name in NODES:
        for item in (t for t in TOPICS if f"received {t}" in last["nodes"][name]["counters"]):
            counted = sum(
                last["nodes"][name]["counters"].get(f"{word} {item}", 0.0)
                - first["nodes"][name]["counters"].get(f"{word} {item}", 0.0)
                for word in _OUTCOMES
            )
            published = last["numbers"][item] - first["numbers"][item]
            # A status is up to 0.2 s old, the listener up to 0.1 s behind, at both ends.
            slack = 3.0 + 0.6 * (topic(item).rate_hz or 0.0)
            found[f"{name} {item}"] = max(0.0, abs(published - counted) - slack)
    return found


def main() -> None:
    """Measure and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--minutes", type=float, default=33.0)
    parser.add_argument("--trial", action="store_true", help="one minute without warm-up, nothing is recorded")
    options = parser.parse_args()
    duration_s, warm_up_s = (60.0, 0.0) if options.trial else (options.minutes * 60.0, WARM_UP_S)
    graph = Graph(Path(tempfile.mkdtemp(prefix="advnerf-")), SETTINGS)
    try:
        samples, stops = live(graph, duration_s)
    finally:
        graph.close()
    trend, grown, missing = missed_trend(samples), growth(samples, warm_up_s), unaccounted(samples)
    dropped = sum(
        v for s in samples[-1]["nodes"].values() for k, v in s["counters"].items() if k.startswith(("dropped", "lost"))
    )
    print(f"trend of missed ticks {trend}\ngrowth {grown}\nunaccounted {missing}\nstops {stops}, dropped {dropped:.0f}")
    if options.trial:
        return
    note = f"{options.minutes:g} minutes, {stops} stops, samples in {graph.folder}"
    worst = max(trend, key=lambda name: trend[name])
    record_row(
        "#4 half an hour live: missed ticks, last third less first", round(trend[worst], 3), "per 100 ticks",
        f"no trend (<= {TREND_LIMIT:g})", trend[worst] <= TREND_LIMIT, COMMAND, f"worst: {worst}; {note}",
    )  # fmt: skip
    fattest = max(grown, key=lambda name: grown[name])
    record_row(
        "#4 half an hour live: growth of memory after warm-up", round(100.0 * grown[fattest], 2), "%", "<= 2 %",
        grown[fattest] <= GROWTH_LIMIT, COMMAND, f"worst: {fattest}; {note}",
    )  # fmt: skip
    record_row(
        "#4 half an hour live: messages numbered and not counted", round(sum(missing.values())), "messages", "0",
        not any(missing.values()), COMMAND, f"{len(missing)} subscriptions, {dropped:.0f} drops counted; {note}",
    )  # fmt: skip


if __name__ == "__main__":
    main()
