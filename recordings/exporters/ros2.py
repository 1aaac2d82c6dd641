"""A recording as a ROS 2 bag that can be played: written by `rosbags` (the extra `ros`), no ROS needed.

The image of every view, its CameraInfo and the flange's frame carry one stamp, that of mid-exposure. In
between the flange's frame follows at 100 Hz, the joints at their full rate.
"""

from __future__ import annotations

from collections.abc import Iterator
from heapq import merge
from itertools import chain
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from recordings.errors import RecordingError
from recordings.geometry import base_from_flange, quaternion_from_matrix
from recordings.images import mosaic_encoding, raw_encoding
from recordings.importers.messages import ros_types
from recordings.reader import Recording
from recordings.schema.messages import CameraModel, View
from recordings.schema.viewing import joint_names
from recordings.segment import RecordingSegment

FLANGE_FRAME, OPTICAL_FRAME = "tool0", "camera_calibrated_optical_frame"
"""As ROS names them; `calibrate export` uses the same for the flange."""
FRAME_PERIOD_NS = 10_000_000
_NS = 1_000_000_000
_LAST_S = 2**31 - 1
"""Latest second that builtin_interfaces/Time can hold."""
_BAG_VERSION: Literal[8] = 8
_DISTORTION_COUNT = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}


class _Entry(NamedTuple):
    time_ns: int
    topic: str
    message: Any


def write_ros2(recording: Recording, folder: Path) -> None:
    """Write `NAME.mcap` and `metadata.yaml` into the folder, stamped by wall time. Raises RecordingError."""
    messages = _Messages()
    from rosbags.rosbag2 import StoragePlugin, Writer

    arm = chain.from_iterable(_arm(messages, segment) for segment in recording.segments)
    inner = folder / recording.info.name
    with Writer(inner, version=_BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}
        for entry in merge(arm, _images(messages, recording), key=lambda entry: entry.time_ns):
            kind = entry.message.__msgtype__
            if entry.topic not in connections:
                connections[entry.topic] = writer.add_connection(entry.topic, kind, typestore=messages.store)
            data = messages.store.serialize_cdr(entry.message, kind)
            writer.write(connections[entry.topic], entry.time_ns, data)
    for path in inner.iterdir():
        path.rename(folder / path.name)
    inner.rmdir()


def _arm(messages: _Messages, segment: RecordingSegment) -> Iterator[_Entry]:
    """Joints and the flange's frame; a segment's flange is that of its own TCP offset."""
    shown_ns = -FRAME_PERIOD_NS
    for state in segment.robot_states():
        time_ns = state.stamps.host_wall_ns or segment.info.created_wall_ns
        joints = messages.make(
            "sensor_msgs/msg/JointState",
            messages.header(time_ns, ""),
            joint_names(len(state.joints_rad)),
            np.array(state.joints_rad),
            np.array(state.joint_speeds_rad_s),
            np.empty(0),
        )
        yield _Entry(time_ns, "/joint_states", joints)
        if not 0 <= time_ns - shown_ns < FRAME_PERIOD_NS and np.isfinite(state.tcp_pose).all():
            shown_ns = time_ns
            T = base_from_flange(state.tcp_pose, segment.info.robot.tcp_offset)
            yield _Entry(time_ns, "/tf", messages.frames("base", FLANGE_FRAME, T, time_ns))


def _images(messages: _Messages, recording: Recording) -> Iterator[_Entry]:
    """The views by time; those of an import, which have none, a second apart as the recording has them."""
    info = recording.info
    timed = [
        (view.stamps.host_wall_ns or info.created_wall_ns + view.index * _NS, view)
        for view in recording.views()
    ]
    for time_ns, view in sorted(timed, key=lambda each: each[0]):
        yield _Entry(time_ns, "/tf", messages.frames("base", FLANGE_FRAME, view.base_from_flange, time_ns))
        yield _Entry(time_ns, "/camera/camera_info", messages.camera_info(info.camera, time_ns))
        yield _image(messages, recording, view, time_ns)


def _image(messages: _Messages, recording: Recording, view: View, time_ns: int) -> _Entry:
    header, image = messages.header(time_ns, OPTICAL_FRAME), recording.image(view)
    if stored := recording.stored_image(view):
        file_format, file = stored[0], np.frombuffer(stored[1], np.uint8)
        if mosaic := mosaic_encoding(image.pixel_format):
            file_format = f"{mosaic}; {file_format} compressed"  # as image_transport says it
        message = messages.make("sensor_msgs/msg/CompressedImage", header, file_format, file)
        return _Entry(time_ns, "/camera/image_raw/compressed", message)
    height, width = image.pixels.shape[:2]
    data = np.ascontiguousarray(image.pixels).view(np.uint8).ravel()
    encoding = raw_encoding(image.pixels, image.pixel_format)
    message = messages.make(
        "sensor_msgs/msg/Image", header, height, width, encoding, 0, len(data) // height, data
    )
    return _Entry(time_ns, "/camera/image_raw", message)


class _Messages:
    """ROS 2's messages, made by the names of their types."""

    def __init__(self) -> None:
        self.store = ros_types()

    def make(self, kind: str, *fields: Any) -> Any:
        return self.store.types[kind](*fields)

    def header(self, time_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(time_ns, _NS)
        if seconds > _LAST_S:
            raise RecordingError("stamp-too-late", stamp_s=seconds, limit_s=_LAST_S)
        stamp = self.make("builtin_interfaces/msg/Time", seconds, nanoseconds)
        return self.make("std_msgs/msg/Header", stamp, frame)

    def frames(self, parent: str, child: str, T: ArrayLike, time_ns: int) -> Any:
        at = self.make("geometry_msgs/msg/Vector3", *np.array(T)[:3, 3].tolist())
        rotation_xyzw = quaternion_from_matrix(np.array(T)[:3, :3])
        turn = self.make("geometry_msgs/msg/Quaternion", *rotation_xyzw.tolist())
        placed = self.make("geometry_msgs/msg/Transform", at, turn)
        header = self.header(time_ns, parent)
        stamped = self.make("geometry_msgs/msg/TransformStamped", header, child, placed)
        return self.make("tf2_msgs/msg/TFMessage", [stamped])

    def camera_info(self, camera: CameraModel, time_ns: int) -> Any:
        K = np.array(camera.matrix or np.zeros((3, 3)), float)
        count = max(_DISTORTION_COUNT[camera.distortion_model], len(camera.distortion))
        D = [*camera.distortion, *[0.0] * count][:count] if camera.matrix else []
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            self.header(time_ns, OPTICAL_FRAME),
            camera.height,
            camera.width,
            camera.distortion_model,
            np.array(D, float),
            K.ravel(),
            np.eye(3).ravel(),
            np.column_stack([K, np.zeros(3)]).ravel(),
            0,
            0,
            self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False),
        )
