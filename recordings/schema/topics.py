"""Topics of a recording and their schemas."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap_protobuf.schema import build_file_descriptor_set

from recordings.schema.definitions import ClockReading, PictureFacts, message_class
from recordings.schema.messages import CaptureEvent, RobotState, View


class Topic(StrEnum):
    ROBOT_STATE = "/robot/state"
    PICTURE_FACTS = "/camera/frame"
    CLOCK_READING = "/camera/clock"
    RAW_IMAGE = "/camera/image"
    COMPRESSED_IMAGE = "/camera/image/compressed"
    CAMERA_CALIBRATION = "/camera/calibration"
    VIEW = "/session/view"
    EVENT = "/session/event"
    TRANSFORM = "/tf"
    FIXED_TRANSFORM = "/tf_static"
    """The camera's. The board has its own: viewers that jump to a time take one message of each topic."""
    BOARD_TRANSFORM = "/tf_static/board"
    JOINTS = "/joint_states"
    ANNOTATIONS = "/camera/annotations"
    LOG = "/log"


_MESSAGES: dict[Topic, Any] = {
    Topic.ROBOT_STATE: message_class(RobotState),
    Topic.PICTURE_FACTS: message_class(PictureFacts),
    Topic.CLOCK_READING: message_class(ClockReading),
    Topic.RAW_IMAGE: RawImage,
    Topic.COMPRESSED_IMAGE: CompressedImage,
    Topic.CAMERA_CALIBRATION: CameraCalibration,
    Topic.VIEW: message_class(View),
    Topic.EVENT: message_class(CaptureEvent),
    Topic.TRANSFORM: FrameTransform,
    Topic.FIXED_TRANSFORM: FrameTransform,
    Topic.BOARD_TRANSFORM: FrameTransform,
    Topic.JOINTS: JointStates,
    Topic.ANNOTATIONS: ImageAnnotations,
    Topic.LOG: Log,
}


def parse(topic: Topic, data: bytes) -> Any:
    """Protobuf message of a topic. Raises google.protobuf's DecodeError."""
    return _MESSAGES[topic].FromString(data)


def schema_name(topic: Topic) -> str:
    """Full protobuf name of the topic's message."""
    return str(_MESSAGES[topic].DESCRIPTOR.full_name)


def schema_bytes(topic: Topic) -> bytes:
    """The FileDescriptorSet that goes into the file."""
    descriptors: FileDescriptorSet = build_file_descriptor_set(_MESSAGES[topic])
    return bytes(descriptors.SerializeToString())
