"""Exports of a calibration to the file formats of other programs.

A format is a function from Calibration and FrameNames to the file's text, and its row in `FORMATS`. The
functions are in `ros`, `models` and `robot` (URDF), and `vision`, where `zivid` is a short example. Every
file begins with `frames.comment`. `tests/foreign` reads it with another library, and compares with known
points.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from calibrate.files.calibration import Calibration
from calibrate.files.exports import models, ros, vision
from calibrate.files.exports.frames import ExportError as ExportError
from calibrate.files.exports.frames import FrameNames as FrameNames
from calibrate.files.exports.robot import corrected_urdf
from calibrate.files.validity import require_usable


class Format(NamedTuple):
    suffix: str
    says: str
    """For `calibrate export --help`."""
    make: Callable[[Calibration, FrameNames], str]


FORMATS: dict[str, Format] = {
    "ros-camera-info": Format(".yaml", "ROS camera_info YAML: the intrinsics", ros.ros_camera_info),
    "ros-launch": Format(".launch.py", "ROS 2 launch file with the static transform", ros.ros_launch),
    "urdf": Format(".urdf", "URDF: camera body and optical frame", models.urdf),
    "opencv": Format(".yml", "OpenCV FileStorage: transform and intrinsics", vision.opencv),
    "halcon": Format(".dat", "HALCON pose: tool_in_cam_pose or base_in_cam_pose", vision.halcon),
    "zivid": Format(".yaml", "Zivid Matrix4x4: the transform, mm", vision.zivid),
    "ur-kinematics": Format(".yaml", "the corrected arm for ROS 2's ur_description", models.ur_kinematics),
}


def export(
    calibration: Calibration, name: str, frames: FrameNames | None = None, arm: bytes | None = None
) -> bytes:
    """Make the file's content. Raises ExportError for an unknown format, or one that cannot hold it.

    arm: a URDF of the arm, to be written with its corrected joints and the camera that belongs to them.

    An installed calibration (`frames.validity`) in doubt or withdrawn is refused as by `load_installed`.
    """
    if name not in FORMATS:
        raise ExportError(format=name, known=", ".join(FORMATS))
    frames = frames or FrameNames()
    if frames.validity is not None:
        anyway = "a calibration file that is named is exported all the same"
        require_usable(frames.validity, "The installed calibration", anyway)
    if name in ("opencv", "halcon", "zivid") and (frames.base, frames.flange) != (
        FrameNames.base,
        FrameNames.flange,
    ):
        raise ExportError("frames-of", format=name)
    if frames.attach and name not in ("ros-launch", "urdf"):
        raise ExportError("attach-of", format=name)
    if arm is not None:
        if name != "urdf":
            raise ExportError("arm-of-urdf")
        return corrected_urdf(calibration, frames, arm)
    return FORMATS[name].make(calibration, frames).encode()
