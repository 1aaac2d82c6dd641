"""Guards against a mixed-up TCP: what lies between our flange pose and the controller's tool pose.

flange_from_tcp = forward(joints)⁻¹ · base_from_tcp, from one and the same sample. It must be the offset set
on the pendant, and it must not change. The controller knows the factory calibration of its arm, our nominal
table does not: they differ by some millimetres, so without `robot.kinematics` in the configuration the check
is coarse.
"""

from __future__ import annotations

import math

import numpy as np

from calibrate.geometry import Array, difference, inverse, pose_from_rotvec, rotation_log
from calibrate.kinematics import RobotModel, forward
from recordings.messages import RobotState, Vector6
from station.errors import RobotError

NOMINAL_TOLERANCE = (0.006, math.radians(1.0))
CALIBRATED_TOLERANCE = (0.0005, math.radians(0.1))
LONGEST_M = 1.0


class TcpCheck:
    """`calibrated`: the model carries this very arm's kinematics."""

    def __init__(self, model: RobotModel, first: RobotState, calibrated: bool) -> None:
        """Raises RobotError when the difference cannot be a tool: wrong model or wrong kinematics."""
        self._model = model
        self._tolerance_m, self._tolerance_rad = CALIBRATED_TOLERANCE if calibrated else NOMINAL_TOLERANCE
        self._flange_from_tcp = self._derive(first)
        length_m = float(np.linalg.norm(self._flange_from_tcp[:3, 3]))
        if length_m > LONGEST_M:
            raise RobotError(
                f"the controller's tool pose lies {length_m:.2f} m from the flange pose of a {model.name}: "
                "wrong robot.model, or a wrong TCP on the pendant (Installation → TCP)"
            )

    @property
    def offset(self) -> Vector6:
        """flange_from_tcp: x y z [m], rotation vector [rad]."""
        T = self._flange_from_tcp
        x, y, z, rx, ry, rz = np.concatenate([T[:3, 3], rotation_log(T[:3, :3])]).tolist()
        return (x, y, z, rx, ry, rz)

    def agree(self, stated: Vector6) -> None:
        """Raises RobotError unless the offset that the controller states explains its tool pose."""
        self._compare(
            pose_from_rotvec(stated[:3], stated[3:]),
            self._flange_from_tcp,
            "the flange pose of our kinematics and the controller's tool pose do not fit its TCP offset",
            "check robot.model and robot.kinematics in the configuration",
        )

    def check(self, state: RobotState) -> None:
        """Raises RobotError when the TCP on the pendant is another one than at connect."""
        self._compare(
            self._flange_from_tcp,
            self._derive(state),
            "the TCP offset on the pendant was changed during the session",
            "set it back, or end this session and begin a new one",
        )

    def _derive(self, state: RobotState) -> Array:
        base_from_tcp = pose_from_rotvec(state.tcp_pose[:3], state.tcp_pose[3:])
        return inverse(forward(self._model, state.joints_rad)) @ base_from_tcp

    def _compare(self, reference: Array, found: Array, what: str, remedy: str) -> None:
        delta = difference(found, reference)
        shift_m, turn_rad = float(np.linalg.norm(delta[:3])), float(np.linalg.norm(delta[3:]))
        if shift_m > self._tolerance_m or turn_rad > self._tolerance_rad:
            raise RobotError(
                f"TCP mix-up: {what} (by {shift_m * 1000:.1f} mm, {math.degrees(turn_rad):.2f}°): {remedy}"
            )
