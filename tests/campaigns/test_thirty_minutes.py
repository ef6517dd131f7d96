"""Half an hour live with the trained policy on the simulated lab: 35 minutes in full, real time.

The policy of the demo drives lap after lap, and everything is recorded (7 GB under ``runs/thirty_minutes``). It needs a policy:
``advnerf experiment run launch/room.experiment.yaml --until policy --setting demo --folder runs/demo`` trains it in about 17 minutes on 2 cores.

Every ten seconds the counters and the memory of every node are noted in ``samples.jsonl``. Asked afterwards: does the car stop
without being told to, does any node miss a tick, does memory grow after the warm-up, and is every message that a topic's publisher
numbered found again at every subscriber, as received, dropped, lost or refused? The drive itself is measured from the bag, which
the recorder has split into many files.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import statistics
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.car_nodes import resident_mb
from calibration.schema import RoomCalibration, load_calibration
from nodes.bags.reader import read_info, read_messages
from nodes.bags.writer import BagWriter, SplitLimits
from nodes.runtime.bus import Bus
from nodes.runtime.messages import decode, encode, pose_matrix, pose_message
from nodes.runtime.topics import topic
from tests.campaigns.campaign import Campaign
from tests.campaigns.host_pauses import HostPauses
from tests.support.live.graph import VICTIMS, Graph
from tests.support.live.processes import REPOSITORY

POLICY = REPOSITORY / "runs" / "demo" / "policy" / "policy.safetensors"
ROOM = REPOSITORY / "calibration" / "twin" / "room.yaml"
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


@dataclass
class Stops:
    """When the car stopped without being told to [s since the beginning], and why.

    Attributes:
        found: All of them.
        by_host: How many came while the host withheld its processors (`tests.campaigns.host_pauses`).
    """

    found: list[tuple[float, str]] = field(default_factory=list)
    by_host: int = 0

    def describe(self) -> str:
        """The stops in words."""
        said = "; ".join(f"{t_s:.0f} s: {reason}" for t_s, reason in self.found[:5])
        return f"{len(self.found)} stops, {self.by_host} of them while the host paused" + (
            f" ({said})" if said else ""
        )


def live(graph: Graph, duration_s: float, pauses: HostPauses) -> tuple[list[dict[str, Any]], Stops]:
    """Drive for so long; the samples, and the stops after which a person armed again."""
    numbers, stops = Numbers(graph.folder), Stops()
    samples: list[dict[str, Any]] = []
    try:
        graph.operator.bus.subscribe("/status/recorder")
        graph.ready()
        graph.put_back()
        graph.operator.arm(20.0)
        began = time.monotonic()
        with (graph.folder / "samples.jsonl").open("w", buffering=1) as log:
            while time.monotonic() - began < duration_s:
                due_s = began + (len(samples) + 1) * SAMPLE_S
                while time.monotonic() < due_s:
                    graph.operator.watch(0.1)
                    numbers.look()
                    if not graph.operator.armed:
                        now_s = time.monotonic()
                        reason = str(graph.operator.seen["/safety/state"].reason).replace(
                            f"{graph.folder}/", ""
                        )
                        stops.found.append((now_s - began, reason))
                        stops.by_host += pauses.explain(now_s)
                        print(f"stopped: {stops.found[-1]}: {graph.operator.describe()}", flush=True)
                        graph.put_back()
                        graph.operator.arm(20.0)
                samples.append(sample(graph, numbers, began))
                log.write(json.dumps(samples[-1]) + "\n")
        return samples, stops
    finally:
        numbers.close()


def missed(samples: list[dict[str, Any]]) -> dict[str, int]:
    """Ticks that each node missed between the first sample and the last."""
    first, last = (s["nodes"] for s in (samples[0], samples[-1]))
    return {
        name: round(last[name]["counters"]["ticks_missed"] - first[name]["counters"]["ticks_missed"])
        for name in NODES
        if "ticks_missed" in first[name]["counters"]
    }


def describe_drive(bag: Path) -> str:
    """How far and how well the car drove, from its recording, in words."""
    info, rows = read_info(bag), []
    for message in read_messages(bag, ["/vicon/car"]):
        rows.append(pose_matrix(decode(topic("/vicon/car").type, message.cdr))[:2, 3])
    xy = np.array(rows)[::10]  # ten a second, so that the noise of a pose is no distance
    cte_m = np.abs(load_calibration(RoomCalibration, ROOM).reference_path.project(xy).cte_m)
    driven_m = float(np.linalg.norm(np.diff(xy, axis=0), axis=1).sum())
    return (
        f"{driven_m:.0f} m driven, mean |CTE| {cte_m.mean():.3f} m, largest {cte_m.max():.2f} m, "
        f"bag of {len(info.parts)} files and {info.size_bytes / 1e9:.1f} GB"
    )


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
        name: [statistics.median(s["nodes"][name]["rss_mb"] for s in part) for part in (first, last)]
        for name in NODES
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


def record(campaign: Campaign, samples: list[dict[str, Any]], stops: Stops, note: str) -> bool:
    """Write the rows; whether nothing but single ticks was lost."""
    trend, grown, missing, late = (
        missed_trend(samples),
        growth(samples, min(WARM_UP_S, samples[-1]["t_s"] / 2.0)),
        unaccounted(samples),
        missed(samples),
    )
    dropped = sum(
        v
        for s in samples[-1]["nodes"].values()
        for k, v in s["counters"].items()
        if k.startswith(("dropped", "lost"))
    )
    unexplained = len(stops.found) - stops.by_host
    campaign.record(
        "half an hour live with the trained policy: unexplained stops",
        unexplained,
        "stops",
        "0",
        not unexplained,
        note,
    )
    said = ", ".join(f"{name} {count}" for name, count in late.items() if count) or "no node missed any"
    campaign.record(
        "half an hour live with the trained policy: missed ticks",
        sum(late.values()),
        "ticks",
        "0",
        not any(late.values()),
        f"{said}; {note}",
    )
    worst = max(trend, key=lambda name: trend[name])
    campaign.record(
        "half an hour live: missed ticks, last third less first",
        round(trend[worst], 3),
        "per 100 ticks",
        f"no trend (<= {TREND_LIMIT:g})",
        trend[worst] <= TREND_LIMIT,
        f"worst: {worst}; {note}",
    )
    fattest = max(grown, key=lambda name: grown[name])
    every = ", ".join(f"{name} {100 * share:+.2f} %" for name, share in grown.items())
    campaign.record(
        "half an hour live: growth of memory after warm-up",
        round(100.0 * grown[fattest], 2),
        "%",
        "<= 2 %",
        grown[fattest] <= GROWTH_LIMIT,
        f"{every}; {note}",
    )
    campaign.record(
        "half an hour live: messages numbered and not counted",
        round(sum(missing.values())),
        "messages",
        "0",
        not any(missing.values()),
        f"{len(missing)} subscriptions, {dropped:.0f} drops counted; {note}",
    )
    return not (unexplained or any(missing.values())) and (
        trend[worst] <= TREND_LIMIT and grown[fattest] <= GROWTH_LIMIT
    )


@pytest.mark.campaign
def test_half_an_hour_without_stops_lost_messages_or_growth(campaign: Campaign) -> None:
    if not POLICY.is_file():
        pytest.skip(f"needs {POLICY}; the docstring of this file says how it is trained")
    minutes, folder = campaign.size(2, 33), campaign.folder("thirty_minutes")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    graph = Graph(folder, (f"params.policy={json.dumps(str(POLICY))}",))
    try:
        with HostPauses(folder) as pauses:
            samples, stops = live(graph, 60.0 * minutes, pauses)
            host = pauses.describe()
    finally:
        graph.close()
    digest = hashlib.sha256(POLICY.read_bytes()).hexdigest()[:12]
    note = (
        f"{samples[-1]['t_s'] / 60:.1f} minutes, policy {digest}, {stops.describe()}, {host}, "
        f"{describe_drive(folder / 'bag')}"
    )
    assert record(campaign, samples, stops, note), note


def made_samples(grows_mb=0.0, misses=0):
    """Half an hour in which the recorder grows steadily and the motor misses ticks at the end."""
    made = []
    for t_s in range(10, 1801, 10):
        nodes = {
            name: {"rss_mb": 60.0, "counters": {"ticks": 50.0 * t_s, "ticks_missed": 1.0}} for name in NODES
        }
        nodes["recorder"]["rss_mb"] += grows_mb * t_s / 1800
        nodes["motor"]["counters"]["ticks_missed"] += misses if t_s == 1800 else 0
        made.append({"t_s": float(t_s), "nodes": nodes, "numbers": {}})
    return made


def test_growth_is_that_of_the_node_between_the_warm_up_and_the_end():
    assert set(growth(made_samples(), 180.0).values()) == {0.0}
    grown = growth(made_samples(grows_mb=6.0), 180.0)
    assert grown["recorder"] == pytest.approx(6.0 * (1770 - 210) / 1800 / 60.7, rel=0.01)
    assert grown["motor"] == 0.0


def test_a_tick_missed_before_the_first_sample_is_not_counted_and_one_at_the_end_is():
    assert set(missed(made_samples()).values()) == {0}
    assert missed(made_samples(misses=1))["motor"] == 1


def test_the_drive_is_described_from_all_files_of_its_bag(tmp_path):
    with BagWriter(tmp_path / "bag", limits=SplitLimits(duration_s=0.5)) as writer:
        for i in range(201):  # 2 m along the first straight of the track, 5 cm beside it
            T = np.eye(4)
            T[:2, 3] = -0.9 + i * 0.005, -1.95
            t_ns = 1_800_000_000_000_000_000 + i * 10_000_000
            writer.write("/vicon/car", encode(pose_message(T, t_ns)), t_ns, t_ns, i)
    assert describe_drive(tmp_path / "bag").startswith(
        "1 m driven, mean |CTE| 0.050 m, largest 0.05 m, bag of "
    )
    assert (
        Stops([(12.3, "no image for 0.3 s")]).describe()
        == "1 stops, 0 of them while the host paused (12 s: no image for 0.3 s)"
    )
