"""ROS programs that are not ours: an honest policy, and strangers. Started by the campaign of strangers and by tests.

Each is a process of its own that uses Cyclone DDS or Zenoh directly. It reads one request per line (JSON) from its standard input, acts, and
answers ``done``. What it says is checked by nobody here: that is the business of the ROS 2 node.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import signal
import sys
import time
from collections.abc import Callable
from typing import Any

from advnerf_core.geometry import planar_pose
from nodes.linking.ros2.answers import stamp_of_cdr
from nodes.runtime.messages import (
    decode,
    drive_message,
    encode,
    header,
    pose_message,
    type_name,
    types,
)

ACKERMANN, TWIST = "ackermann_msgs/msg/AckermannDriveStamped", "geometry_msgs/msg/TwistStamped"
IMAGE, ARM, TELEOP = "sensor_msgs/msg/Image", "advnerf_msgs/msg/Arm", "advnerf_msgs/msg/Teleop"
IMAGES, COMMANDS = "/image_raw", "/cmd_vel"
WHEELBASE_M = 0.25
# What the honest policy says. Whatever else the car does, a stranger made it do.
HONEST_SPEED_MPS, HONEST_STEERING_RAD = 0.7, 0.29


def twist(stamp_ns: int, speed_mps: float, steering_rad: float) -> bytes:
    """CDR bytes of a command."""
    yaw_radps = speed_mps * math.tan(steering_rad) / WHEELBASE_M if math.isfinite(speed_mps) else 0.0
    linear, angular = types.Vector3(x=speed_mps, y=0.0, z=0.0), types.Vector3(x=0.0, y=0.0, z=yaw_radps)
    message = types.TwistStamped(header=header(stamp_ns), twist=types.Twist(linear=linear, angular=angular))
    return encode(message)


class Programs:
    """The places of this process among the ROS programs."""

    transport = "dds"
    joined: list[Any] = []  # noqa: RUF012 - one list for the process


def join(domain_id: int) -> Any:
    """Join the ROS programs."""
    if Programs.transport == "zenoh":
        from tests.support.live.strange_zenoh import StrangeZenoh

        Programs.joined.append(StrangeZenoh(domain_id))
    else:
        from tests.support.live.strange_dds import StrangeDds

        Programs.joined.append(StrangeDds(domain_id))
    return Programs.joined[-1]


def leave(network: Any) -> None:
    """Leave them again."""
    Programs.joined.remove(network)
    network.close()


def answer(
    network: Any, seconds: float, command: Callable[[int], bytes], late_s: float = 0.0, **how: Any
) -> None:
    """Answer every image for a while with what ``command`` makes of its stamp."""
    images, commands = network.reader(IMAGES, IMAGE), network.writer(COMMANDS, TWIST, **how)
    waiting: list[tuple[float, int]] = []
    deadline = time.monotonic() + seconds
    while (now := time.monotonic()) < deadline:
        waiting += [(now + late_s, stamp_of_cdr(cdr)) for cdr in images.take(5)]
        while waiting and waiting[0][0] <= now:
            commands.put(command(waiting.pop(0)[1]))
        time.sleep(0.001)


def flood(
    writers: list[Any], messages: Callable[[], list[bytes]], seconds: float, pause_s: float = 0.0
) -> None:
    """Write as fast as this process can, or with pauses."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        for writer in writers:
            for cdr in messages():
                writer.put(cdr)
        if pause_s:
            time.sleep(pause_s)


def second_publisher(domain: int, seconds: float, rng: random.Random) -> None:
    """It reads along and answers every image, but with other values."""
    speed, steering = rng.uniform(0.2, 1.0), rng.uniform(-0.3, 0.2)
    answer(join(domain), seconds, lambda stamp: twist(stamp, speed, steering))


