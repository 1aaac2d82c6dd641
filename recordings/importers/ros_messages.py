"""ROS 2 messages (CDR) as the importer's values, decoded by `rosbags` (the extra `ros`)."""

from __future__ import annotations

import struct
from typing import Any

from recordings.errors import ImportSourceError
from recordings.importers.values import Camera, Frame, ImageMessage, Joints, Kind, Value
from recordings.schema.viewing import intrinsics

KINDS = {
    "sensor_msgs/msg/Image": Kind.IMAGE,
    "sensor_msgs/msg/CompressedImage": Kind.IMAGE,
    "sensor_msgs/msg/CameraInfo": Kind.CAMERA,
    "sensor_msgs/msg/JointState": Kind.JOINTS,
    "tf2_msgs/msg/TFMessage": Kind.TRANSFORMS,
    "geometry_msgs/msg/TransformStamped": Kind.TRANSFORMS,
    "geometry_msgs/msg/PoseStamped": Kind.POSE,
}
_NS = 1_000_000_000
_LITTLE_ENDIAN = 1
STAMP_BYTES = 12
"""Of a message with a header: the encapsulation's four, seconds, nanoseconds."""


class RosDecoder:
    """Raises ImportSourceError when `rosbags` is not installed."""

    def __init__(self) -> None:
        try:
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise ImportSourceError(
                "ROS messages need the package rosbags: pip install 'calibration-station[ros]'"
            ) from error
        self._store = get_typestore(Stores.ROS2_HUMBLE)

    def value(self, schema: str, data: bytes, time_ns: int) -> Value:
        """`time_ns`: when it was recorded; stands in for a stamp of zero."""
        try:
            message = self._store.deserialize_cdr(data, schema)
        except Exception as error:  # whatever the library makes of bytes that are no message
            raise ImportSourceError(f"a {schema} cannot be decoded ({error!r})") from error
        return _value(schema, message, time_ns)


def image_stamp_ns(data: bytes, time_ns: int) -> int:
    """The stamp of a message that begins with a header, without decoding the rest."""
    if len(data) < STAMP_BYTES:
        raise ImportSourceError(f"a picture's message has {len(data)} bytes: it is no ROS 2 message")
    order = "<" if data[1] == _LITTLE_ENDIAN else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", data, 4)
    return int(seconds * _NS + nanoseconds) or time_ns


def _stamp(header: Any, time_ns: int) -> int:
    return int(header.stamp.sec * _NS + header.stamp.nanosec) or time_ns


def _value(schema: str, message: Any, time_ns: int) -> Value:
    if schema == "tf2_msgs/msg/TFMessage":
        return [_frame(transform, time_ns) for transform in message.transforms]
    if schema == "geometry_msgs/msg/TransformStamped":
        return [_frame(message, time_ns)]
    stamp_ns, frame = _stamp(message.header, time_ns), str(message.header.frame_id)
    if schema == "sensor_msgs/msg/Image":
        if message.is_bigendian and "16" in message.encoding:
            raise ImportSourceError("its 16 bit pictures are big-endian; record them little-endian")
        return ImageMessage(
            stamp_ns,
            frame,
            message.width,
            message.height,
            message.encoding,
            message.step,
            message.data.tobytes(),
        )
    if schema == "sensor_msgs/msg/CompressedImage":
        return ImageMessage(stamp_ns, frame, 0, 0, "compressed", 0, message.data.tobytes())
    if schema == "sensor_msgs/msg/CameraInfo":
        return Camera(
            frame, intrinsics(message.width, message.height, message.k, message.d, message.distortion_model)
        )
    if schema == "sensor_msgs/msg/JointState":
        speeds = tuple(map(float, message.velocity))
        return Joints(stamp_ns, tuple(message.name), tuple(map(float, message.position)), speeds)
    p, q = message.pose.position, message.pose.orientation
    return [Frame(stamp_ns, frame, "", (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))]


def _frame(transform: Any, time_ns: int) -> Frame:
    t, q = transform.transform.translation, transform.transform.rotation
    return Frame(
        _stamp(transform.header, time_ns),
        transform.header.frame_id,
        transform.child_frame_id,
        (t.x, t.y, t.z),
        (q.x, q.y, q.z, q.w),
    )
