"""The formats by name, and the one call that makes a file's text."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from calibrate.errors import CalibrationError
from calibrate.files.calibration import Calibration
from calibrate.files.exports import (
    camera_info,
    easy_handeye2,
    opencv,
    plain_json,
    ros_transform,
    ur_tool,
    urdf,
)
from calibrate.files.exports.frames import FrameNames


class ExportError(CalibrationError):
    """This calibration cannot be written in that format, or there is no such format."""

    exit_code = 2


@dataclass(frozen=True)
class Format:
    suffix: str
    says: str
    text: Callable[[Calibration, FrameNames], str]


FORMATS: dict[str, Format] = {
    "ros-camera-info": Format(".yaml", "ROS camera_info YAML: the lens", camera_info.text),
    "ros-static-transform": Format(
        ".sh", "command line of ROS 2 static_transform_publisher", ros_transform.command
    ),
    "ros-launch": Format(
        ".launch.py", "ROS 2 launch file with the static transform", ros_transform.launch_file
    ),
    "urdf": Format(".urdf", "URDF joints: camera body and optical frame", urdf.text),
    "easy-handeye2": Format(".calib", "easy_handeye2 calibration", easy_handeye2.text),
    "opencv": Format(".yml", "OpenCV FileStorage: transform and lens", opencv.text),
    "json": Format(".json", "everything, as JSON", plain_json.text),
    "ur-tool": Format(".txt", "camera as tool (TCP) or feature on the UR pendant", ur_tool.text),
}


def export(calibration: Calibration, name: str, frames: FrameNames | None = None) -> str:
    """The file's text. Raises ExportError for an unknown format."""
    if name not in FORMATS:
        raise ExportError(f"there is no format {name!r}; there are: {', '.join(FORMATS)}.")
    return FORMATS[name].text(calibration, frames or FrameNames())