def blind_flood(domain: int, seconds: float, rng: random.Random) -> None:
    """Commands with the time of day as stamp, as fast as possible."""
    speed = rng.uniform(0.2, 1.0)
    flood([join(domain).writer(COMMANDS, TWIST)], lambda: [twist(time.time_ns(), speed, -0.2)], seconds)


def old_stamps(domain: int, seconds: float, rng: random.Random) -> None:
    """Answers to images of half a second ago and more."""
    answer(join(domain), seconds, lambda stamp: twist(stamp, 0.5, -0.2), late_s=rng.uniform(0.3, 0.8))


def not_finite(domain: int, seconds: float, rng: random.Random) -> None:
    """Answers that are no numbers, or larger than any float."""
    wrong = rng.choice([math.nan, math.inf, -math.inf, 1e300])
    answer(join(domain), seconds, lambda stamp: twist(stamp, wrong, 0.0))


def wrong_type(domain: int, seconds: float, rng: random.Random) -> None:
    """The name of the command topic with other types."""
    network, pose = join(domain), pose_message(planar_pose(rng.random(), 0.0, 0.0), time.time_ns())
    for message in (drive_message(0.5, -0.2, time.time_ns()), pose):
        messages = [encode(message)]
        flood([network.writer(COMMANDS, type_name(message))], messages.copy, seconds / 2, 0.002)


def wrong_bytes(domain: int, seconds: float, rng: random.Random) -> None:
    """The right name of the type, and bytes that are none of it; and a megabyte of frame name."""
    network = join(domain)
    sizes = [rng.randrange(1, 40), 60, 68, 72, rng.randrange(100, 5000)]
    junk = [network.junk_writer(COMMANDS, TWIST, size) for size in sizes]
    long = types.TwistStamped(
        header=header(time.time_ns(), "x" * 2**20), twist=decode(TWIST, twist(0, 0.5, -0.2)).twist
    )
    large, cdr = network.writer(COMMANDS, TWIST), encode(long)
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        for writer, size in zip(junk, sizes, strict=True):
            writer.put(b"\x00\x01\x00\x00" + rng.randbytes(size))
        large.put(cdr)
        time.sleep(0.005)


def wrong_definition(domain: int, seconds: float, rng: random.Random) -> None:
    """The type's name with the ROS hash of another definition."""
    answer(
        join(domain),
        seconds,
        lambda stamp: twist(stamp, 0.5, -0.2),
        stated_hash="RIHS01_" + f"{rng.getrandbits(256):064x}",
    )


def unreliable(domain: int, seconds: float, rng: random.Random) -> None:
    """A publisher whose QoS does not match."""
    answer(join(domain), seconds, lambda stamp: twist(stamp, rng.uniform(0.2, 1.0), -0.2), reliable=False)


def other_domain(domain: int, seconds: float, rng: random.Random) -> None:
    """Commands on another domain."""
    other = (domain + rng.randint(1, 5)) % 100
    flood([join(other).writer(COMMANDS, TWIST)], lambda: [twist(time.time_ns(), 0.5, -0.2)], seconds, 0.002)


def tries_to_arm(domain: int, seconds: float, rng: random.Random) -> None:
    """Requests to arm, a held button and commands of the safety node, under our own names."""
    network = join(domain)
    writers = {
        "/arm": network.writer("/arm", ARM),
        "/teleop/state": network.writer("/teleop/state", TELEOP),
        "/policy/drive": network.writer("/policy/drive", ACKERMANN),
        "/motor/drive": network.writer("/motor/drive", ACKERMANN),
    }
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        now_ns = time.time_ns()
        ask_id = f"{rng.getrandbits(64):x}"
        arm = types.Arm(
            header=header(now_ns), arm=True, source="operator", reason="", ask_id=ask_id, age_ns=0
        )
        hand = types.Teleop(
            header=header(now_ns), mode="human", estop=False, speed_mps=0.5, steering_rad=-0.2, device=""
        )
        drive = drive_message(0.5, -0.2, now_ns)
        for name, message in (
            ("/arm", arm),
            ("/teleop/state", hand),
            ("/policy/drive", drive),
            ("/motor/drive", drive),
        ):
            writers[name].put(encode(message))
        time.sleep(0.005)


