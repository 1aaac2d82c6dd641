"""URScript's functions that only compute: numbers, strings, lists and poses.

Argument names and meanings: Universal Robots, "The URScript Programming Language".
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence

from station.simulation.controller.kinematics import (
    Rigid,
    Vector,
    between,
    compose,
    from_pose,
    from_rotvec,
    invert,
    place,
    plus,
    to_pose,
)
from station.simulation.controller.urscript import Pose, ScriptRuntimeError, Value
from station.simulation.controller.urscript_parser import Builtin


def six(values: Sequence[float]) -> Vector:
    """Raises ScriptRuntimeError unless these are six finite numbers."""
    if not isinstance(values, list) or len(values) != 6 or not all(map(math.isfinite, values)):
        raise ScriptRuntimeError(f"{values!r} is not six numbers")
    return tuple(map(float, values))


def rigid(pose: Sequence[float]) -> Rigid:
    return from_pose(six(pose))


def pose_of(T: Rigid) -> Pose:
    return Pose(to_pose(T))


def _pose_add(p_1: Pose, p_2: Pose) -> Pose:
    """Positions are added in base, rotations multiplied."""
    return _combined(p_1, p_2, 1.0)


def _pose_sub(p_to: Pose, p_from: Pose) -> Pose:
    return _combined(p_to, p_from, -1.0)


def _combined(a: Pose, b: Pose, sign: float) -> Pose:
    first, second = rigid(a), rigid(b)
    turn = compose(first, second if sign > 0 else invert(second))
    shift = plus(place(first), place(second), sign)
    return Pose([*shift, *to_pose(turn)[3:]])


def _interpolated(p_from: Pose, p_to: Pose, alpha: float) -> Pose:
    first, last = rigid(p_from), rigid(p_to)
    turn = to_pose(compose(invert(first), last))[3:]
    rotation = to_pose(compose(first, from_rotvec(*(alpha * r for r in turn))))[3:]
    shift = between(place(first), place(last), alpha)
    return Pose([*shift, *rotation])


def _from_rpy(rpy: Sequence[float]) -> list[float]:
    """Roll about X, pitch about Y, yaw about Z, all fixed → rotation vector."""
    roll, pitch, yaw = rpy
    turned = compose(compose(from_rotvec(0, 0, yaw), from_rotvec(0, pitch, 0)), from_rotvec(roll, 0, 0))
    return list(to_pose(turned)[3:])


def _to_rpy(vector: Sequence[float]) -> list[float]:
    r = from_rotvec(*map(float, vector))
    pitch = math.atan2(-r[8], math.hypot(r[0], r[4]))
    return [math.atan2(r[9], r[10]), pitch, math.atan2(r[4], r[0])]


def _to_number(text: Value) -> float:
    number = float(text)
    return int(number) if number.is_integer() and "." not in str(text) else number


def text_of(value: Value) -> str:
    """Write a value as `textmsg` and `to_str` do."""
    if isinstance(value, list):
        return ("p" if isinstance(value, Pose) else "") + "[" + ", ".join(map(text_of, value)) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _distance(a: Sequence[float], b: Sequence[float]) -> float:
    return math.dist(list(a)[:3], list(b)[:3])


PURE: dict[str, Builtin] = {
    "norm": lambda a: math.hypot(*a) if isinstance(a, list) else abs(a),
    "sqrt": lambda f: math.sqrt(f),
    "sin": lambda f: math.sin(f),
    "cos": lambda f: math.cos(f),
    "tan": lambda f: math.tan(f),
    "asin": lambda f: math.asin(f),
    "acos": lambda f: math.acos(f),
    "atan": lambda f: math.atan(f),
    "atan2": lambda x, y: math.atan2(x, y),
    "pow": lambda base, exponent: math.pow(base, exponent),
    "log": lambda b, f: math.log(f, b),
    "floor": lambda f: math.floor(f),
    "ceil": lambda f: math.ceil(f),
    "random": lambda: random.random(),
    "d2r": lambda d: math.radians(d),
    "r2d": lambda r: math.degrees(r),
    "length": lambda v: len(v),
    "get_list_length": lambda v: len(v),
    "size": lambda v: len(v),
    "binary_list_to_integer": lambda l: sum(bool(bit) << i for i, bit in enumerate(l)),  # noqa: E741
    "integer_to_binary_list": lambda x: [bool(x >> i & 1) for i in range(32)],
    "to_num": _to_number,
    "to_str": text_of,
    "str_cat": lambda op1, op2: text_of(op1) + text_of(op2),
    "str_len": lambda str: len(str),
    "str_empty": lambda str: not str,
    "str_at": lambda src, index: src[index],
    "str_sub": lambda src, index, len=-1: src[index:] if len < 0 else src[index : index + len],
    "str_find": lambda src, target, start_from=0: src.find(target, start_from),
    "pose_trans": lambda p_from, p_from_to: pose_of(compose(rigid(p_from), rigid(p_from_to))),
    "pose_inv": lambda p_from: pose_of(invert(rigid(p_from))),
    "pose_add": _pose_add,
    "pose_sub": _pose_sub,
    "pose_dist": _distance,
    "point_dist": _distance,
    "interpolate_pose": _interpolated,
    "rpy2rotvec": _from_rpy,
    "rotvec2rpy": _to_rpy,
}
