"""Messages of bags that an import can use, decoded from ROS or foxglove (protobuf, JSON).

One type per kind of message, times in ns. ROS messages need `rosbags` (the extra `ros`).
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from google.protobuf.json_format import ParseDict
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

from recordings.errors import ImportSourceError
from recordings.schema.messages import CameraModel

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


@dataclass(frozen=True)
class CameraMessage:
    raw: CameraModel
    rectified: CameraModel
    """Lens of the images from which a program took this distortion."""


Value = ImageMessage | CameraMessage | JointMessage | list[FrameMessage]


_KINDS = {
    "foxglove.RawImage": Kind.IMAGE,
    "foxglove.CompressedImage": Kind.IMAGE,
    "foxglove.CameraCalibration": Kind.CAMERA,
    "foxglove.JointStates": Kind.JOINTS,
    "foxglove.FrameTransform": Kind.TRANSFORMS,
    "foxglove.FrameTransforms": Kind.TRANSFORMS,
    "foxglove.PoseInFrame": Kind.POSE,
    "sensor_msgs/msg/Image": Kind.IMAGE,
    "sensor_msgs/msg/CompressedImage": Kind.IMAGE,
    "sensor_msgs/msg/CameraInfo": Kind.CAMERA,
    "sensor_msgs/msg/JointState": Kind.JOINTS,
    "tf2_msgs/msg/TFMessage": Kind.TRANSFORMS,
    "geometry_msgs/msg/TransformStamped": Kind.TRANSFORMS,
    "geometry_msgs/msg/PoseStamped": Kind.POSE,
}
_NS = 1_000_000_000
_LENS_MODELS: dict[str, Any] = {
    "plumb_bob": "plumb_bob",
    "brown_conrady": "plumb_bob",
    "kannala_brandt": "equidistant",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "rational_polynomial": "rational_polynomial",
}
"""Names of ROS and foxglove → ours; of others the numbers mean something else."""


def kind_of(encoding: str, schema: str) -> Kind | None:
    """Return the content of such messages; None for kinds that are not used here."""
    readable = ("protobuf", "json") if schema.startswith("foxglove.") else ("cdr",)
    return _KINDS.get(schema) if encoding in readable else None


def decoded(
    encoding: str, schema: str, data: bytes, time_ns: int, deserialize: Callable[[bytes, str], Any]
) -> Value:
    """`time_ns`: when it was recorded; stands in for a stamp that is missing. Raises ImportSourceError.

    `deserialize`: makes a message of ROS's bytes.
    """
    try:
        if encoding == "protobuf":
            message = _foxglove(schema).FromString(data)
        elif encoding == "json":
            fields = json.loads(data, object_hook=_protobufs_time)
            message = ParseDict(fields, _foxglove(schema)(), ignore_unknown_fields=True)
        else:
            message = deserialize(data, schema)
    except ImportSourceError:
        raise
    except Exception as error:  # whatever rosbags makes of bytes that are no message
        raise ImportSourceError("undecodable-message", schema=schema, reason=repr(error)) from error
    return _value(_KINDS[schema], message, time_ns)


@cache
def _foxglove(schema: str) -> Any:
    """The protobuf class of a published schema."""
    name = schema.removeprefix("foxglove.")
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


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


def _value(kind: Kind, message: Any, time_ns: int) -> Value:
    """`message`: of ROS, which has a header, or of foxglove; most of their fields have the same names."""
    if kind is Kind.TRANSFORMS:
        return [_transform(moved, time_ns) for moved in getattr(message, "transforms", [message])]
    stamp_ns = _stamp_ns(message, time_ns)
    if kind is Kind.POSE:
        frame = message.header.frame_id if hasattr(message, "header") else message.frame_id
        return [_frame(stamp_ns, frame or "base", "flange", message.pose.position, message.pose.orientation)]
    if kind is Kind.CAMERA:
        K, D, P = (getattr(message, name if hasattr(message, "K") else name.lower()) for name in "KDP")
        size = message.width, message.height
        straight = [number for place, number in enumerate(P) if place % 4 < 3]
        return CameraMessage(_lens(*size, K, D, message.distortion_model), _lens(*size, straight, (), ""))
    if kind is Kind.JOINTS and hasattr(message, "joints"):
        joints = message.joints
        speeds = tuple(j.velocity for j in joints) if all(j.HasField("velocity") for j in joints) else ()
        names, positions = tuple(j.name for j in joints), tuple(j.position for j in joints)
        return JointMessage(stamp_ns, names, positions, speeds)
    if kind is Kind.JOINTS:
        positions, speeds = (tuple(map(float, told)) for told in (message.position, message.velocity))
        return JointMessage(stamp_ns, tuple(message.name), positions, speeds)
    if not hasattr(message, "step"):
        # "bayer_rggb8; png compressed", as image_transport writes
        encoding = message.format.partition(";")[0]
        return ImageMessage(stamp_ns, 0, 0, encoding, 0, bytes(message.data))
    if getattr(message, "is_bigendian", False) and "16" in message.encoding:
        raise ImportSourceError("big-endian")
    size = (message.width, message.height)
    return ImageMessage(stamp_ns, *size, message.encoding, message.step, bytes(message.data))


def _stamp_ns(message: Any, time_ns: int) -> int:
    if hasattr(message, "header"):
        stamp = message.header.stamp
        return int(stamp.sec * _NS + stamp.nanosec) or time_ns
    return int(message.timestamp.seconds * _NS + message.timestamp.nanos) or time_ns


def _transform(message: Any, time_ns: int) -> FrameMessage:
    of_ros = hasattr(message, "header")
    parent = message.header.frame_id if of_ros else message.parent_frame_id
    moved, stamp_ns = message.transform if of_ros else message, _stamp_ns(message, time_ns)
    return _frame(stamp_ns, parent, message.child_frame_id, moved.translation, moved.rotation)


def _frame(stamp_ns: int, parent: str, child: str, at: Any, turn: Any) -> FrameMessage:
    return FrameMessage(stamp_ns, parent, child, (at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w))


def _lens(width: int, height: int, K: Any, D: Any, distortion_model: str) -> CameraModel:
    """Intrinsics; a K of zeros, or a distortion of another model, means that they are not known."""
    k = np.array(K, float).ravel()
    model: Any = _LENS_MODELS.get(distortion_model) if np.any(D) else "plumb_bob"
    if len(k) != 9 or not k[0] > 0 or model is None:
        return CameraModel(width, height)
    return CameraModel(
        width, height, tuple(map(tuple, k.reshape(3, 3).tolist())), tuple(map(float, D)), model
    )
