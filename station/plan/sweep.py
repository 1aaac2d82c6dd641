"""A sweep: slow swings about the place where the arm stands, with the board in view, while the camera runs.

What it shows is the time between camera and robot: for that the arm must turn, and faster and slower.
"""

from __future__ import annotations

import numpy as np

from recordings.schema.messages import Mount, Vector6
from station.cell.plan import Plan, PlannedPose

SWINGS = 8
JOINT_SPEED_RAD_S = 0.3
JOINT_ACCELERATION_RAD_S2 = 0.6
WRIST_SWING_RAD = 0.30
"""Of wrist 3, to either side: it turns the picture (or the board) nearly in its place."""
_TILT_RAD = 0.05
_SHARES = (1.0, -1.0, 0.6, -0.8, 1.0, -0.5, 0.8)
"""Of the full swing; unequal ones, so that no offset looks like a period."""


def sweep_plan(robot: str, mount: Mount, joints_rad: Vector6) -> Plan:
    """Swings about `joints_rad`, where they also end and where the camera must see the whole board."""
    start = np.array(joints_rad)
    poses = []
    for number in range(SWINGS):
        share = _SHARES[number] if number < SWINGS - 1 else 0.0
        tilt = _TILT_RAD * share * np.array([0, 0, 0, 1, 1 if number % 2 else -1, 0])
        target = start + tilt + WRIST_SWING_RAD * share * np.array([0, 0, 0, 0, 0, 1])
        a, b, c, d, e, f = (float(q) for q in target)
        poses.append(PlannedPose(f"swing {number + 1}", (a, b, c, d, e, f), why="turns, for the clocks"))
    return Plan(
        robot=robot,
        mount=mount,
        poses=tuple(poses),
        motion="sweep",
        joint_speed_rad_s=JOINT_SPEED_RAD_S,
        joint_acceleration_rad_s2=JOINT_ACCELERATION_RAD_S2,
        note="sweep about where the arm stood",
    )
