"""What clients see: the robot's present state as RTDE output variables, once per cycle."""

from __future__ import annotations

from typing import TYPE_CHECKING

from station.devices.rtde import RobotMode, RobotStatus, RuntimeState, SafetyMode, SafetyStatus
from station.simulation.controller.kinematics import Rigid, Six, compose, forward, from_pose, to_pose

if TYPE_CHECKING:
    from station.simulation.controller.robot import SimulatedRobot

_SAFETY_BITS = {
    SafetyMode.NORMAL: SafetyStatus.NORMAL,
    SafetyMode.REDUCED: SafetyStatus.REDUCED,
    SafetyMode.PROTECTIVE_STOP: SafetyStatus.PROTECTIVE_STOPPED | SafetyStatus.STOPPED_DUE_TO_SAFETY,
    SafetyMode.SAFEGUARD_STOP: SafetyStatus.SAFEGUARD_STOPPED | SafetyStatus.STOPPED_DUE_TO_SAFETY,
    SafetyMode.ROBOT_EMERGENCY_STOP: SafetyStatus.ROBOT_EMERGENCY_STOPPED
    | SafetyStatus.EMERGENCY_STOPPED
    | SafetyStatus.STOPPED_DUE_TO_SAFETY,
}
_JOINT_MODE = {RobotMode.RUNNING: 253, RobotMode.IDLE: 255}


class Publisher:
    def __init__(self, robot: SimulatedRobot) -> None:
        self._robot = robot
        self._seen: dict[str, tuple[Six, Six, Rigid]] = {}
        """Per tool pose: joints, TCP and pose it was last computed for."""
        out = robot.outputs
        out.set("joint_temperatures", *(28.0, 29.0, 30.0, 31.0, 32.0, 33.0))
        out.set("actual_main_voltage", 48.0)
        out.set("actual_robot_voltage", 48.0)
        out.set("actual_joint_voltage", *(48.0,) * 6)
        out.set("actual_execution_time", 0.0004)
        out.set("actual_tool_accelerometer", 0.0, 0.0, -9.81)

    def publish(self) -> None:
        robot, out, arm = self._robot, self._robot.outputs, self._robot.arm
        out.set("timestamp", robot.time_s)
        out.set("target_q", *arm.command)
        out.set("actual_q", *arm.actual)
        out.set("target_qd", *arm.command_speed)
        out.set("actual_qd", *arm.actual_speed)
        self._tool("target_TCP", arm.command)
        self._tool("actual_TCP", arm.actual)
        out.set("target_speed_fraction", robot.slider)
        out.set("speed_scaling", min(1.0, arm.scale / robot.slider) if robot.slider > 0 else 1.0)
        out.set("payload", robot.payload_kg)
        out.set("payload_cog", *robot.payload_cog)
        self._modes()

    def _modes(self) -> None:
        robot, out = self._robot, self._robot.outputs
        out.set("robot_mode", robot.robot_mode)
        out.set("safety_mode", robot.safety_mode)
        out.set("safety_status", robot.safety_mode)
        out.set("safety_status_bits", _SAFETY_BITS[robot.safety_mode])
        out.set("runtime_state", robot.runtime_state)
        powered = robot.robot_mode in (RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.RUNNING)
        playing = robot.runtime_state == RuntimeState.PLAYING
        out.set(
            "robot_status_bits",
            (RobotStatus.POWER_ON if powered else 0) | (RobotStatus.PROGRAM_RUNNING if playing else 0),
        )
        out.set("joint_mode", *(_JOINT_MODE.get(robot.robot_mode, 239),) * 6)

    def _tool(self, name: str, joints: Six) -> None:
        """Pose and speed of the tool; computed only when joints or TCP changed."""
        robot = self._robot
        before = self._seen.get(name)
        if before is not None and before[0] is joints and before[1] is robot.tcp:
            robot.outputs.set(f"{name}_speed", *(0.0,) * 6)
            return
        flange_from_tcp = from_pose(robot.tcp)
        robot.arm.flange_from_tcp = flange_from_tcp
        T = compose(forward(robot.table, joints), flange_from_tcp)
        robot.outputs.set(f"{name}_pose", *to_pose(T))
        self._seen[name] = (joints, robot.tcp, T)
        if before is not None and before[1] is robot.tcp:
            robot.outputs.set(
                f"{name}_speed", *_speed(before[2], T, 1 / (robot.dt_s * robot.settings.time_scale))
            )


def _speed(last: Rigid, now: Rigid, per_s: float) -> Six:
    """Velocity (6,) between two neighbouring poses: m/s, then rad/s, both in base."""
    l0, l1, l2, lx, l4, l5, l6, ly, l8, l9, l10, lz = last
    turn = compose(now, (l0, l4, l8, 0.0, l1, l5, l9, 0.0, l2, l6, l10, 0.0))
    rx, ry, rz = (turn[9] - turn[6]) / 2, (turn[2] - turn[8]) / 2, (turn[4] - turn[1]) / 2
    return tuple(per_s * v for v in (now[3] - lx, now[7] - ly, now[11] - lz, rx, ry, rz))
