"""Messages of the published foxglove schemas (protobuf) as the importer's values."""

from __future__ import annotations

from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError

from recordings.errors import ImportSourceError
from recordings.importers.values import Camera, Frame, ImageMessage, Joints, Kind, Value
from recordings.schema.viewing import camera_model_of

_MESSAGES: dict[str, tuple[Any, Kind]] = {
    "foxglove.RawImage": (RawImage, Kind.IMAGE),
    "foxglove.CompressedImage": (CompressedImage, Kind.IMAGE),
    "foxglove.CameraCalibration": (CameraCalibration, Kind.CAMERA),
    "foxglove.JointStates": (JointStates, Kind.JOINTS),
    "foxglove.FrameTransform": (FrameTransform, Kind.TRANSFORMS),
    "foxglove.FrameTransforms": (FrameTransforms, Kind.TRANSFORMS),
    "foxglove.PoseInFrame": (PoseInFrame, Kind.POSE),
}
KINDS = {name: kind for name, (_, kind) in _MESSAGES.items()}
_NS = 1_000_000_000


def value(schema: str, data: bytes, time_ns: int) -> Value:
    """`time_ns`: when it was recorded; stands in for a stamp that is missing."""
    try:
        message = _MESSAGES[schema][0].FromString(data)
    except DecodeError as error:
        raise ImportSourceError(f"a {schema} cannot be decoded ({error})") from error
    if schema == "foxglove.FrameTransforms":
        return [_frame(transform, time_ns) for transform in message.transforms]
    if schema == "foxglove.FrameTransform":
        return [_frame(message, time_ns)]
    stamp_ns = _stamp(message, time_ns)
    if schema == "foxglove.RawImage":
        return ImageMessage(
            stamp_ns,
            message.frame_id,
            message.width,
            message.height,
            message.encoding,
            message.step,
            message.data,
        )
    if schema == "foxglove.CompressedImage":
        return ImageMessage(stamp_ns, message.frame_id, 0, 0, "compressed", 0, message.data)
    if schema == "foxglove.CameraCalibration":
        return Camera(message.frame_id, camera_model_of(message))
    if schema == "foxglove.JointStates":
        joints = message.joints
        speeds = tuple(j.velocity for j in joints) if all(j.HasField("velocity") for j in joints) else ()
        return Joints(stamp_ns, tuple(j.name for j in joints), tuple(j.position for j in joints), speeds)
    p, q = message.pose.position, message.pose.orientation
    return [Frame(stamp_ns, message.frame_id, "", (p.x, p.y, p.z), (q.x, q.y, q.z, q.w))]


def _stamp(message: Any, time_ns: int) -> int:
    return int(message.timestamp.seconds * _NS + message.timestamp.nanos) or time_ns


def _frame(message: Any, time_ns: int) -> Frame:
    t, q = message.translation, message.rotation
    return Frame(
        _stamp(message, time_ns),
        message.parent_frame_id,
        message.child_frame_id,
        (t.x, t.y, t.z),
        (q.x, q.y, q.z, q.w),
    )
