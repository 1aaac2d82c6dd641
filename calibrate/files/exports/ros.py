"""Exports for ROS: camera_info, and a launch file with the static transform."""

from __future__ import annotations

import numpy as np

from calibrate.files.calibration import Calibration
from calibrate.files.exports.formats import export_format
from calibrate.files.exports.frames import FrameNames, comment, commented_yaml
from calibrate.views.projection import camera_matrix, distortion
from recordings.geometry import Array, quaternion_from_matrix


@export_format(".yaml")
def ros_camera_info(calibration: Calibration, frames: FrameNames) -> str:
    """The intrinsics, as a camera_info YAML.

    Lens: plumb_bob, rational_polynomial or equidistant; the middle of the top left pixel is (0, 0). Keys in
    the order of camera_calibration_parsers.
    """
    camera = calibration.intrinsics.model
    K, D = camera_matrix(camera), distortion(camera)
    plain = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": frames.name,
        "camera_matrix": _matrix(K),
        "distortion_model": "rational_polynomial" if len(D) == 8 else camera.distortion_model,
        "distortion_coefficients": _matrix(D[None]),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.hstack([K, np.zeros((3, 1))])),
    }
    return commented_yaml(calibration, frames, plain, default_flow_style=None, width=120)


def _matrix(values: Array) -> dict[str, object]:
    rows, cols = values.shape
    return {"rows": rows, "cols": cols, "data": values.ravel().tolist()}


def _publisher_arguments(calibration: Calibration, frames: FrameNames) -> list[str]:
    """Make static_transform_publisher's arguments; with a quaternion, as angles have several conventions."""
    parent, child = frames.parent(calibration), frames.attach or frames.camera
    T = frames.place(calibration, calibration.transform.matrix)
    T = frames.attached(parent, T) if frames.attach else T
    values = (*T[:3, 3], *quaternion_from_matrix(T[:3, :3]))
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    found = [part for name, value in zip(names, values, strict=True) for part in (name, repr(float(value)))]
    return [*found, "--frame-id", parent, "--child-frame-id", child]


@export_format(".launch.py", "attached")
def ros_launch(calibration: Calibration, frames: FrameNames) -> str:
    """The transform, as a ROS 2 launch file that publishes it.

    Place: maps points of the optical frame, or of the frame that `--attach` names, into the robot's; metres,
    quaternion x y z w.
    """
    listed = ",\n".join(f"                {part!r}" for part in _publisher_arguments(calibration, frames))
    return f'''# {comment(calibration, frames, attachable=True)}
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription([
        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            name="{frames.node}_publisher",
            arguments=[
{listed},
            ],
        ),
    ])
'''
