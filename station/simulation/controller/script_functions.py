"""URScript's functions beside motion: what only computes, registers, outputs, and the robot's state.

Argument names and meanings: Universal Robots, "The URScript Programming Language".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

from station.simulation.controller.kinematics import (
    Rigid,
    Vector,
    compose,
    forward,
    from_pose,
    invert,
    plus,
    position,
    to_pose,
)
from station.simulation.controller.state import DIGITAL_BANKS, ControllerState
from station.simulation.controller.urscript import Builtin, List, Pose, ScriptRuntimeError, Steps, Value

STEADY_RAD_S = 1e-3
_WITHOUT_EFFECT = (
    "enable_external_ft_sensor", "end_force_mode", "force_mode", "force_mode_set_damping",
    "force_mode_set_gain_scaling", "ft_rtde_input_enable", "popup", "set_analog_inputrange",
    "set_analog_out", "set_analog_outputdomain", "set_gravity", "set_input_actions_to_default",
    "set_runstate_outputs", "set_safety_mode_transition_hardness", "set_standard_analog_input_domain",
    "set_tool_analog_input_domain", "set_tool_communication", "set_tool_digital_output_mode",
    "set_tool_output_mode", "set_tool_voltage", "zero_ftsensor",
)  # fmt: skip
"""Of `ur_rtde`'s script and of what a program that PolyScope exported sets first."""


# -- what only computes ---------------------------------------------------------------------------------


def six(values: Sequence[float]) -> Vector:
    """Raises ScriptRuntimeError unless these are six finite numbers."""
    if not isinstance(values, list) or len(values) != 6 or not all(map(math.isfinite, values)):
        raise ScriptRuntimeError(f"{values!r} is not six numbers")
    return tuple(map(float, values))


def rigid(pose: Sequence[float]) -> Rigid:
    return from_pose(six(pose))


def pose_of(T: Rigid) -> Pose:
    return Pose(to_pose(T))


def _pose_add(p_1: Pose, p_2: Pose, sign: float = 1.0) -> Pose:
    """Positions are added in base, rotations multiplied."""
    first, second = rigid(p_1), rigid(p_2)
    turn = compose(first, second if sign > 0 else invert(second))
    return Pose([*plus(position(first), position(second), sign), *to_pose(turn)[3:]])


def text_of(value: Value) -> str:
    """Write a value as `textmsg` does."""
    if isinstance(value, list):
        return ("p" if isinstance(value, Pose) else "") + "[" + ", ".join(map(text_of, value)) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)


