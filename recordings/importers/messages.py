"""Messages of bags that an import can use, decoded from ROS or foxglove (protobuf, JSON).

One type per kind of message, times in ns. ROS messages need `rosbags` (the extra `ros`).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.json_format import ParseDict
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

from recordings.errors import ImportSourceError
from recordings.schema.messages import CameraModel
from recordings.schema.viewing import camera_model_of, intrinsics

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], None]
"""Is told how much is done, of how much, and what is being done."""


class Kind(Enum):
    """Content of a topic."""

    IMAGE = "images"
    CAMERA = "camera calibration"
    JOINTS = "joints"
    TRANSFORMS = "frames"
    POSE = "poses"


@dataclass(frozen=True, eq=False)
class ImageMessage:
    stamp_ns: int
    width: int
    """0 for a PNG or JPEG file, like height and step."""
    height: int
    encoding: str
    """ROS's name: mono8, bgr8, bayer_rggb8 …; of a file: that of the pixels in it, where it is said."""
    step: int
    """Bytes of a row."""
    data: bytes


@dataclass(frozen=True)
class JointMessage:
    stamp_ns: int
    names: tuple[str, ...]
    positions_rad: tuple[float, ...]
    speeds_rad_s: tuple[float, ...]


@dataclass(frozen=True)
class FrameMessage:
    """parent_from_child at one time; PoseStamped: of the thing that moves, in `parent`."""

    stamp_ns: int
    parent: str
    child: str
    position_m: tuple[float, float, float]
    rotation_xyzw: tuple[float, float, float, float]


Value = ImageMessage | CameraModel | JointMessage | list[FrameMessage]


CDR, PROTOBUF, JSON = "cdr", "protobuf", "json"
_FOXGLOVE: dict[str, tuple[Any, Kind]] = {
    "foxglove.RawImage": (RawImage, Kind.IMAGE),
    "foxglove.CompressedImage": (CompressedImage, Kind.IMAGE),
    "foxglove.CameraCalibration": (CameraCalibration, Kind.CAMERA),
    "foxglove.JointStates": (JointStates, Kind.JOINTS),
    "foxglove.FrameTransform": (FrameTransform, Kind.TRANSFORMS),
    "foxglove.FrameTransforms": (FrameTransforms, Kind.TRANSFORMS),
    "foxglove.PoseInFrame": (PoseInFrame, Kind.POSE),
}
_ROS = {
    "sensor_msgs/msg/Image": Kind.IMAGE,
    "sensor_msgs/msg/CompressedImage": Kind.IMAGE,
    "sensor_msgs/msg/CameraInfo": Kind.CAMERA,
    "sensor_msgs/msg/JointState": Kind.JOINTS,
    "tf2_msgs/msg/TFMessage": Kind.TRANSFORMS,
    "geometry_msgs/msg/TransformStamped": Kind.TRANSFORMS,
    "geometry_msgs/msg/PoseStamped": Kind.POSE,
}
_NS = 1_000_000_000


def kind_of(encoding: str, schema: str) -> Kind | None:
    """Return the content of such messages; None for kinds that are not used here."""
    if encoding in (PROTOBUF, JSON):
        return _FOXGLOVE[schema][1] if schema in _FOXGLOVE else None
    return _ROS.get(schema) if encoding == CDR else None


def decoded(
    encoding: str, schema: str, data: bytes, time_ns: int, deserialize: Callable[[bytes, str], Any]
) -> Value:
    """`time_ns`: when it was recorded; stands in for a stamp that is missing. Raises ImportSourceError.

    `deserialize`: makes a message of ROS's bytes.
    """
    try:
        if encoding == PROTOBUF:
            return _from_foxglove(schema, _FOXGLOVE[schema][0].FromString(data), time_ns)
        if encoding == JSON:
            fields = json.loads(data, object_hook=_protobufs_time)
            message = ParseDict(fields, _FOXGLOVE[schema][0](), ignore_unknown_fields=True)
            return _from_foxglove(schema, message, time_ns)
        message = deserialize(data, schema)
    except ImportSourceError:
        raise
    except Exception as error:  # whatever rosbags makes of bytes that are no message
        raise ImportSourceError("undecodable-message", schema=schema, reason=repr(error)) from error
    return _from_ros(schema, message, time_ns)


