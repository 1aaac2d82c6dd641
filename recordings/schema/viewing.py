"""The published foxglove messages that make a recording open in Foxglove, Lichtblick and rerun unaided."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from numpy.typing import ArrayLike, NDArray

from recordings.geometry import quaternion_from_matrix
from recordings.images import Pixels, raw_encoding
from recordings.schema.messages import CameraModel, CaptureEvent, RobotState

CAMERA_FRAME = "camera"
JOINT_NAMES = [
    f"{joint}_joint" for joint in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
]
"""Names of the UR ROS driver."""


def joint_names(count: int) -> list[str]:
    """Names of an arm's joints: those of the UR ROS driver for six."""
    return JOINT_NAMES if count == len(JOINT_NAMES) else [f"joint_{i + 1}" for i in range(count)]


DETECTED = (0.1, 0.9, 0.2)
"""Colour of corners as they were detected."""
_NS = 1_000_000_000
_LEVELS = {"debug": Log.DEBUG, "info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}
_FISHEYE = {"equidistant": "kannala_brandt"}
"""Foxglove's name for OpenCV's fisheye model."""


def _stamp(message: Any, time_ns: int) -> None:
    message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, _NS)


def raw_image(image: Pixels, pixel_format: str, time_ns: int) -> Any:
    """An image as it came. ImageError for odd arrays."""
    height, width = image.shape[:2]
    data = image.tobytes()
    message = RawImage(
        frame_id=CAMERA_FRAME,
        width=width,
        height=height,
        encoding=raw_encoding(image, pixel_format),
        step=len(data) // height,
        data=data,
    )
    _stamp(message, time_ns)
    return message


def compressed_image(data: bytes, format: str, time_ns: int) -> Any:
    """An image file."""
    message = CompressedImage(frame_id=CAMERA_FRAME, format=format, data=data)
    _stamp(message, time_ns)
    return message


def camera_calibration(model: CameraModel, time_ns: int) -> Any:
    """The intrinsics, which must be known, as a message."""
    message = CameraCalibration(
        frame_id=CAMERA_FRAME,
        width=model.width,
        height=model.height,
        distortion_model=_FISHEYE.get(model.distortion_model, model.distortion_model),
        D=model.distortion,
    )
    K = np.array(model.matrix, float)
    message.K.extend(K.ravel())
    message.R.extend(np.eye(3).ravel())
    message.P.extend(np.column_stack([K, np.zeros(3)]).ravel())
    _stamp(message, time_ns)
    return message


def frame_transform(parent: str, child: str, T: ArrayLike, time_ns: int) -> Any:
    """parent_from_child (4, 4), so that a 3D panel knows where things are."""
    matrix = np.asarray(T, dtype=float)
    message = FrameTransform(parent_frame_id=parent, child_frame_id=child)
    for name, place in zip("xyz", matrix[:3, 3].tolist(), strict=True):
        setattr(message.translation, name, place)
    for name, part in zip("xyzw", quaternion_from_matrix(matrix[:3, :3]).tolist(), strict=True):
        setattr(message.rotation, name, part)
    _stamp(message, time_ns)
    return message


def joint_states(state: RobotState, time_ns: int) -> Any:
    message = JointStates()
    speeds = state.joint_speeds_rad_s or (0.0,) * len(state.joints_rad)
    for name, position, velocity in zip(joint_names(len(speeds)), state.joints_rad, speeds, strict=True):
        message.joints.add(name=name, position=position, velocity=velocity)
    _stamp(message, time_ns)
    return message


@dataclass(frozen=True, eq=False)
class Marks:
    """Points that are drawn over an image, joined in pairs where `ends` is given."""

    points: NDArray[np.float64]
    """(n, 2), pixels; (0, 0) is the centre of the top left pixel."""
    colour: tuple[float, float, float]
    """Red, green, blue, each 0…1."""
    ends: NDArray[np.float64] | None = None
    """(n, 2): a line leads from each point to its end."""
    thickness_px: float = 4.0


def image_annotations(marks: Sequence[Marks], text: str, time_ns: int) -> Any:
    """`text` stands in the upper left corner. Viewers count from a pixel's corner: half a pixel is added."""
    message = ImageAnnotations()
    _stamp(message, time_ns)
    for mark in marks:
        kind = PointsAnnotation.POINTS if mark.ends is None else PointsAnnotation.LINE_LIST
        drawn = message.points.add(type=kind, thickness=mark.thickness_px)
        _stamp(drawn, time_ns)
        _paint(drawn.outline_color, mark.colour)
        points = mark.points if mark.ends is None else np.stack([mark.points, mark.ends], 1).reshape(-1, 2)
        for x, y in points + 0.5:
            drawn.points.add(x=x, y=y)
    if text:
        label = message.texts.add(text=text, font_size=24)
        _stamp(label, time_ns)
        label.position.x, label.position.y = 10, 34
        _paint(label.text_color, marks[-1].colour if marks else (1.0, 1.0, 1.0))
        label.background_color.a = 0.6
    return message


def _paint(colour: Any, rgb: tuple[float, float, float]) -> None:
    colour.r, colour.g, colour.b, colour.a = *rgb, 1.0


def log_line(event: CaptureEvent, time_ns: int) -> Any:
    text = event.detail or event.kind
    if event.pose_index is not None:
        text = f"pose {event.pose_index + 1}: {text}"
    message = Log(level=_LEVELS[event.level], message=text, name=event.kind)
    _stamp(message, time_ns)
    return message
