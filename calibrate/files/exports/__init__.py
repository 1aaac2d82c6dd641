"""Exports of a calibration to the file formats of other programs.

A format is a function from Calibration and FrameNames to the file's text, and its row in `FORMATS`: the
command, its help and the tests take it from there. `vision.zivid` is a short example. The camera's place is
`calibration.transform.matrix`, the camera's optical frame in its parent, (4, 4) in metres, its lens
`calibration.intrinsics.model`. Every file holds `frames.comment`, as a comment or a text of its own. A
reader in `tests/foreign/export_readers.py`, by another library or by that program's own rule, must find 500
known points where the calibration shows them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

from calibrate.errors import UsageError
from calibrate.files.calibration import Calibration
from calibrate.files.exports import models, ros, vision
from calibrate.files.exports.frames import FrameNames as FrameNames
from calibrate.files.exports.robot import corrected_urdf
from calibrate.files.validity import require_usable


class Format(NamedTuple):
    suffix: str
    says: str
    """For `calibrate export --help`."""
    make: Callable[[Calibration, FrameNames], str]
    frames: Literal["fixed", "named", "attached"] = "fixed"
    """fixed: it names no frame of the robot, and refuses others. named: it does, and others may be given
    (`frames.place`). attached: it can place a camera driver's own frame, too."""


FORMATS: dict[str, Format] = {
    "ros-camera-info": Format(".yaml", "ROS camera_info YAML: the intrinsics", ros.ros_camera_info),
    "ros-launch": Format(
        ".launch.py", "ROS 2 launch file with the static transform", ros.ros_launch, "attached"
    ),
    "urdf": Format(".urdf", "URDF: camera body and optical frame", models.urdf, "attached"),
    "opencv": Format(".yml", "OpenCV FileStorage: transform and intrinsics", vision.opencv),
    "halcon": Format(".dat", "HALCON pose: tool_in_cam_pose or base_in_cam_pose", vision.halcon),
    "zivid": Format(".yaml", "Zivid Matrix4x4: the transform, mm", vision.zivid),
    "ur-kinematics": Format(
        ".yaml", "the corrected arm for ROS 2's ur_description", models.ur_kinematics, "named"
    ),
}


def export(
    calibration: Calibration, name: str, frames: FrameNames | None = None, arm: bytes | None = None
) -> bytes:
    """Make the file's content. Raises UsageError for an unknown format, or one that cannot hold it.

    arm: a URDF of the arm, to be written with its corrected joints and the camera that belongs to them.

    An installed calibration (`frames.validity`) in doubt or withdrawn is refused as by `load_installed`.
    """
    if name not in FORMATS:
        raise UsageError("export-format", format=name, known=", ".join(FORMATS))
    form, frames, usual = FORMATS[name], frames or FrameNames(), FrameNames()
    if frames.validity is not None:
        anyway = "a calibration file that is named is exported all the same"
        require_usable(frames.validity, "The installed calibration", anyway)
    if form.frames == "fixed" and (frames.base, frames.flange) != (usual.base, usual.flange):
        raise UsageError("frames-of", format=name)
    if frames.attach and form.frames != "attached":
        raise UsageError("attach-of", format=name)
    if arm is not None:
        if name != "urdf":
            raise UsageError("arm-of-urdf")
        return corrected_urdf(calibration, frames, arm)
    return form.make(calibration, frames).encode()
