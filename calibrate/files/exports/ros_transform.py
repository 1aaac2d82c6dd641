"""ROS 2 static_transform_publisher: the command line and a launch file."""

from __future__ import annotations

import re
import shlex

from calibrate.files.calibration import Calibration
from calibrate.files.exports.frames import FrameNames, comment, number


def arguments(calibration: Calibration, frames: FrameNames) -> list[str]:
    """--x … --child-frame-id C; the quaternion, not angles, so that nothing can be misread."""
    values = (*calibration.result.translation_m, *calibration.result.rotation_xyzw)
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    found = [part for name, value in zip(names, values, strict=True) for part in (name, number(value))]
    return [*found, "--frame-id", frames.parent(calibration), "--child-frame-id", frames.camera]


def command(calibration: Calibration, frames: FrameNames) -> str:
    line = f"ros2 run tf2_ros static_transform_publisher {shlex.join(arguments(calibration, frames))}"
    return f"# {comment(calibration)}\n{line}\n"


def launch_file(calibration: Calibration, frames: FrameNames) -> str:
    node = re.sub(r"\W", "_", frames.camera, flags=re.ASCII)  # all that ROS allows in a node's name
    listed = ",\n".join(f"                {part!r}" for part in arguments(calibration, frames))
    return f'''# {comment(calibration)}
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription([
        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            name="{node}_publisher",
            arguments=[
{listed},
            ],
        ),
    ])
'''