def false_images(domain: int, seconds: float, rng: random.Random) -> None:
    """Pictures of its own under the name of ours, with our stamps."""
    network = join(domain)
    images, false = network.reader(IMAGES, IMAGE), network.writer(IMAGES, IMAGE, reliable=False)
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        for cdr in images.take(5):
            false.put(cdr[:64] + rng.randbytes(len(cdr) - 64))
        time.sleep(0.001)


def comes_and_goes(domain: int, seconds: float, rng: random.Random) -> None:
    """Participants that join and leave, some of them with a command."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        network = join(domain)
        if rng.random() < 0.5:
            network.writer(COMMANDS, TWIST).put(twist(time.time_ns(), 0.5, -0.2))
        time.sleep(rng.uniform(0.0, 0.05))
        leave(network)


def slow_subscriber(domain: int, seconds: float, rng: random.Random) -> None:
    """Subscribers that ask for everything and take nothing."""
    del rng
    network = join(domain)
    readers = [
        network.reader(name, typename, reliable=True)
        for name, typename in (
            ("/pose", "geometry_msgs/msg/PoseStamped"),
            ("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
        )
    ]
    readers += [network.reader(IMAGES, IMAGE) for _ in range(8)]
    time.sleep(seconds)
    del readers


def unannounced(domain: int, seconds: float, rng: random.Random) -> None:
    """Only over Zenoh: it reads along and answers every image, without a liveliness token."""
    answer(join(domain), seconds, lambda stamp: twist(stamp, rng.uniform(0.2, 1.0), -0.2), announced=False)


def without_attachment(domain: int, seconds: float, rng: random.Random) -> None:
    """Only over Zenoh: the same with attachments of no or other bytes."""
    junk = [b"", rng.randbytes(33), rng.randbytes(7)]
    answer(
        join(domain),
        seconds,
        lambda stamp: twist(stamp, 0.5, -0.2),
        announced=False,
        attachment=lambda count: junk[count % len(junk)],
    )


def unannounced_images(domain: int, seconds: float, rng: random.Random) -> None:
    """Only over Zenoh: pictures of its own under the name of ours, without a liveliness token."""
    network = join(domain)
    false = network.writer(IMAGES, IMAGE, announced=False)
    flood([false], lambda: [rng.randbytes(1000)], seconds, 0.02)


STRANGERS: dict[str, Callable[[int, float, random.Random], None]] = {
    each.__name__: each
    for each in (
        second_publisher,
        blind_flood,
        old_stamps,
        not_finite,
        wrong_type,
        wrong_bytes,
        wrong_definition,
        unreliable,
        other_domain,
        tries_to_arm,
        false_images,
        comes_and_goes,
        slow_subscriber,
    )
}


ZENOH_STRANGERS = {each.__name__: each for each in (unannounced, without_attachment, unannounced_images)}


def main() -> None:
    """Act as asked until the standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("domain", type=int)
    parser.add_argument("--honest", action="store_true", help="be the operator's own policy, for ever")
    parser.add_argument("--transport", default="dds", choices=("dds", "zenoh"))
    options = parser.parse_args()
    Programs.transport = options.transport
    if options.honest:
        signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # the interpreter's end leaves the domain
        print("ready", flush=True)
        command = lambda stamp: twist(stamp, HONEST_SPEED_MPS, HONEST_STEERING_RAD)  # noqa: E731 - one line
        answer(join(options.domain), math.inf, command)
    print("ready", flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        act = {**STRANGERS, **ZENOH_STRANGERS}[asked["kind"]]
        act(options.domain, asked["seconds"], random.Random(asked["seed"]))
        for network in list(Programs.joined):
            leave(network)
        print("done", flush=True)


if __name__ == "__main__":
    main()
