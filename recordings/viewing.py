"""The published foxglove messages that make a recording open in Foxglove, Lichtblick and rerun unaided."""

from __future__ import annotations

from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from numpy.typing import NDArray

from recordings.mcap.writer import Piece
from recordings.messages import CameraModel, CaptureEvent, Matrix4, View
from recordings.pictures import raw_encoding

CAMERA_FRAME = "camera"
_NS = 1_000_000_000
_LEVELS = {"debug": Log.DEBUG, "info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}
_FISHEYE = {"equidistant": "kannala_brandt"}
"""Foxglove's name for OpenCV's fisheye model."""


def _stamp(message: Any, time_ns: int) -> None:
    message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, _NS)


def raw_image(image: NDArray[Any], pixel_format: str, time_ns: int) -> list[Piece]:
    """A picture as it came: the message in pieces, the pixels not copied. PictureError for odd arrays."""
    encoding = raw_encoding(image, pixel_format)
    pixels = np.ascontiguousarray(image).data.cast("B")
    height, width = image.shape[:2]
    message = RawImage(
        frame_id=CAMERA_FRAME, width=width, height=height, encoding=encoding, step=len(pixels) // height
    )
    _stamp(message, time_ns)
    return _with_data(message, pixels)


def compressed_image(data: bytes, format: str, time_ns: int) -> list[Piece]:
    """A picture file: the message in pieces."""
    message = CompressedImage(frame_id=CAMERA_FRAME, format=format)
    _stamp(message, time_ns)
    return _with_data(message, data)


def _with_data(message: Any, data: Piece) -> list[Piece]:
    """The message's bytes with its `data` field behind the others, where protobuf allows it to stand."""
    tag = message.DESCRIPTOR.fields_by_name["data"].number << 3 | 2
    length, rest = bytearray(), len(data)
    while rest > 127:
        length.append(rest & 127 | 128)
        rest >>= 7
    length.append(rest)
    return [message.SerializeToString() + bytes([tag]) + length, data]


def camera_calibration(model: CameraModel, time_ns: int) -> Any:
    """Intrinsics; a camera that is not calibrated has an all-zero K, as viewers expect."""
    message = CameraCalibration(
        frame_id=CAMERA_FRAME,
        width=model.width,
        height=model.height,
        distortion_model=_FISHEYE.get(model.distortion_model, model.distortion_model),
        D=model.distortion,
    )
    K = [number for row in model.matrix for number in row] if model.matrix else [0.0] * 9
    message.K.extend(K)
    message.R.extend(np.eye(3).ravel())
    message.P.extend([*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0])
    _stamp(message, time_ns)
    return message


def flange_transform(view: View, time_ns: int) -> Any:
    """base_from_flange of a view, so that a 3D panel shows where the pictures were taken."""
    T = view.base_from_flange
    x, y, z, w = quaternion_xyzw(T)
    message = FrameTransform(parent_frame_id="base", child_frame_id="flange")
    message.translation.x, message.translation.y, message.translation.z = T[0][3], T[1][3], T[2][3]
    message.rotation.x, message.rotation.y, message.rotation.z, message.rotation.w = x, y, z, w
    _stamp(message, time_ns)
    return message


def log_line(event: CaptureEvent, time_ns: int) -> Any:
    text = event.detail or event.kind
    if event.pose_index is not None:
        text = f"pose {event.pose_index + 1}: {text}"
    message = Log(level=_LEVELS[event.level], message=text, name=event.kind)
    _stamp(message, time_ns)
    return message


def quaternion_xyzw(transform: Matrix4) -> tuple[float, float, float, float]:
    """Of a rigid transform, w ≥ 0: the eigenvector of Bar-Itzhack's K (2000), good at any angle."""
    R = np.array(transform)
    K = np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
            [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
            [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
        ]
    )
    q = np.linalg.eigh(K)[1][:, -1]
    x, y, z, w = (q if q[3] >= 0 else -q).tolist()
    return x, y, z, w
