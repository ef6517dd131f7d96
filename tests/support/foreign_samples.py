"""Bags of strangers: the writers of ``rosbags`` and of ``mcap``, with the message types that they ship."""

from types import SimpleNamespace

import cv2
import numpy as np
from mcap_ros2.writer import Writer as McapRos2Writer
from rosbags import rosbag1, rosbag2
from rosbags.rosbag2.writer import StoragePlugin
from rosbags.typesys import Stores, get_typestore

START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
COUNT = 6
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
ROS1_STORE, HUMBLE = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)


def rgb_at(index, height=188, width=336):
    """A picture without symmetry in its colours."""
    rows, columns = np.mgrid[0:height, 0:width]
    red, green = (rows + 7 * index) % 256, (columns * 255 // width + index) % 256
    return np.stack([red, green, 200 - rows // 2], axis=2).astype(np.uint8)


def state_at(index):
    """Position and quaternion (x, y, z, w) of the car, near the path of the simulated lab."""
    angle = 0.05 * index
    return (0.2 * index - 0.5, 0.03 * index - 2.0, 0.02), (
        0.0,
        0.0,
        float(np.sin(angle / 2)),
        float(np.cos(angle / 2)),
    )


class Make:
    """Messages of one typestore, which knows ROS 1 or ROS 2."""

    def __init__(self, store):
        self.store, self.ros1 = store, store is ROS1_STORE

    def type(self, name):
        return self.store.types[name]

    def header(self, index, frame):
        stamp = START_NS + index * STEP_NS - 5_000_000
        time = self.type("builtin_interfaces/msg/Time")(sec=stamp // 10**9, nanosec=stamp % 10**9)
        extra = {"seq": index} if self.ros1 else {}
        return self.type("std_msgs/msg/Header")(stamp=time, frame_id=frame, **extra)

    def image(self, index, encoding="rgb8", padding=0):
        rgb = rgb_at(index)
        pixels = {"rgb8": rgb, "bgr8": rgb[..., ::-1], "mono8": rgb[..., 1], "32FC1": rgb[..., 1]}[encoding]
        rows = pixels.reshape(len(rgb), -1)
        rows = np.hstack([rows, np.full((len(rows), padding), 99, np.uint8)])
        return self.type(IMAGE)(
            header=self.header(index, "camera"),
            height=rgb.shape[0],
            width=rgb.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=np.ascontiguousarray(rows).reshape(-1),
        )

    def compressed(self, index):
        data = cv2.imencode(".png", np.ascontiguousarray(rgb_at(index)[..., ::-1]))[1].reshape(-1)
        return self.type(COMPRESSED)(
            header=self.header(index, "camera"), format="bgr8; png compressed bgr8", data=data
        )

    def pose(self, index, typename="geometry_msgs/msg/PoseStamped"):
        (x, y, z), q = state_at(index)
        turn = self.type("geometry_msgs/msg/Quaternion")(*q)
        header = self.header(index, "world")
        pose = self.type("geometry_msgs/msg/Pose")(self.type("geometry_msgs/msg/Point")(x, y, z), turn)
        uncertain = self.type("geometry_msgs/msg/PoseWithCovariance")(pose, np.arange(36.0))
        vector = self.type("geometry_msgs/msg/Vector3")
        name = typename.rsplit("/", 1)[1]
        if name == "PoseStamped":
            return self.type(typename)(header, pose)
        if name == "TransformStamped":
            transform = self.type("geometry_msgs/msg/Transform")(vector(x, y, z), turn)
            return self.type(typename)(header, "vicon/car/car", transform)
        if name == "PoseWithCovarianceStamped":
            return self.type(typename)(header, uncertain)
        twist = self.type("geometry_msgs/msg/Twist")(vector(1.0, 0.0, 0.0), vector(0.0, 0.0, 0.1))
        moving = self.type("geometry_msgs/msg/TwistWithCovariance")(twist, np.zeros(36))
        return self.type(typename)(header, "car", uncertain, moving)

    def text(self, words):
        return self.type("std_msgs/msg/String")(words)


def drive(
    make,
    image_type=IMAGE,
    pose_type="geometry_msgs/msg/PoseStamped",
    encoding="rgb8",
    image_topic="/camera/image_raw",
):
    """Rows of topic, type, message and log time."""
    for index in range(COUNT):
        log_ns = START_NS + index * STEP_NS
        image = (
            make.compressed(index)
            if image_type == COMPRESSED
            else make.image(index, encoding, padding=index % 2)
        )
        yield "/vicon/car", pose_type, make.pose(index, pose_type), log_ns
        yield image_topic, image_type, image, log_ns + 1_000_000
        yield "/chatter", "std_msgs/msg/String", make.text(f"word {index}"), log_ns + 2_000_000


def write_rosbag2(folder, storage, **options):
    with rosbag2.Writer(folder, version=9, storage_plugin=storage) as writer:
        _write(writer, HUMBLE, HUMBLE.serialize_cdr, drive(Make(HUMBLE), **options))
    return folder


def write_ros1(folder, **options):
    folder.mkdir()
    with rosbag1.Writer(folder / "drive.bag") as writer:
        _write(writer, ROS1_STORE, ROS1_STORE.serialize_ros1, drive(Make(ROS1_STORE), **options))
    return folder / "drive.bag"


def _write(writer, store, serialize, rows):
    connections = {}
    for topic, typename, message, log_ns in rows:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, typename, typestore=store)
        writer.write(connections[topic], log_ns, serialize(message, typename))


def write_mcap(folder, **options):
    folder.mkdir()
    path = folder / "drive.mcap"
    with open(path, "wb") as file:
        writer = McapRos2Writer(file)
        schemas = {}
        for topic, typename, message, log_ns in drive(Make(HUMBLE), **options):
            if typename not in schemas:
                definition = HUMBLE.generate_msgdef(typename, ros_version=2)[0]
                schemas[typename] = writer.register_msgdef(typename, definition)
            writer.write_message(topic, schemas[typename], plain(message), log_ns, log_ns)
        writer.finish()
    return path


def plain(message):
    """A message without a class of ``rosbags``, as another encoder takes it."""
    if hasattr(message, "__msgtype__"):
        return SimpleNamespace(**{k: plain(v) for k, v in vars(message).items() if not k.startswith("__")})
    return (
        message.tolist()
        if isinstance(message, np.ndarray) and message.dtype != np.uint8
        else (message.tobytes() if isinstance(message, np.ndarray) else message)
    )


WRITERS = {
    "mcap": write_mcap,
    "rosbags-mcap": lambda folder, **options: write_rosbag2(folder, StoragePlugin.MCAP, **options),
    "rosbags-sqlite3": lambda folder, **options: write_rosbag2(folder, StoragePlugin.SQLITE3, **options),
    "ros1": write_ros1,
}
