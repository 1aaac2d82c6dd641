"""Exports of a calibration to the file formats of other programs."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import msgspec

from calibrate.files.calibration import Calibration, FramePose
from calibrate.files.exports import models, ros, vision
from calibrate.files.exports.frames import ExportError as ExportError
from calibrate.files.exports.frames import FrameNames as FrameNames
from calibrate.files.validity import require_usable


class Format(NamedTuple):
    suffix: str
    says: str
    make: Callable[[Calibration, FrameNames], str]
    of_table: bool = False
    """True: can hold the camera pose that belongs to the arm's corrected table."""


FORMATS: dict[str, Format] = {
    "ros-camera-info": Format(".yaml", "ROS camera_info YAML: the intrinsics", ros.ros_camera_info),
    "ros-launch": Format(".launch.py", "ROS 2 launch file with the static transform", ros.ros_launch, True),
    "urdf": Format(".urdf", "URDF: camera body and optical frame", models.urdf, True),
    "opencv": Format(".yml", "OpenCV FileStorage: transform and intrinsics", vision.opencv),
    "halcon": Format(".dat", "HALCON pose: tool_in_cam_pose or base_in_cam_pose", vision.halcon),
    "zivid": Format(".yaml", "Zivid Matrix4x4: the transform, mm", vision.zivid),
    "ur-kinematics": Format(".yaml", "the corrected arm for ROS 2's ur_description", models.ur_kinematics),
}


def export(calibration: Calibration, name: str, frames: FrameNames | None = None) -> bytes:
    """Make the file's content. Raises ExportError for an unknown format, or one that cannot hold it.

    An installed calibration (`frames.validity`) in doubt or withdrawn is refused as by `load_installed`.
    """
    if name not in FORMATS:
        raise ExportError(format=name, known=", ".join(FORMATS))
    frames = frames or FrameNames()
    if frames.validity is not None:
        anyway = "a calibration file that is named is exported all the same"
        require_usable(frames.validity, "The installed calibration", anyway)
    if frames.with_table:
        calibration = _of_table(calibration, name)
    return FORMATS[name].make(calibration, frames).encode()


def _of_table(calibration: Calibration, name: str) -> Calibration:
    """Replace X by the one that belongs to the arm's corrected table. Raises as `installable`."""
    if not FORMATS[name].of_table:
        able = ", ".join(other for other, one in FORMATS.items() if one.of_table)
        raise ExportError("not-of-table", format=name, able=able)
    _, X = models.table_of(calibration).installable()
    return msgspec.structs.replace(calibration, result=FramePose.of(X))