_MATHEMATICS = ("sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "pow", "floor", "ceil")
PURE: dict[str, Builtin] = {name: getattr(math, name) for name in _MATHEMATICS} | {
    "norm": lambda a: math.hypot(*a) if isinstance(a, list) else abs(a),
    "d2r": math.radians,
    "r2d": math.degrees,
    "length": len,
    "pose_trans": lambda p_from, p_from_to: pose_of(compose(rigid(p_from), rigid(p_from_to))),
    "pose_inv": lambda p_from: pose_of(invert(rigid(p_from))),
    "pose_add": _pose_add,
    "pose_sub": partial(_pose_add, sign=-1.0),
    "pose_dist": lambda p_from, p_to: math.dist(position(rigid(p_from)), position(rigid(p_to))),
}


# -- registers and outputs ------------------------------------------------------------------------------


def _registers(robot: ControllerState) -> dict[str, Builtin]:
    def name(side: str, kind: str, address: int) -> str:
        found = f"{side}_{kind}_register_{address}"
        if found not in robot.outputs.types:
            raise ScriptRuntimeError(f"there is no {found}")
        return found

    def write_integer(address: int, value: int) -> None:
        if type(value) is not int or not -(2**31) <= value < 2**31:
            raise ScriptRuntimeError(f"{value!r} is no integer of 32 bits")
        robot.outputs.set(name("output", "int", address), value)

    def write_float(address: int, value: float) -> None:
        robot.outputs.set(name("output", "double", address), float(value))

    return {
        "read_input_integer_register": lambda address: int(robot.inputs.get(name("input", "int", address))),
        "read_input_float_register": lambda address: robot.inputs.get(name("input", "double", address)),
        "write_output_integer_register": write_integer,
        "write_output_float_register": write_float,
    }


def _digital(robot: ControllerState) -> dict[str, Builtin]:
    def write(bank: str, n: int, b: bool) -> None:
        first, count = DIGITAL_BANKS[bank]
        if not 0 <= n < count:
            raise ScriptRuntimeError(f"there is no {bank} digital output {n}")
        robot.set_digital_outputs(1 << first + n, bool(b) << first + n)

    banks = {"set_digital_out": "standard"} | {f"set_{bank}_digital_out": bank for bank in DIGITAL_BANKS}
    return {name: partial(write, bank) for name, bank in banks.items()}


# -- the robot's state ----------------------------------------------------------------------------------


def _states(robot: ControllerState) -> dict[str, Builtin]:
    arm, out = robot.arm, robot.outputs

    def vector(name: str, kind: type[list[float]] = List) -> Callable[..., list[float]]:
        return lambda *_, **__: kind(out.vector(name))

    def freedrive(on: bool) -> Builtin:
        return lambda *_, **__: setattr(robot, "freedrive", on)

    def sleep(t: float) -> Steps:
        for _ in range(robot.cycles(t)):
            yield

    def textmsg(s1: object, s2: object = "") -> None:
        text = text_of(s1) + text_of(s2)
        robot.journal.note("controller", "textmsg", text=text)
        robot.tell("text", text=text)

    def set_tcp(pose: Pose, tcp_name: str = "") -> None:
        robot.tcp = six(pose)

    def set_payload(
        m: float, cog: Sequence[float] = (), inertia: Sequence[float] = (), transition_time: float = 0
    ) -> None:
        robot.payload_kg = float(m)
        robot.payload_cog = tuple(map(float, cog)) or robot.payload_cog
        if inertia:
            out.set("payload_inertia", *map(float, inertia))

    def set_watchdog(variable_name: str, min_frequency: float = 10.0, action: str = "pause") -> None:
        if variable_name not in robot.inputs.types or not 0 < min_frequency < math.inf:
            raise ScriptRuntimeError(f"no watchdog on {variable_name} at {min_frequency} Hz")
        action = action.lower()  # Universal Robots' own example writes it in capitals
        if action not in ("ignore", "pause", "stop"):
            raise ScriptRuntimeError(f"a watchdog's action is no {action}")
        robot.watchdog_s = 0.0 if action == "ignore" else 1.0 / min_frequency
        robot.watched, robot.watchdog_pauses = variable_name, action == "pause"

    return {
        **dict.fromkeys(_WITHOUT_EFFECT, lambda *_, **__: None),
        "sync": lambda: sleep(0.0),
        "sleep": sleep,
        "get_steptime": lambda: robot.dt_s,
        "is_steady": lambda: not arm.moving and max(map(abs, arm.actual_speed)) < STEADY_RAD_S,
        "get_actual_joint_positions": vector("actual_q"),
        "get_actual_joint_positions_history": vector("actual_q"),
        "get_target_joint_positions": vector("target_q"),
        "get_actual_joint_speeds": vector("actual_qd"),
        "get_target_joint_speeds": vector("target_qd"),
        "get_joint_torques": vector("target_moment"),
        "get_actual_tcp_pose": vector("actual_TCP_pose", Pose),
        "get_target_tcp_pose": vector("target_TCP_pose", Pose),
        "get_target_waypoint": vector("target_TCP_pose", Pose),
        "get_actual_tcp_speed": vector("actual_TCP_speed", Pose),
        "get_target_tcp_speed": vector("target_TCP_speed", Pose),
        "get_actual_tool_flange_pose": lambda: pose_of(forward(robot.table, arm.actual)),
        "get_tcp_offset": lambda: Pose(robot.tcp),
        "set_tcp": set_tcp,
        "get_target_payload": lambda: robot.payload_kg,
        "get_target_payload_cog": lambda: List(robot.payload_cog),
        "get_target_payload_inertia": vector("payload_inertia"),
        "set_payload": set_payload,
        "set_target_payload": set_payload,
        "freedrive_mode": freedrive(True),
        "end_freedrive_mode": freedrive(False),
        "get_freedrive_status": lambda: 0,
        "teach_mode": freedrive(True),
        "end_teach_mode": freedrive(False),
        "tool_contact": lambda direction=None: 0,
        "protective_stop": lambda: robot.protective_stop("the script asked for it"),
        "rtde_set_watchdog": set_watchdog,
        "textmsg": textmsg,
    }


def functions(robot: ControllerState) -> dict[str, Builtin]:
    return {**PURE, **_registers(robot), **_digital(robot), **_states(robot)}
