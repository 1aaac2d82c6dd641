"""How other programs and pendants write a pose in numbers, and what the numbers alone say about it.

One table for imports, posted arms and exports. A name spells out what it means, `euler-ZYX-deg-mm`, or is one
of `NAMED`.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np

from recordings.errors import ImportSourceError
from recordings.geometry import Array, inverse, quaternion_from_matrix, rotation_log
from recordings.schema.messages import CameraAxes

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

OPTICAL_FROM_AXES: dict[CameraAxes, list[list[int]]] = {
    "optical": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "opengl": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "ros": [[0, -1, 0], [0, 0, -1], [1, 0, 0]],
}
"""Rotations (3, 3) into the optical frame."""
UNITS = {"mm": 1e-3, "cm": 1e-2, "inch": 0.0254}
"""Ends of a convention's name, and metres; without one it is metres."""

_REACH_LIMIT_M = 5.0
"""A larger median distance from the base is no arm's in metres."""
_REACH_LEAST_M = 0.01
"""A smaller one is no arm's in the unit that makes it so."""
_SMALL_REACH_M = 0.15
"""An arm that reaches no further is so small that its millimetres may be centimetres or inches."""
_UNIT_TOLERANCE = 0.01
_TURN = 2 * math.pi + 0.01
"""Larger numbers are no angles in radians."""
_LOCKED = 1e-14
"""Nearer to gimbal lock, the split of the outer two angles is rounding and nothing else."""


@dataclass(frozen=True)
class Convention:
    """How the numbers of one pose are to be read."""

    rotation: str
    """matrix (rows of 4), xyzw, wxyz, rotvec, or a sequence of axes as scipy has it: `ZYX` about the moved
    axes, `xyz` about fixed ones, the angles in that order."""
    unit_m: float = 1.0
    degrees: bool = False
    inverse: bool = False
    """The base in the tool is told, not the tool in the base."""
    rotation_first: bool = False

    @property
    def name(self) -> str:
        euler = self.rotation if self.rotation in _FORMS else f"euler-{self.rotation}"
        signs = {
            "deg": self.degrees,
            **{name: self.unit_m == unit_m for name, unit_m in UNITS.items()},
            "first": self.rotation_first,
            "inverse": self.inverse,
        }
        return "-".join([euler, *(sign for sign, holds in signs.items() if holds)])

    @property
    def about(self) -> str:
        """Say for people what the numbers of one pose are, in their order and with their units."""
        unit = next((unit for unit, unit_m in UNITS.items() if unit_m == self.unit_m), "m")
        at = f"x y z in {unit}"
        angle = "°" if self.degrees else "rad"
        forms = {
            "matrix": f"matrix row by row, its translation in {unit}",
            "xyzw": "quaternion x y z w",
            "wxyz": "quaternion w x y z",
            "rotvec": f"rotation vector in {angle}",
        }
        axes = " ".join(self.rotation)
        about = f"about the {'fixed' if self.rotation.islower() else 'moved'} axes {axes}"
        turn = forms.get(self.rotation, f"angles in {angle} {about}")
        parts = [turn, at] if self.rotation_first else [at, turn]
        told = turn if self.rotation == "matrix" else ", ".join(parts)
        return f"{told}, of the inverse" if self.inverse else told

    def poses(self, numbers: Array) -> Array:
        """Rigid transforms (n, 4, 4), metres, of (n, 12 or 16) for a matrix, (n, 7) or (n, 6)."""
        # Loaded where numbers are read: programs that only write them do without.
        from scipy.spatial.transform import Rotation

        n = len(numbers)
        T = np.broadcast_to(np.eye(4), (n, 4, 4)).copy()
        if self.rotation == "matrix":
            T[:, :3] = numbers[:, :12].reshape(n, 3, 4)
            T[:, :3, :3] = Rotation.from_matrix(T[:, :3, :3]).as_matrix()  # of few digits
        else:
            turn, at = numbers[:, 3:], numbers[:, :3]
            if self.rotation_first:
                turn, at = numbers[:, :-3], numbers[:, -3:]
            T[:, :3, :3], T[:, :3, 3] = self._rotation(turn).as_matrix(), at
        T[:, :3, 3] *= self.unit_m
        return np.asarray(np.linalg.inv(T) if self.inverse else T)

    def numbers(self, poses: Array) -> Array:
        """Write rigid transforms (n, 4, 4), metres, as numbers that `poses` reads: (n, 16), (n, 7) or (n, 6).

        Quaternions have w ≥ 0, rotation vectors a length of at most π. Of angles the middle one is in a half
        turn, the others in [-π, π]; at gimbal lock, where only the sum or the difference of the outer two is
        known, the angle about the axis that is turned about first is 0.
        """
        T = inverse(poses) if self.inverse else np.array(poses, dtype=float)
        T[:, :3, 3] /= self.unit_m
        if self.rotation == "matrix":
            return np.asarray(T.reshape(-1, 16))
        turn, at = self._turn(T[:, :3, :3]), T[:, :3, 3]
        return np.hstack([turn, at] if self.rotation_first else [at, turn])

    def _turn(self, R: Array) -> Array:
        """Write rotations (n, 3, 3) as (n, 4) or (n, 3)."""
        if self.rotation == "xyzw":
            return quaternion_from_matrix(R)
        if self.rotation == "wxyz":
            return np.roll(quaternion_from_matrix(R), 1, axis=1)
        turn = rotation_log(R) if self.rotation == "rotvec" else euler_angles(self.rotation, R)
        return np.asarray(np.degrees(turn) if self.degrees else turn)

    def _rotation(self, turn: Array) -> Rotation:
        from scipy.spatial.transform import Rotation

        if self.rotation in ("xyzw", "wxyz"):
            return Rotation.from_quat(turn if self.rotation == "xyzw" else np.roll(turn, -1, axis=1))
        if self.rotation == "rotvec":
            return Rotation.from_rotvec(turn, degrees=self.degrees)
        return Rotation.from_euler(self.rotation, turn, degrees=self.degrees)


