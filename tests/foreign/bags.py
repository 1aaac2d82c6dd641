"""Bags of a simulated cell, by other people's libraries: an arm that moves and stands, a camera, joints.

The arm stands at `STOPS` places for a second each and moves for a second between them; the camera takes 10
pictures a second all the time. Nothing is stamped at the same moment as anything else.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tests.foreign.judges import FOLDER, library, missing

STOPS = 5
START_NS = 1_700_000_000_000_000_000
HEIGHT, WIDTH = 24, 32
FRAMES_HZ, IMAGES_HZ = 100, 10
JOINTS = (
    "elbow_joint",
    "shoulder_lift_joint",
    "shoulder_pan_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
"""In the alphabet's order, as joint_state_broadcaster has them."""
K = (900.0, 0.0, 15.5, 0.0, 900.0, 11.5, 0.0, 0.0, 1.0)


def progress_of(time_s: float) -> float:
    """Stops passed: 0, then a second of moving, 1 …"""
    whole, rest = divmod(time_s, 2.0)
    return whole + (0.5 - 0.5 * np.cos(np.pi * (rest - 1.0)) if rest > 1 else 0.0)


def pose(time_s: float) -> tuple[np.ndarray, np.ndarray]:
    """(position, quaternion) of tool0 in base_link."""
    at = progress_of(time_s)
    return np.array([0.1 * at, 0.3, 0.5]), Rotation.from_rotvec([0.1 * at, 0.2, 0.3 * at]).as_quat()


def picture(time_s: float) -> np.ndarray:
    """Tells the stop by its grey level."""
    return np.full((HEIGHT, WIDTH), 10 + 40 * round(progress_of(time_s)), np.uint8)


def moments() -> Iterator[tuple[int, str, float]]:
    """(stamp, kind, seconds) in time order."""
    found = []
    length_s = 2.0 * STOPS - 1.0
    for n in range(int(length_s * FRAMES_HZ)):
        found += [(n / FRAMES_HZ + 0.0013, "tf"), (n / FRAMES_HZ + 0.0041, "joints")]
    found += [
        (n / IMAGES_HZ + 0.0507, kind) for n in range(int(length_s * IMAGES_HZ)) for kind in ("info", "image")
    ]
    for time_s, kind in sorted(found):
        yield START_NS + round(time_s * 1e9), kind, time_s


class RosMessages:
    """By rosbags' own types."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_JAZZY)

    def make(self, kind: str, *fields: Any) -> Any:
        return self.store.types[kind](*fields)

    def header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9))
        return self.make("std_msgs/msg/Header", stamp, frame)

    def transform(self, stamp_ns: int, parent: str, child: str, position: Any, q: Any) -> Any:
        vector = self.make("geometry_msgs/msg/Vector3", *map(float, position))
        turn = self.make("geometry_msgs/msg/Quaternion", *map(float, q))
        inner = self.make("geometry_msgs/msg/Transform", vector, turn)
        return self.make("geometry_msgs/msg/TransformStamped", self.header(stamp_ns, parent), child, inner)

    def pose(self, stamp_ns: int, time_s: float) -> Any:
        position, q = pose(time_s)
        at = self.make("geometry_msgs/msg/Point", *map(float, position))
        turn = self.make("geometry_msgs/msg/Quaternion", *map(float, q))
        return self.make(
            "geometry_msgs/msg/PoseStamped", self.header(stamp_ns, "base_link"),
            self.make("geometry_msgs/msg/Pose", at, turn),
        )  # fmt: skip

    def image(self, stamp_ns: int, time_s: float, encoding: str) -> tuple[str, Any]:
        """`encoding` like those of image_transport where it names a file."""
        header, pixels = self.header(stamp_ns, "optical"), picture(time_s)
        if "png" in encoding:
            file = cv2.imencode(".png", pixels)[1]
            return "/cam/image", self.make("sensor_msgs/msg/CompressedImage", header, encoding, file)
        return "/cam/image_raw", self.make(
            "sensor_msgs/msg/Image", header, HEIGHT, WIDTH, encoding, 0, WIDTH, pixels.ravel()
        )

    def message(self, stamp_ns: int, kind: str, time_s: float, encoding: str) -> tuple[str, Any]:
        if kind == "tf":
            frame = self.transform(stamp_ns, "base_link", "tool0", *pose(time_s))
            return "/tf", self.make("tf2_msgs/msg/TFMessage", [frame])
        if kind == "joints":
            at = progress_of(time_s)
            speed = (progress_of(time_s + 1e-3) - at) * 1e3
            q = np.array([3.0, 2.0, 1.0, 4.0, 5.0, 6.0]) + 0.1 * at
            return "/joint_states", self.make(
                "sensor_msgs/msg/JointState", self.header(stamp_ns, ""), list(JOINTS), q,
                np.full(6, 0.1 * speed), np.empty(0),
            )  # fmt: skip
        if kind == "info":
            roi = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
            return "/cam/camera_info", self.make(
                "sensor_msgs/msg/CameraInfo", self.header(stamp_ns, "optical"), HEIGHT, WIDTH, "plumb_bob",
                np.zeros(5), np.array(K), np.eye(3).ravel(), np.zeros(12), 0, 0, roi,
            )  # fmt: skip
        return self.image(stamp_ns, time_s, encoding)


def write_rosbag2(path: Path, storage: str, compression: str = "none") -> Path:
    """`storage`: sqlite3 or mcap, by `rosbags`."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compression != "none":
        writer.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    return _filled(path, writer, RosMessages(), "serialize_cdr")


