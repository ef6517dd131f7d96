"""What does a recorder lose that is killed? In full about eight minutes each; goes on where it was stopped.

One recorder begins a new file several times a second, another does not get that far.

A recorder process is sent 30 images of 366 x 188 and 50 poses a second and killed with SIGKILL at a random moment; then its bag is
repaired and read by three readers that know nothing of ours: ``mcap`` with ``mcap-ros2-support``, ``rosbags``, and Foxglove's own
decoder (``@mcap/core`` and ``@foxglove/rosmsg2-serialization``, in node). All must find the same messages with the same contents.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from nodes.bags.repair_parts import repair_bag
from nodes.runtime.bus import Bus
from nodes.runtime.messages import image_message, pose_message
from tests.campaigns.campaign import Campaign
from tests.support.live.processes import REPOSITORY

# Each limit is reached about every quarter of a second with the traffic below: 6.3 MB a second.
SPLITTING = ("max_bag_size_mb=1", "max_bag_duration_s=0.25")
IMAGE, POSE = "/camera/image_raw", "/vicon/car"
IMAGE_HZ, POSE_HZ = 30.0, 50.0
MOST_LOST = 2
PACKAGES = ("@mcap/core@2", "@mcap/support@1", "@foxglove/rosmsg@5", "@foxglove/rosmsg2-serialization@3")
_START_S = 30.0
# Reads an MCAP file with Foxglove's packages; prints counts by topic, the sum of all pixels and of all x positions.
_SCRIPT = """
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
const require = createRequire(import.meta.url);
const core = require("@mcap/core"), rosmsg = require("@foxglove/rosmsg");
const serialization = require("@foxglove/rosmsg2-serialization");
const decompressHandlers = await require("@mcap/support").loadDecompressHandlers();
const bytes = await readFile(process.argv[2]);
const readable = {
  size: async () => BigInt(bytes.length),
  read: async (offset, length) => new Uint8Array(bytes.subarray(Number(offset), Number(offset + length))),
};
const reader = await core.McapIndexedReader.Initialize({ readable, decompressHandlers });
const decoders = new Map();
const found = { counts: {}, pixels: 0, x: 0 };
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  const schema = reader.schemasById.get(channel.schemaId);
  if (!decoders.has(schema.id)) {
    const definition = rosmsg.parse(new TextDecoder().decode(schema.data), { ros2: true });
    decoders.set(schema.id, new serialization.MessageReader(definition));
  }
  const content = decoders.get(schema.id).readMessage(message.data);
  found.counts[channel.topic] = (found.counts[channel.topic] ?? 0) + 1;
  if (content.data) for (const value of content.data) found.pixels += value;
  if (content.pose) found.x += content.pose.position.x;
}
console.log(JSON.stringify(found));
"""


class ReadersDisagree(RuntimeError):
    """A reader found something else in a bag than another one, or than what was sent."""


@dataclass
class Found:
    """What a reader found in a bag: messages by topic, sum of all pixels, sum of all x positions."""

    counts: dict[str, int] = field(default_factory=dict)
    pixels: float = 0.0
    x: float = 0.0

    def add(self, topic: str, message: Any) -> None:
        """Count a decoded message."""
        self.counts[topic] = self.counts.get(topic, 0) + 1
        if topic == IMAGE:
            self.pixels += float(np.frombuffer(bytes(message.data), np.uint8).sum(dtype=np.int64))
        else:
            self.x += message.pose.position.x


def node_decoder(folder: Path) -> Path:
    """Folder with Foxglove's packages and the script that uses them; installed once."""
    script = folder / "read.mjs"
    if not (folder / "node_modules" / "@mcap" / "core").exists():
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "package.json").write_text('{"private": true}\n')
        subprocess.run(
            ["npm", "install", "--silent", "--no-audit", "--no-fund", *PACKAGES], cwd=folder, check=True
        )
    script.write_text(_SCRIPT)
    return script


