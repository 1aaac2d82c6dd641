"""Lines by which a program tells an arm's pose, and what is wrong with one.

The first line of a program is a `Declaration`, every further one a `Post`. Pages: docs/integrator/any-arm.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np

from recordings.errors import ImportSourceError
from recordings.geometry import is_rigid, rotvec_from_quaternion, vector_from_pose
from recordings.importers.conventions import Convention, convention
from recordings.schema.messages import Joints, Vector6
from station.cell.config import LARGEST_REACH_M, vector6
from station.cell.errors import RobotError, StaleStateError

UNIT_TOLERANCE = 1e-3
"""Of a quaternion's length, and of a matrix's rows: of numbers written with three digits or more."""
LARGEST_S = 1e10
"""A time beyond, three hundred years, was told in another unit."""
TURNS_RAD = 4 * math.pi
"""A joint that has turned further was told in degrees."""


class Declaration(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a program says of itself and its posts, once."""

    source: Literal["live", "simulated", "playback"]
    robot: str = ""
    """Name of the arm, as configured in `robot.model`; empty: not told."""
    convention: str = ""
    """How a pose is written, by `recordings.importers.conventions`; empty: metres and x y z w, or 4×4."""
    late_s: Annotated[float, msgspec.Meta(ge=0)] = 0.01
    """How old a pose is at most when it is posted: no clock can tell this delay."""


class Post(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pose of the arm at one moment."""

    base_from_flange: tuple[float | tuple[float, ...], ...]
    t: Annotated[float, msgspec.Meta(ge=-LARGEST_S, le=LARGEST_S)] | None = None
    """The program's monotonic clock, seconds; None: the pose is of when it arrives."""
    joints_rad: Joints | None = None


_DECLARATION, _POST = msgspec.json.Decoder(Declaration), msgspec.json.Decoder(Post)


def read_declaration(line: bytes) -> tuple[Declaration, Convention | None]:
    """Read a program's first line. RobotError where it is none."""
    try:
        declared = _DECLARATION.decode(line)
        return declared, convention(declared.convention) if declared.convention else None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, ImportSourceError) as error:
        raise RobotError("post-undeclared", reason=str(error)) from None


def read_post(line: bytes, written: Convention | None) -> tuple[Post, Vector6]:
    """Read a post; return it and its pose: x y z [m], rotation vector [rad]. StaleStateError: it is wrong."""
    try:
        post = _POST.decode(line)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise StaleStateError("post-unreadable", reason=str(error)) from None
    if (largest := max(map(abs, post.joints_rad or ()), default=0.0)) > TURNS_RAD:
        raise StaleStateError("post-degrees", angle=largest)
    pose = _pose(post.base_from_flange, written)
    if (away_m := math.hypot(*pose[:3])) > LARGEST_REACH_M:
        raise StaleStateError("post-too-far", distance_m=away_m)
    return post, pose


def _pose(numbers: Sequence[float | tuple[float, ...]], written: Convention | None) -> Vector6:
    rows = [x for x in numbers if isinstance(x, tuple)]
    flat = [x for x in numbers if not isinstance(x, tuple)]
    if written is not None:
        return _converted([*flat, *(x for row in rows for x in row)], written)
    if len(flat) == 7 and not rows:
        return _by_quaternion(flat)
    if len(flat) == 16 and not rows:
        rows = [tuple(flat[start : start + 4]) for start in range(0, 16, 4)]
    elif flat or [len(row) for row in rows] != [4] * 4:
        reason = "a pose has 7 numbers, 16 row by row, or 4 rows of 4"
        raise StaleStateError("post-unreadable", reason=reason)
    matrix = np.array(rows)
    if not np.isfinite(matrix).all() or not is_rigid(matrix, UNIT_TOLERANCE):
        raise StaleStateError("post-rotation", problem="the matrix is no rotation and place, row by row")
    return vector6(vector_from_pose(matrix))


def _by_quaternion(numbers: Sequence[float]) -> Vector6:
    *place, x, y, z, w = numbers
    length = math.hypot(x, y, z, w)
    if not abs(length - 1) < UNIT_TOLERANCE or not all(map(math.isfinite, numbers)):
        raise StaleStateError("post-rotation", problem=f"the quaternion's length is {length:.3g}, not 1")
    return vector6([*place, *rotvec_from_quaternion((x, y, z, w)).tolist()])


def _converted(numbers: Sequence[float], written: Convention) -> Vector6:
    turned = numbers[:4] if written.rotation_first else numbers[3:]
    try:
        if written.rotation in ("xyzw", "wxyz"):
            _by_quaternion([0.0, 0.0, 0.0, *turned])
        matrix = written.poses(np.array([numbers]))[0]
    except (ValueError, IndexError):
        reason = f"{len(numbers)} numbers are none as {written.name}"
        raise StaleStateError("post-unreadable", reason=reason) from None
    if not np.isfinite(matrix).all():
        raise StaleStateError("post-unreadable", reason="a number is not finite")
    return vector6(vector_from_pose(matrix))
