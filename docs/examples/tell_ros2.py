"""Tells the pose of any arm that ROS 2 knows: `python3 tell_ros2.py base_link tool0 | station post`.

Give the arm's base and flange as TF names them; `ros2 run tf2_tools view_frames` draws them. Joints come from
/joint_states, in the order of the names given after the frames; without names none are told.
"""

import json
import sys

import rclpy
from rclpy.time import Time
from sensor_msgs.msg import JointState
from tf2_ros import Buffer, TransformException, TransformListener

PERIOD_S = 0.02


def main(base: str, flange: str, *names: str) -> None:
    rclpy.init()
    node = rclpy.create_node("tell_pose")
    buffer = Buffer()
    listener = TransformListener(buffer, node)  # noqa: F841  it lives as long as its name
    joints: dict[str, float] = {}

    def heard(message: JointState) -> None:
        joints.update(zip(message.name, message.position, strict=True))

    def tell() -> None:
        try:
            found = buffer.lookup_transform(base, flange, Time())
        except TransformException:
            return
        at, turn, stamp = found.transform.translation, found.transform.rotation, found.header.stamp
        told = {
            "base_from_flange": [at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w],
            "t": stamp.sec + stamp.nanosec / 1e9,
        }
        if names and all(name in joints for name in names):
            told["joints_rad"] = [joints[name] for name in names]
        print(json.dumps(told), flush=True)

    print(json.dumps({"source": "live"}), flush=True)
    node.create_subscription(JointState, "/joint_states", heard, 10)
    node.create_timer(PERIOD_S, tell)
    rclpy.spin(node)


if __name__ == "__main__":
    main(*sys.argv[1:])
