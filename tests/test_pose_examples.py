"""The examples that tell the pose of other makers' arms, against fakes of their libraries."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from recordings.geometry import pose_from_quaternion, pose_from_vector
from station.devices.posts import read_declaration, read_post

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
PLACE, TURN = [0.4, -0.2, 0.3], np.array([0.5, -0.1, 0.3, 0.8]) / np.linalg.norm([0.5, -0.1, 0.3, 0.8])
POSE = pose_from_quaternion(PLACE, TURN)
JOINTS = [0.1, -0.2, 0.3, -1.4, 0.5, 1.6, 0.7]
FAKES = {
    "tell_xarm.py": {
        "xarm/wrapper.py": """
class XArmAPI:
    axis = 7
    tcp_offset = [0, 0, 0, 0, 0, 0]
    def __init__(self, host): pass
    def get_position(self, is_radian): return 0, XARM
    def get_servo_angle(self, is_radian): return 0, DEGREES
"""
    },
    "tell_franka.py": {
        "pylibfranka.py": """
class RealtimeConfig: kIgnore = 1
class State: O_T_EE, F_T_EE, q = FRANKA, HAND, JOINTS
class Robot:
    def __init__(self, host, realtime): pass
    def read_once(self): return State
"""
    },
    "tell_ur.py": {
        "rtde_receive.py": """
import time
class RTDEReceiveInterface:
    def __init__(self, host): pass
    def isConnected(self): return True
    def getActualTCPPose(self): return UR
    def getActualQ(self): return JOINTS[:6]
    def getTimestamp(self): return time.monotonic()
"""
    },
    "tell_ros2.py": {
        "rclpy/__init__.py": """
from time import sleep
class Node:
    def create_subscription(self, kind, topic, heard, depth): self.heard = heard
    def create_timer(self, period, tell): self.tell = tell
def init(): pass
def create_node(name): return Node()
def spin(node):
    from types import SimpleNamespace
    while True:
        names = [f"j{i}" for i in range(7)][::-1]
        node.heard(SimpleNamespace(name=names, position=JOINTS[::-1]))
        node.tell()
        sleep(0.01)
""",
        "rclpy/time.py": "class Time: pass",
        "sensor_msgs/msg.py": "class JointState: pass",
        "tf2_ros.py": """
import time
from types import SimpleNamespace as N
class TransformException(Exception): pass
class TransformListener:
    def __init__(self, buffer, node): pass
class Buffer:
    asked = 0
    def lookup_transform(self, target, source, when):
        assert (target, source) == ("base_link", "tool0")
        self.asked += 1
        if self.asked == 1: raise TransformException
        now = time.monotonic_ns()
        stamp = N(sec=now // 10**9, nanosec=now % 10**9)
        x, y, z, qx, qy, qz, qw = ROS
        turn, at = N(x=qx, y=qy, z=qz, w=qw), N(x=x, y=y, z=z)
        return N(header=N(stamp=stamp), transform=N(translation=at, rotation=turn))
""",
    },
    "tell_csv.py": {},
}


def numbers() -> str:
    """What each library would tell of the same flange, as Python assignments."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_matrix(POSE[:3, :3])
    hand = pose_from_vector([0.0, 0.0, 0.1034, 0.0, 0.0, -np.pi / 4])
    values = {
        "JOINTS": JOINTS,
        "DEGREES": np.degrees(JOINTS).tolist(),
        "XARM": [*(1000 * x for x in PLACE), *turned.as_euler("xyz", degrees=True).tolist()],
        "FRANKA": (POSE @ hand).ravel(order="F").tolist(),
        "HAND": hand.ravel(order="F").tolist(),
        "UR": [*PLACE, *turned.as_rotvec().tolist()],
        "ROS": [*PLACE, *TURN.tolist()],
    }
    return "\n".join(f"{name} = {value}" for name, value in values.items()) + "\n"


@pytest.mark.parametrize("name", FAKES)
def test_an_example_tells_the_flange_and_the_joints(name: str, tmp_path: Path) -> None:
    for path, text in FAKES[name].items():
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text(numbers() + text)
    growing = tmp_path / "poses.csv"
    growing.write_text("0,0,0,0,0,0,1\n")
    words = {
        "tell_ros2.py": ["base_link", "tool0", *(f"j{i}" for i in range(7))],
        "tell_csv.py": [str(growing), "live"],
    }
    with subprocess.Popen(
        [sys.executable, EXAMPLES / name, *words.get(name, ["192.0.2.1"])],
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        stdout=subprocess.PIPE,
    ) as told:
        _, written = read_declaration(told.stdout.readline())
        if name == "tell_csv.py":
            with growing.open("a") as file:
                file.write(",".join(map(str, [*PLACE, *TURN, *JOINTS])) + "\n")
        post, pose = read_post(told.stdout.readline(), written)
        told.kill()
    assert np.abs(pose_from_vector(pose) - POSE).max() < 1e-9
    assert post.t is not None and post.joints_rad == pytest.approx(JOINTS[: len(post.joints_rad or ())])
    assert len(post.joints_rad or ()) == (6 if name == "tell_ur.py" else 7)
    assert len((EXAMPLES / name).read_text().splitlines()) <= 60