def _protobufs_time(found: dict[str, Any]) -> object:
    """A time of foxglove's JSON schemas as protobuf's JSON spells it; any other object as it is."""
    if found.keys() != {"sec", "nsec"}:
        return found
    return Timestamp(seconds=found["sec"], nanos=found["nsec"]).ToJsonString()


@cache
def ros_types() -> Any:
    """The message types of ROS 2 Humble. ImportSourceError when `rosbags` is not installed."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportSourceError("missing-package") from error
    return get_typestore(Stores.ROS2_HUMBLE)


def _frame(stamp_ns: int, parent: str, child: str, at: Any, turn: Any) -> FrameMessage:
    return FrameMessage(stamp_ns, parent, child, (at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w))


def _from_foxglove(schema: str, message: Any, time_ns: int) -> Value:
    if schema == "foxglove.FrameTransforms":
        return [_foxglove_frame(transform, time_ns) for transform in message.transforms]
    if schema == "foxglove.FrameTransform":
        return [_foxglove_frame(message, time_ns)]
    stamp_ns, frame = _foxglove_stamp(message, time_ns), getattr(message, "frame_id", "")
    if schema == "foxglove.RawImage":
        size = (message.width, message.height)
        return ImageMessage(stamp_ns, *size, message.encoding, message.step, message.data)
    if schema == "foxglove.CompressedImage":
        return ImageMessage(stamp_ns, 0, 0, "", 0, message.data)
    if schema == "foxglove.CameraCalibration":
        return camera_model_of(message)
    if schema == "foxglove.JointStates":
        joints = message.joints
        speeds = tuple(j.velocity for j in joints) if all(j.HasField("velocity") for j in joints) else ()
        return JointMessage(
            stamp_ns, tuple(j.name for j in joints), tuple(j.position for j in joints), speeds
        )
    return [_frame(stamp_ns, frame, "", message.pose.position, message.pose.orientation)]


def _foxglove_stamp(message: Any, time_ns: int) -> int:
    return int(message.timestamp.seconds * _NS + message.timestamp.nanos) or time_ns


def _foxglove_frame(message: Any, time_ns: int) -> FrameMessage:
    names = (message.parent_frame_id, message.child_frame_id)
    return _frame(_foxglove_stamp(message, time_ns), *names, message.translation, message.rotation)


def _from_ros(schema: str, message: Any, time_ns: int) -> Value:
    if schema == "tf2_msgs/msg/TFMessage":
        return [_ros_frame(transform, time_ns) for transform in message.transforms]
    if schema == "geometry_msgs/msg/TransformStamped":
        return [_ros_frame(message, time_ns)]
    stamp_ns, frame = _ros_stamp(message.header, time_ns), str(message.header.frame_id)
    if schema == "sensor_msgs/msg/Image":
        if message.is_bigendian and "16" in message.encoding:
            raise ImportSourceError("big-endian")
        size = (message.width, message.height)
        return ImageMessage(stamp_ns, *size, message.encoding, message.step, message.data.tobytes())
    if schema == "sensor_msgs/msg/CompressedImage":
        encoding = message.format.partition(";")[
            0
        ]  # "bayer_rggb8; png compressed", as image_transport writes
        return ImageMessage(stamp_ns, 0, 0, encoding, 0, message.data.tobytes())
    if schema == "sensor_msgs/msg/CameraInfo":
        size = (message.width, message.height)
        k, d = (message.K, message.D) if hasattr(message, "K") else (message.k, message.d)  # ROS 1, ROS 2
        return intrinsics(*size, k, d, message.distortion_model)
    if schema == "sensor_msgs/msg/JointState":
        speeds = tuple(map(float, message.velocity))
        return JointMessage(stamp_ns, tuple(message.name), tuple(map(float, message.position)), speeds)
    return [_frame(stamp_ns, frame, "", message.pose.position, message.pose.orientation)]


def _ros_stamp(header: Any, time_ns: int) -> int:
    return int(header.stamp.sec * _NS + header.stamp.nanosec) or time_ns


def _ros_frame(message: Any, time_ns: int) -> FrameMessage:
    names, moved = (message.header.frame_id, message.child_frame_id), message.transform
    return _frame(_ros_stamp(message.header, time_ns), *names, moved.translation, moved.rotation)
