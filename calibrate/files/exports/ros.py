"""Exports for ROS: camera_info, static transforms, a launch file that follows."""

from __future__ import annotations

import numpy as np

from calibrate.files.calibration import Calibration
from calibrate.files.exports.frames import ExportError, FrameNames, comment, commented_yaml
from calibrate.geometry import Array
from calibrate.projection import camera_matrix, distortion


def ros_camera_info(calibration: Calibration, frames: FrameNames) -> str:
    """Make a ROS camera_info YAML, keys in the order of camera_calibration_parsers."""
    camera = calibration.intrinsics.model
    K, D = camera_matrix(camera), distortion(camera)
    plain = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": frames.body.removesuffix("_link") or "camera",
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
    values = (*calibration.result.translation_m, *calibration.result.rotation_xyzw)
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    found = [part for name, value in zip(names, values, strict=True) for part in (name, repr(float(value)))]
    return [*found, "--frame-id", frames.parent(calibration), "--child-frame-id", frames.camera]


def ros_launch(calibration: Calibration, frames: FrameNames) -> str:
    listed = ",\n".join(f"                {part!r}" for part in _publisher_arguments(calibration, frames))
    return f'''# {comment(calibration, frames)}
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


def ros_launch_follow(calibration: Calibration, frames: FrameNames) -> str:
    """Make a launch file that runs itself as a node, which publishes what `calibrate follow` prints."""
    if not frames.follow:
        raise ExportError("not-installed")
    return _FOLLOWING.format(
        comment=comment(calibration, frames),
        command=list(frames.follow),
        frames={"base": frames.base, "flange": frames.flange, "camera": frames.camera},
        node=f"{frames.node}_publisher",
    )


_FOLLOWING = """\
# {comment}
# This file holds no values: it publishes the installed calibration, and again whenever that changes. One in
# doubt or withdrawn is not published, but /tf_static keeps what was published before.
import json
import subprocess
import sys

FOLLOW = {command!r}
FRAMES = {frames!r}


def generate_launch_description():
    from launch import LaunchDescription
    from launch.actions import ExecuteProcess

    return LaunchDescription([ExecuteProcess(cmd=[sys.executable, __file__], output="screen")])


def transform(result, stamp):
    from geometry_msgs.msg import TransformStamped

    message = TransformStamped()
    message.header.stamp = stamp
    message.header.frame_id = FRAMES[result["parent_frame"]]
    message.child_frame_id = FRAMES[result["child_frame"]]
    for place, numbers in (("translation", "translation_m"), ("rotation", "rotation_xyzw")):
        for axis, value in zip("xyzw", result[numbers]):
            setattr(getattr(message.transform, place), axis, value)
    return message


def main():
    import rclpy
    from tf2_ros.static_transform_broadcaster import StaticTransformBroadcaster

    rclpy.init()
    node = rclpy.create_node({node!r})
    broadcaster = StaticTransformBroadcaster(node)
    follower = subprocess.Popen(FOLLOW, stdout=subprocess.PIPE, text=True)
    try:
        for line in follower.stdout:
            change = json.loads(line)
            state = change["validity"]["state"] if change["validity"] else "unreadable"
            say = node.get_logger().info if state == "valid" else node.get_logger().error
            say("calibration version {{}}: {{}}".format(change["version"], change["text"]))
            if state in ("valid", "unverified"):
                broadcaster.sendTransform(transform(change["result"], node.get_clock().now().to_msg()))
        sys.exit(f"{{FOLLOW}} ended with code {{follower.wait()}}")
    except KeyboardInterrupt:
        pass
    finally:
        follower.terminate()


if __name__ == "__main__":
    main()
"""
