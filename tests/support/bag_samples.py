"""Bags with one message of every kind."""

import numpy as np

from nodes.bags.writer import BagWriter
from nodes.runtime.messages import (
    camera_info_message,
    drive_message,
    encode,
    fields_of,
    header,
    image_message,
    pose_message,
    types,
)
from nodes.runtime.topics import TOPICS
from tests.support.messages import filled

START_NS = 1_800_000_000_000_000_000


def sample(typename, stamp_ns):
    """One message of every type in the topic table."""
    from advnerf_core.geometry import Pinhole

    h = header(stamp_ns, "test")
    image = np.random.default_rng(stamp_ns % 1000).integers(0, 255, (20, 30, 3), np.uint8)
    made = {
        "sensor_msgs/msg/Image": lambda: image_message(image, stamp_ns, "camera"),
        "sensor_msgs/msg/CameraInfo": lambda: camera_info_message(
            Pinhole(30, 20, 9, 9, 15, 10), stamp_ns, "camera"
        ),
        "geometry_msgs/msg/PoseStamped": lambda: pose_message(np.eye(4), stamp_ns),
        "ackermann_msgs/msg/AckermannDriveStamped": lambda: drive_message(0.8, 0.1, stamp_ns),
        "advnerf_msgs/msg/AttackStamp": lambda: types.AttackStamp(
            header=h, attack_id="abc", drawn=True, reason=""
        ),
        "advnerf_msgs/msg/Arm": lambda: types.Arm(
            header=h, arm=True, source="test", reason="because", ask_id="a", age_ns=1
        ),
        "advnerf_msgs/msg/SafetyState": lambda: filled(
            types.SafetyState, header=h, armed=True, source="test", command_age_s=0.1, pose_age_s=0.01
        ),
        "advnerf_msgs/msg/MotorSent": lambda: filled(
            types.MotorSent,
            header=h,
            serial_write_mono_ns=1,
            serial_write_real_ns=2,
            speed_mps=0.8,
            steering_rad=0.1,
            erpm=3691.0,
            servo=0.5,
            peer="twin",
        ),
        "advnerf_msgs/msg/VescState": lambda: types.VescState(
            header=h,
            speed_mps=0.8,
            erpm=3691.0,
            duty=0.1,
            input_voltage_v=12.0,
            motor_current_a=1.0,
            input_current_a=0.5,
            mosfet_temperature_c=30.0,
            fault=0,
            fault_text="",
        ),
        "advnerf_msgs/msg/AttackRequest": lambda: types.AttackRequest(
            header=h, request_id="a", request="horizon: 1", source="", ask_id="x"
        ),
        "advnerf_msgs/msg/AttackCancel": lambda: types.AttackCancel(
            header=h, request_id="", reason="enough", ask_id="x"
        ),
        "advnerf_msgs/msg/AttackProgress": lambda: filled(
            types.AttackProgress,
            header=h,
            request_id="a",
            state="searching",
            evaluation=1,
            evaluations=2,
            loss_m=-1.0,
            total_cte_m=1.0,
            best_total_cte_m=1.0,
            clean_total_cte_m=0.5,
            clean_drives=True,
            seconds=0.1,
            answered_id="x",
        ),
        "advnerf_msgs/msg/FileChunk": lambda: types.FileChunk(
            header=h, name="a", sha256="ab", size_bytes=3, index=0, count=1, data=np.arange(3, dtype=np.uint8)
        ),
        "advnerf_msgs/msg/NodeStatus": lambda: filled(
            types.NodeStatus,
            header=h,
            node="x",
            pid=1,
            state="active",
            subscriptions=["/arm"],
            counter_names=["n"],
            counter_values=np.array([1.0]),
        ),
    }
    return encode(made[typename]() if typename in made else nothing(typename))


def nothing(typename):
    """A message of any type with zeros, empty texts and empty sequences."""
    values = {}
    for name, (kind, what) in fields_of(typename):
        if kind.name == "BASE":
            values[name] = {"string": "", "bool": False}.get(what[0], 0.0 if "float" in what[0] else 0)
        elif kind.name == "NAME":
            values[name] = nothing(what)
        else:
            (element, of), length = what
            plain = element.name == "BASE" and of[0] != "string"
            values[name] = np.zeros(length if kind.name == "ARRAY" else 0, of[0]) if plain else []
    return getattr(types, typename.rsplit("/", 1)[-1])(**values)


def write_all_topics(folder, rounds=5, **options):
    writer = BagWriter(folder, **options)
    for i in range(rounds):
        for k, row in enumerate([*TOPICS.values()]):
            t = START_NS + i * 100_000_000 + k * 1_000_000
            writer.write(row.name, sample(row.type, t - 5_000_000), t, t - 1_000_000, i)
        t = START_NS + i * 100_000_000 + 50_000_000
        writer.write("/status/x", sample("advnerf_msgs/msg/NodeStatus", t), t, t, i)
    return writer
