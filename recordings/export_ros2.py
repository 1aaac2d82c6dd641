"""A recording as a ROS 2 bag: profile ros2, CDR messages, `metadata.yaml`; no ROS needed to write it."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec

from recordings.cdr import definition_text, encode_cdr
from recordings.errors import RecordingError
from recordings.mcap.writer import McapFile
from recordings.messages import CameraModel, View
from recordings.part import RecordingPart
from recordings.pictures import raw_encoding
from recordings.reader import Recording
from recordings.topics import Topic
from recordings.viewing import CAMERA_FRAME, quaternion_xyzw

_NS = 1_000_000_000
_LAST_S = 2**31 - 1
"""That builtin_interfaces/Time can hold."""
_BAG_VERSION = 8
"""Of metadata.yaml: what ROS 2 Iron writes; offered_qos_profiles is still a text."""
_JOINTS = [
    f"{joint}_joint" for joint in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
]
"""As the UR ROS driver names them."""
_DISTORTION_COUNT = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}


def write_ros2(recording: Recording, folder: Path) -> None:
    """Fills the folder with `NAME.mcap` and `metadata.yaml`. Wall time is the bag's time."""
    name = f"{recording.info.name}.mcap"
    file = McapFile(folder / name)
    try:
        file.start(profile="ros2")
        bag = _Bag(file)
        for part in recording.parts:
            _write_part(bag, recording, part)
        bag.finish()
        os.fsync(file.descriptor)
    finally:
        file.close()
    (folder / "metadata.yaml").write_bytes(bag.metadata(name))


def _write_part(bag: _Bag, recording: Recording, part: RecordingPart) -> None:
    """In time order within each topic; a bag's reader sorts across topics by the chunks' times."""
    camera = part.info.camera
    if times := [message.time_ns for message in part.stored(Topic.PICTURE_FACTS)]:
        bag.add("/camera/camera_info", "sensor_msgs/CameraInfo", min(times), _camera_info(camera, min(times)))
    for stored, state in zip(part.stored(Topic.ROBOT_STATE), part.robot_states(), strict=True):
        time_ns = stored.time_ns
        joints = {
            "header": _header(time_ns, ""),
            "name": _JOINTS,
            "position": state.joints_rad,
            "velocity": state.joint_speeds_rad_s,
            "effort": [],
        }
        bag.add("/joint_states", "sensor_msgs/JointState", time_ns, joints)
    for time_ns, sequence in zip(times, part.picture_sequences(), strict=True):
        _write_picture(bag, part, sequence, time_ns)
    counted = recording.views()
    for stored, view in zip(part.stored(Topic.VIEW), part.views, strict=True):
        if view in counted:
            bag.add(
                "/tf",
                "tf2_msgs/TFMessage",
                stored.time_ns,
                {"transforms": [_transform(view, stored.time_ns)]},
            )


def _write_picture(bag: _Bag, part: RecordingPart, sequence: int, time_ns: int) -> None:
    header = _header(time_ns, CAMERA_FRAME)
    stored = part.stored_picture(sequence)
    if stored is not None:
        message: dict[str, Any] = {"header": header, "format": stored[0], "data": stored[1]}
        bag.add("/camera/image_raw/compressed", "sensor_msgs/CompressedImage", time_ns, message)
        return
    picture = part.picture(sequence)
    height, width = picture.image.shape[:2]
    data = picture.image.tobytes()
    message = {
        "header": header,
        "height": height,
        "width": width,
        "encoding": raw_encoding(picture.image, picture.pixel_format),
        "is_bigendian": 0,
        "step": len(data) // height,
        "data": data,
    }
    bag.add("/camera/image_raw", "sensor_msgs/Image", time_ns, message)


def _header(time_ns: int, frame: str) -> dict[str, Any]:
    seconds, nanoseconds = divmod(time_ns, _NS)
    if seconds > _LAST_S:
        raise RecordingError(
            f"a message is stamped {seconds} s after 1970, and ROS 2 ends in 2038: the host's clock was "
            "wrong. Export to csv or folder instead"
        )
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame}


def _camera_info(camera: CameraModel, time_ns: int) -> dict[str, Any]:
    K = [number for row in camera.matrix for number in row] if camera.matrix else [0.0] * 9
    count = _DISTORTION_COUNT[camera.distortion_model]
    return {
        "header": _header(time_ns, CAMERA_FRAME),
        "height": camera.height,
        "width": camera.width,
        "distortion_model": camera.distortion_model,
        "d": [*camera.distortion, *[0.0] * count][: max(count, len(camera.distortion))]
        if camera.matrix
        else [],
        "k": K,
        "r": [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0],
        "p": [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0],
        "binning_x": 0,
        "binning_y": 0,
        "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
    }


def _transform(view: View, time_ns: int) -> dict[str, Any]:
    T = view.base_from_flange
    return {
        "header": _header(time_ns, "base"),
        "child_frame_id": "flange",
        "transform": {
            "translation": dict(zip("xyz", (T[0][3], T[1][3], T[2][3]), strict=True)),
            "rotation": dict(zip("xyzw", quaternion_xyzw(T), strict=True)),
        },
    }


class _Bag:
    """An MCAP with rosbag2's conventions, and the counts that metadata.yaml needs."""

    def __init__(self, file: McapFile) -> None:
        self._file = file
        self._channels: dict[str, int] = {}
        self._kinds: dict[str, str] = {}
        self._counts: Counter[str] = Counter()
        self._span_ns: tuple[int, int] | None = None

    def add(self, topic: str, kind: str, time_ns: int, message: dict[str, Any]) -> None:
        if topic not in self._channels:
            package, name = kind.split("/")
            self._kinds[topic] = f"{package}/msg/{name}"
            schema = (self._kinds[topic], "ros2msg", definition_text(kind).encode())
            self._channels[topic] = self._file.register(topic, "cdr", schema, {"offered_qos_profiles": ""})
        content = encode_cdr(kind, message)
        self._file.message(self._channels[topic], [content], time_ns, self._counts[topic])
        self._counts[topic] += 1
        first, last = self._span_ns or (time_ns, time_ns)
        self._span_ns = min(first, time_ns), max(last, time_ns)

    def finish(self) -> None:
        self._file.finish()

    def metadata(self, file_name: str) -> bytes:
        first, last = self._span_ns or (0, 0)
        span = {
            "duration": {"nanoseconds": last - first},
            "starting_time": {"nanoseconds_since_epoch": first},
            "message_count": self._counts.total(),
        }
        topics = [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": kind,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": "",
                    "type_description_hash": "",
                },
                "message_count": self._counts[topic],
            }
            for topic, kind in self._kinds.items()
        ]
        described = {
            "version": _BAG_VERSION,
            "storage_identifier": "mcap",
            **span,
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file_name],
            "files": [{"path": file_name, **span}],
            "custom_data": None,
            "ros_distro": "unknown",
        }
        return msgspec.yaml.encode({"rosbag2_bagfile_information": described})
