"""How long do images and commands take through the ROS 2 node, and is anything lost? ``python -m benchmarks.ros2_latency`` (3 minutes).

The node runs as a process. This process publishes images at 10 Hz and poses at 100 Hz on the bus. A plain rclpy program (`make
setup-ros2`) gets both from DDS and answers each image with a command, which comes back to the bus. Both ways are measured from end to
end on the monotonic clock: from publication on the bus to rclpy's callback, and from rclpy's publication to this process. So each
figure contains one hop of the bus, the node, DDS, and the decoding in rclpy.

``--minutes 30`` counts losses, and its row has the latencies of that run in its note; a shorter run, on a quiet computer, records the
latencies.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.documents import dump_yaml
from advnerf_core.geometry import planar_pose
from benchmarks.rclpy_peer import PEERS, RclpyPeer, rclpy_python
from benchmarks.results import REPOSITORY, record_row
from nodes.runtime.bus import Bus
from nodes.runtime.messages import image_message, pose_message, stamp_ns

COMMAND = "python -m benchmarks.ros2_latency"
IMAGE_HZ, POSE_HZ, LIMIT_MS, _LONG_MIN = 10.0, 100.0, 10.0, 30.0
CONFIG = {
    "vehicle": str(REPOSITORY / "calibration" / "twin" / "vehicle.yaml"),
    "send": [
        {"topic": "/compositor/image", "ros": "/image_raw"},
        {"topic": "/vicon/car", "ros": "/pose", "depth": 100},
    ],
    "take": [
        {
            "topic": "/policy/drive",
            "ros": "/cmd_vel",
            "type": "geometry_msgs/msg/TwistStamped",
            "answers": "/compositor/image",
        }
    ],
}


@dataclass
class Tally:
    """What was sent and what came back.

    Attributes:
        images: Publication of each image by its stamp, monotonic [ns].
        poses: Stamps of the poses.
        commands: Arrival of each command by its stamp, monotonic [ns].
        seconds: Duration of the run [s].
        counters: The node's counters in the end.
    """

    images: dict[int, int] = field(default_factory=dict)
    poses: set[int] = field(default_factory=set)
    commands: dict[int, int] = field(default_factory=dict)
    seconds: float = 0.0
    counters: dict[str, float] = field(default_factory=dict)


def watch(bus: Bus, tally: Tally, until_s: float) -> None:
    """Receive until a monotonic time."""
    while (left_s := until_s - time.monotonic()) > 0.0:
        bus.wait(left_s)
        for received in bus.receive():
            message = received.message()
            if received.topic == "/policy/drive":
                tally.commands[stamp_ns(message)] = received.info.receive_mono_ns
            else:
                tally.counters = dict(
                    zip(message.counter_names, map(float, message.counter_values), strict=True)
                )


def talk(bus: Bus, tally: Tally, seconds: float) -> None:
    """Publish images and poses on a fixed schedule."""
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 256, (188, 336, 3), dtype=np.uint8) for _ in range(8)]
    pose, began, ticks = planar_pose(1.0, 2.0, 0.5), time.monotonic(), round(seconds * POSE_HZ)
    for tick in range(ticks):
        now_ns = time.time_ns()
        tally.poses.add(now_ns)
        bus.publish("/vicon/car", pose_message(pose, now_ns))
        if tick % round(POSE_HZ / IMAGE_HZ) == 5:
            message = image_message(pictures[tick % 8], now_ns, "camera")
            tally.images[now_ns] = time.monotonic_ns()
            bus.publish("/compositor/image", message)
        watch(bus, tally, began + (tick + 1) / POSE_HZ)
    tally.seconds = time.monotonic() - began


def run(seconds: float, domain: int) -> tuple[Tally, list[dict[str, Any]]]:
    """Run node and peer; what was sent, and what the peer noted."""
    tally, topics = Tally(), [route["topic"] for route in CONFIG["send"]]  # type: ignore[index]
    with tempfile.TemporaryDirectory(prefix="advnerf-") as name, Bus(Path(name)) as bus:
        config = Path(name) / "ros2.yaml"
        config.write_text(dump_yaml({**CONFIG, "domain_id": domain}), encoding="utf-8")
        for topic in topics:
            bus.publisher(topic)
        bus.subscribe("/policy/drive", queue=1000)
        bus.subscribe("/status/ros2")
        command = [sys.executable, "-m", "nodes.ros2", "--config", str(config), "--folder", name]
        node = subprocess.Popen(command, cwd=REPOSITORY)
        peer = RclpyPeer(domain, PEERS / "answering.py", "--commands", "/cmd_vel", "--poses", "/pose")
        try:
            bus.wait_for_subscribers(topics, 30.0)
            deadline = time.monotonic() + 60.0
            while not (tally.counters.get("readers /image_raw") and tally.counters.get("readers /pose")):
                if time.monotonic() > deadline:
                    raise RuntimeError(
                        "expected the rclpy program to find the node within 60 s; run `make test-ros2`"
                    )
                watch(bus, tally, time.monotonic() + 0.2)
            watch(bus, tally, time.monotonic() + 2.0)  # the other ends of the matches
            talk(bus, tally, seconds)
            watch(bus, tally, time.monotonic() + 2.0)
        finally:
            peer.close()
            node.send_signal(signal.SIGINT)
            node.wait(10.0)
    return tally, peer.lines


def quantiles_ms(times_ns: list[int]) -> tuple[float, float, float]:
    """Median, 99th percentile and maximum [ms]."""
    found = np.array(times_ns, dtype=np.float64) / 1e6
    return float(np.median(found)), float(np.quantile(found, 0.99)), float(found.max())


def main() -> int:
    """Measure and record the rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--domain", type=int, default=64)
    parser.add_argument("--trial", action="store_true", help="record nothing")
    options = parser.parse_args()
    if rclpy_python() is None:
        print("no rclpy environment: make setup-ros2", file=sys.stderr)
        return 2
    tally, lines = run(60.0 * options.minutes, options.domain)
    arrived = {line["stamp_ns"]: line for line in lines if "stamp_ns" in line}
    there = quantiles_ms([line["arrived_ns"] - tally.images[stamp] for stamp, line in arrived.items()])
    back = quantiles_ms([at_ns - arrived[stamp]["answered_ns"] for stamp, at_ns in tally.commands.items()])
    count = tally.counters.get
    poses_lost = round(count("sent /vicon/car", 0.0)) - sum("pose_ns" in line for line in lines)
    handled = sum(count(f"{what} /policy/drive", 0.0) for what in ("taken", "refused"))
    commands_lost = len(arrived) - round(handled)
    # The node itself leaves out what is older than its topic allows: a machine that held it up, not a loss.
    late = round(count("stale /vicon/car", 0.0) + count("refused /policy/drive", 0.0))
    images_lost = len(tally.images.keys() - arrived.keys())
    minutes = f"{tally.seconds / 60.0:.1f} min, {len(tally.images)} images of 336 x 188 (10 Hz), {len(tally.poses)} poses (100 Hz)"
    print(
        f"image {there}, command {back} ms (median, p99, worst); {minutes}; lost: {images_lost} images, {poses_lost} poses, {commands_lost} commands; {late} too late to be carried"
    )
    print({name: count for name, count in tally.counters.items() if count})
    if options.trial:
        return 0
    if options.minutes >= _LONG_MIN:
        _record_losses(options.minutes, poses_lost, commands_lost, f"{minutes}, {len(arrived)} commands; {late} messages were too old to be carried; {images_lost} images lost, which are sent with best effort; p99 of an image {there[1]:.1f} ms, of a command {back[1]:.1f} ms")  # fmt: skip
        return 0
    for what, (median, p99, worst) in (("an image to rclpy", there), ("a command from rclpy", back)):
        record_row(
            f"ROS 2: latency of {what} through the node, p99",
            p99,
            "ms",
            f"<= {LIMIT_MS:g} ms",
            p99 <= LIMIT_MS,
            COMMAND,
            f"median {median:.2f} ms, worst {worst:.1f} ms; one bus hop, the node, DDS and rclpy together; {minutes}",
        )
    return 0


def _record_losses(lasted_min: float, poses: int, commands: int, note: str) -> None:
    record_row(
        "ROS 2: reliable messages lost through the node",
        poses + commands,
        "messages",
        "0 in 30 min",
        poses + commands == 0,
        f"{COMMAND} --minutes {lasted_min:g}",
        note,
    )


if __name__ == "__main__":
    raise SystemExit(main())