def kill_once(seed: int, script: Path | None, settings: tuple[str, ...] = ()) -> dict[str, int]:
    """One recorder killed; what was sent, what was lost, and how many readers agreed."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory(prefix="advnerf-") as folder:
        sent, expected = _record_and_kill(Path(folder), rng, settings)
        files = [part.path for part in repair_bag(Path(folder) / "bag")]
        found = [_with_mcap(files), _with_rosbags(Path(folder) / "bag")]
        if script is not None:
            found.append(_with_node(files, script))
        for other in found:
            if other != found[0]:
                raise ReadersDisagree(f"kill {seed}: {found}")
        counts = {topic: found[0].counts.get(topic, 0) for topic in (IMAGE, POSE)}
        _require_content(seed, found[0], counts, expected)
        lost = {topic: sent[topic] - counts[topic] for topic in counts}
        return {
            "seed": seed,
            "sent": sum(sent.values()),
            "lost_images": lost[IMAGE],
            "lost_poses": lost[POSE],
            "lost": sum(lost.values()),
            "readers": len(found),
            "files": len(files),
        }


def _record_and_kill(
    folder: Path, rng: np.random.Generator, settings: tuple[str, ...]
) -> tuple[dict[str, int], dict[str, list[float]]]:
    """Send until a random moment, kill; how many were sent, and the sums that are expected of their contents."""
    command = [sys.executable, "-m", "nodes.recorder", "--folder", str(folder)]
    command += ["--set", f"topics=[{IMAGE}, {POSE}]"]
    command += [part for setting in settings for part in ("--set", setting)]
    process = subprocess.Popen(command, cwd=REPOSITORY, stderr=subprocess.DEVNULL)
    sent, sums = {IMAGE: 0, POSE: 0}, {IMAGE: [0.0], POSE: [0.0]}
    try:
        with Bus(folder) as bus:
            bus.publisher(IMAGE)
            bus.publisher(POSE)
            bus.wait_for_subscribers([IMAGE, POSE], _START_S)
            start, kill_s = time.monotonic(), rng.uniform(0.7, 2.2)
            while (t := time.monotonic() - start) < kill_s:
                if t * IMAGE_HZ >= sent[IMAGE]:
                    pixels = rng.integers(0, 255, (188, 366, 3), np.uint8)
                    bus.publish(IMAGE, image_message(pixels, time.time_ns(), "camera"))
                    sent[IMAGE] += 1
                    sums[IMAGE].append(sums[IMAGE][-1] + float(pixels.sum(dtype=np.int64)))
                if t * POSE_HZ >= sent[POSE]:
                    T = np.eye(4)
                    T[0, 3] = float(rng.integers(0, 1000))
                    bus.publish(POSE, pose_message(T, time.time_ns()))
                    sent[POSE] += 1
                    sums[POSE].append(sums[POSE][-1] + T[0, 3])
                time.sleep(2e-4)
            os.kill(process.pid, signal.SIGKILL)
            process.wait()
    finally:
        process.kill()
        process.wait()
    return sent, sums


def _require_content(seed: int, found: Found, counts: dict[str, int], sums: dict[str, list[float]]) -> None:
    """The first messages that were sent, whole: nothing missing in between, nothing twice."""
    if found.pixels != sums[IMAGE][counts[IMAGE]] or found.x != sums[POSE][counts[POSE]]:
        raise ReadersDisagree(
            f"kill {seed}: the bag does not hold the first {counts} messages that were sent"
        )


def _with_mcap(files: list[Path]) -> Found:
    found = Found()
    for path in files:
        with open(path, "rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for _, channel, _, message in reader.iter_decoded_messages():
                found.add(channel.topic, message)
    return found


def _with_rosbags(folder: Path) -> Found:
    found = Found()
    with AnyReader([folder], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        for connection, _, data in reader.messages():
            found.add(connection.topic, reader.deserialize(data, connection.msgtype))
    return found


def _with_node(files: list[Path], script: Path) -> Found:
    total = Found()
    for path in files:
        result = subprocess.run(
            ["node", str(script), str(path)], capture_output=True, text=True, timeout=120, check=False
        )
        if result.returncode:
            raise ReadersDisagree(f"Foxglove's decoder cannot read {path}: {result.stderr.strip()[-500:]}")
        found = Found(**json.loads(result.stdout))
        for topic, count in found.counts.items():
            total.counts[topic] = total.counts.get(topic, 0) + count
        total.pixels, total.x = total.pixels + found.pixels, total.x + found.x
    return total


def kill_many(folder: Path, kills: int, settings: tuple[str, ...]) -> list[dict[str, int]]:
    """Kill again and again; finished kills are kept in a file and not repeated."""
    folder.mkdir(parents=True, exist_ok=True)
    script = node_decoder(folder / "node") if shutil.which("npm") else None
    if script is None:
        print("no npm here: Foxglove's decoder is left out (apt-get install nodejs npm)")
    done = folder / "kills.jsonl"
    rows = [json.loads(line) for line in done.read_text().splitlines()] if done.exists() else []
    for seed in range(len(rows), kills):
        rows.append(kill_once(seed, script, settings))
        with open(done, "a", encoding="utf-8") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        print(json.dumps(rows[-1]), flush=True)
    return rows[:kills]


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("name", "recorder", "settings"),
    [
        ("bag_kill", "the recorder", ()),
        ("bag_kill_splits", "a recorder that begins a new file every 0.25 s", SPLITTING),
    ],
)
def test_a_killed_recorder_keeps_what_it_was_sent_before(
    campaign: Campaign, name: str, recorder: str, settings: tuple[str, ...]
) -> None:
    rows = kill_many(campaign.folder(name), campaign.size(3, 100), settings)
    worst, readers = max(row["lost"] for row in rows), min(row["readers"] for row in rows)
    files = [row.get("files", 1) for row in rows]
    split = not settings or min(files) > 1
    campaign.record(
        f"kill -9 of {recorder}, {len(rows)} times at 30 Hz images + 50 Hz poses",
        worst,
        "messages lost at most",
        f"<= {MOST_LOST} each; all repaired files open in mcap+mcap-ros2-support, rosbags, Foxglove's npm decoder",
        worst <= MOST_LOST and readers == 3 and split,
        f"{sum(row['sent'] for row in rows)} sent, {sum(row['lost'] for row in rows)} lost in all "
        f"({sum(row['lost_images'] for row in rows)} images); {min(files)} to {max(files)} files in a bag, {sum(files)} in all; "
        f"each file read alike by {readers} readers"
        + ("" if readers == 3 else ": Foxglove's decoder was not there"),
    )
    # Another content than was sent is an error of its own; the number of lost messages is a row.
    assert split