def _filled(path: Path, writer: Any, ros: RosMessages, serialize: str) -> Path:
    with writer:
        connections: dict[str, Any] = {}
        for stamp_ns, kind, time_s in moments():
            topic, message = ros.message(stamp_ns, kind, time_s, "mono8")
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=ros.store)
            data = getattr(ros.store, serialize)(message, message.__msgtype__)
            writer.write(connections[topic], stamp_ns + 3_000_000, data)
    return path


class Ros1Messages(RosMessages):
    """As ROS 1 has them: a header that counts, a camera's numbers in capitals, and no tf2 among the usual."""

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.store = get_typestore(Stores.ROS1_NOETIC)
        frames = "geometry_msgs/TransformStamped[] transforms"
        self.store.register(get_types_from_msg(frames, "tf2_msgs/msg/TFMessage"))

    def header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9))
        return self.make("std_msgs/msg/Header", 7, stamp, frame)


def write_rosbag1(path: Path) -> Path:
    """A ROS 1 bag, by `rosbags`."""
    from rosbags.rosbag1 import Writer

    return _filled(path, Writer(path), Ros1Messages(), "serialize_ros1")


def write_ros_mcap(path: Path, poses: bool = False, encoding: str = "mono8", **options: Any) -> Path:
    """The same in one MCAP file, by the reference library's writer and its `options`.

    `poses`: a PoseStamped instead of every frame.
    """
    from mcap.writer import Writer

    ros = RosMessages()
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start("ros2")
        channels: dict[str, int] = {}
        for stamp_ns, kind, time_s in moments():
            topic, message = ros.message(stamp_ns, kind, time_s, encoding)
            if poses and kind == "tf":
                topic, message = "/arm/pose", ros.pose(stamp_ns, time_s)
            if topic not in channels:
                definition = ros.store.generate_msgdef(message.__msgtype__)[0].encode()
                schema = writer.register_schema(message.__msgtype__, "ros2msg", definition)
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = bytes(ros.store.serialize_cdr(message, message.__msgtype__))
            writer.add_message(channels[topic], stamp_ns, data, stamp_ns)
        writer.finish()
    return path


def write_by_foxglove_sdk(path: Path) -> Path:
    """The same messages, written by Foxglove's own library, packed as it likes."""
    library = FOLDER / "python"
    if not (library / "foxglove").is_dir():
        missing("foxglove-sdk")
    source = write_foxglove_mcap(path.with_name("source.mcap"))
    script = Path(__file__).with_name("foxglove_sdk.py")
    environment = {**os.environ, "PYTHONPATH": str(library)}
    subprocess.run([sys.executable, str(script), str(source), str(path)], env=environment, check=True)
    return path


def write_foxglove_json(path: Path) -> Path:
    """Foxglove's schemas in JSON, as its package @foxglove/schemas publishes and checks them."""
    from mcap.writer import Writer

    validate = library("jsonschema_rs", "jsonschema-rs").validate
    modules, node = FOLDER / "node" / "node_modules", shutil.which("node")
    if node is None or not (modules / "@foxglove" / "schemas").is_dir():
        missing("@foxglove/schemas")
    told = 'process.stdout.write(JSON.stringify(require("@foxglove/schemas/jsonschema")))'
    environment = {**os.environ, "NODE_PATH": str(modules)}
    published = json.loads(subprocess.check_output([str(node), "-e", told], env=environment))
    with path.open("wb") as stream:
        writer, channels = Writer(stream), dict[str, int]()
        writer.start()
        for stamp_ns, kind, time_s in moments():
            topic, name, fields = _foxglove_fields(kind, time_s)
            seconds, nanoseconds = divmod(stamp_ns, 10**9)
            fields["timestamp"] = {"sec": seconds, "nsec": nanoseconds}
            if topic not in channels:
                validate(published[name], fields)
                definition = json.dumps(published[name]).encode()
                schema = writer.register_schema(f"foxglove.{name}", "jsonschema", definition)
                channels[topic] = writer.register_channel(topic, "json", schema)
            writer.add_message(channels[topic], stamp_ns, json.dumps(fields).encode(), stamp_ns)
        writer.finish()
    return path


def _foxglove_fields(kind: str, time_s: float) -> tuple[str, str, dict[str, Any]]:
    """Topic, schema, message."""
    if kind == "tf":
        position, q = (dict(zip("xyzw", numbers.tolist(), strict=False)) for numbers in pose(time_s))
        names = {"parent_frame_id": "base_link", "child_frame_id": "tool0"}
        return "/frames", "FrameTransform", {**names, "translation": position, "rotation": q}
    if kind == "joints":
        moved = [{"name": name, "position": progress_of(time_s)} for name in JOINTS]
        return "/joints", "JointStates", {"joints": moved}
    size = {"frame_id": "camera", "width": WIDTH, "height": HEIGHT}
    if kind == "info":
        lens = {"distortion_model": "plumb_bob", "D": [0.0] * 5, "K": K, "R": np.eye(3).ravel().tolist()}
        return "/cam/calibration", "CameraCalibration", {**size, **lens, "P": [0.0] * 12}
    data = base64.b64encode(picture(time_s).tobytes()).decode()
    return "/cam/image", "RawImage", {**size, "encoding": "mono8", "step": WIDTH, "data": data}


def write_foxglove_mcap(path: Path) -> Path:
    """The same in protobuf, by Foxglove's Python library."""
    from google.protobuf.json_format import ParseDict
    from mcap_protobuf.writer import Writer

    with path.open("wb") as stream:
        writer = Writer(stream)
        for stamp_ns, kind, time_s in moments():
            topic, name, fields = _foxglove_fields(kind, time_s)
            made = getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)
            message = ParseDict(fields, made())
            message.timestamp.seconds, message.timestamp.nanos = divmod(stamp_ns, 10**9)
            writer.write_message(topic, message, stamp_ns, stamp_ns)
        writer.finish()
    return path