def euler_angles(sequence: str, R: Array) -> Array:
    """Convert rotations (n, 3, 3) to angles (n, 3), radians, of a sequence as in `Convention.rotation`.

    By the quaternion (Bernardes and Viollet 2022): half the sum and half the difference of the outer angles
    are each known where their own pair of components is. The angles together are accurate everywhere, also
    near gimbal lock, where SciPy's lose half the digits.
    """
    fixed = sequence.lower() if sequence.islower() else sequence[::-1].lower()
    i, j, k = ("xyz".index(axis) for axis in fixed)
    is_proper = i == k
    if is_proper:
        k = 3 - i - j
    sign = (i - j) * (j - k) * (k - i) // 2
    q = quaternion_from_matrix(R)
    x, y, z, w = q[:, i], q[:, j], sign * q[:, k], q[:, 3]
    if is_proper:
        near, far = np.array([w, x]), np.array([y, z])
    else:
        near, far = np.array([w - y, x + z]), np.array([y + w, z - x])
    middle = 2 * np.arctan2(np.hypot(*far), np.hypot(*near))
    half_sum = np.arctan2(near[1], near[0])
    half_difference = np.arctan2(far[1], far[0])
    half_sum = np.where(np.hypot(*near) < _LOCKED, half_difference, half_sum)
    half_difference = np.where(np.hypot(*far) < _LOCKED, half_sum, half_difference)
    first = half_sum - half_difference
    last = half_sum + half_difference
    if not is_proper:
        middle = middle - math.pi / 2
        last = sign * last
    turned = np.stack([_wrapped(first), middle, _wrapped(last)], axis=1)
    return np.asarray(turned if sequence.islower() else turned[:, ::-1])


def _wrapped(angle: Array) -> Array:
    """Bring angles into [-π, π]."""
    return np.asarray(angle - 2 * math.pi * np.round(angle / (2 * math.pi)))


_MM = UNITS["mm"]
_FORMS = ("matrix", "xyzw", "wxyz", "rotvec")
_SEQUENCES = [
    turned
    for order in [*permutations("XYZ"), *("".join(p) + p[0] for p in permutations("XYZ", 2))]
    for turned in ("".join(order), "".join(order).lower())
]
"""Every order of angles, about moved axes and about fixed ones."""
NAMED = {
    "zivid": Convention("matrix", _MM),
    "kuka-abc": Convention("ZYX", _MM, True),
    "fanuc-xyzwpr": Convention("xyz", _MM, True),
    "abb-quaternion": Convention("wxyz", _MM),
    "ur-rotvec": Convention("rotvec"),
    "ur-pendant": Convention("rotvec", _MM),
    "xarm-rpy": Convention("xyz", _MM, True),
    "easy-handeye": Convention("xyzw"),
    "moveit": Convention("matrix"),
    "halcon-gba": Convention("XYZ", degrees=True),
    "halcon-abg": Convention("xyz", degrees=True),
}


def convention(name: str) -> Convention:
    """The convention of a name. Raises ImportSourceError that lists the names."""
    if name in NAMED:
        return NAMED[name]
    told = re.fullmatch(r"(?:euler-)?(\w+)((?:-(?:deg|rad|mm|cm|inch|m|first|inverse))*)", name)
    if not told or told[1] not in (*_FORMS, *_SEQUENCES):
        raise ImportSourceError("no-convention", name=name, names=", ".join(NAMED))
    signs = told[2].split("-")
    unit_m = next((unit_m for unit, unit_m in UNITS.items() if unit in signs), 1.0)
    return Convention(told[1], unit_m, *(sign in signs for sign in ("deg", "inverse", "first")))


def tells_direction(name: str | None) -> bool:
    """Tell whether a convention so named says which way round a pose is: a maker's is the tool in the base, a
    spelt one is known only with -inverse."""
    return name in NAMED or (name or "").endswith("-inverse")


def possible(numbers: Array) -> list[tuple[Convention, str]]:
    """Conventions that numbers (n, k) allow by themselves, each with its evidence; the usual ones first."""
    n, k = numbers.shape
    if k in (12, 16):
        R = numbers[:, :12].reshape(n, 3, 4)[:, :, :3]
        miss = float(np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max())
        right = miss < 0.02 and bool((np.linalg.det(R) > 0).all())
        found = [(Convention("matrix"), f"rows at right angles within {miss:.1g}")] if right else []
        return _in_units(found, numbers[:, 3:12:4])
    ways = _in_units(_rotations(numbers[:, 3:]), numbers[:, :3])
    if k == 7 or (np.abs(numbers[:, -3:]).max() > _TURN and np.abs(numbers[:, :3]).max() < 360.5):
        behind = _in_units(_rotations(numbers[:, :-3]), numbers[:, -3:])
        ways += [(replace(how, rotation_first=True), told) for how, told in behind]
    return ways


def _rotations(turn: Array) -> list[tuple[Convention, str]]:
    if turn.shape[1] == 4:
        miss = float(np.abs(np.linalg.norm(turn, axis=1) - 1).max())
        near = f"quaternions of length 1 within {miss:.1g}"
        return [(Convention(form), near) for form in ("xyzw", "wxyz") if miss < _UNIT_TOLERANCE]
    largest = float(np.abs(turn).max())
    forms = ("rotvec", "xyz", "ZYX", *(s for s in _SEQUENCES if s not in ("xyz", "ZYX")))
    unit = largest > _TURN  # in degrees an arm that turns so little shows nothing
    evidence = f"angles to {largest:.4g} {'°' if unit else 'rad'}"
    return [(Convention(form, degrees=unit), evidence) for form in forms]


def _in_units(found: list[tuple[Convention, str]], at: Array) -> list[tuple[Convention, str]]:
    reaches = np.linalg.norm(at, axis=1)
    reach, most = float(np.median(reaches)), float(reaches.max())
    if reach <= _REACH_LIMIT_M:
        units = {"m": 1.0}
    elif most * UNITS["mm"] > _SMALL_REACH_M:
        units = {"mm": UNITS["mm"]}
    else:
        units = UNITS
    return [
        (replace(each, unit_m=unit_m), f"{evidence}, reach {reach:.4g} {unit}")
        for unit, unit_m in units.items()
        if reach * unit_m >= _REACH_LEAST_M
        for each, evidence in found
    ]
