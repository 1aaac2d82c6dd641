"""Plans as files: strict `plan.yaml`, lists of joints or poses from elsewhere, and taught poses."""

from __future__ import annotations

import csv
import errno
import math
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import yaml

from calibrate.geometry import Array, pose_from_quaternion
from calibrate.kinematics import MODELS, inverse_nearest
from recordings import strict_yaml
from recordings.files import ASKED_FOR, read_file, write_atomically
from recordings.reader import open_recording
from recordings.schema.messages import Mount
from station.cell.config import SLOWEST_RAD_S, SLOWEST_RAD_S2
from station.cell.errors import ConfigError
from station.cell.plan import Plan, PlannedPose
from station.cell.scene import pose_at

_POSE_LIMIT = 200
_JOINTS_DEG = [f"j{i}_deg" for i in range(1, 7)]
_JOINTS_RAD = [f"j{i}_rad" for i in range(1, 7)]
_POSE = ["x", "y", "z", "qx", "qy", "qz", "qw"]


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]  # yaml has no types
    """YAML writer without anchors, which the strict reader does not accept."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def save_plan(plan: Plan, path: Path) -> None:
    """Write a plan file atomically. ConfigError with the remedy when it cannot be written."""
    text = yaml.dump(
        msgspec.to_builtins(plan),
        Dumper=_Dumper,
        sort_keys=False,
        default_flow_style=None,
        width=110,
        allow_unicode=True,
    )
    try:
        write_atomically(path, text.encode(), ASKED_FOR)
    except OSError as error:
        text = f"cannot write the plan to {path}: {error.strerror}"
        raise ConfigError(text, code="plan-not-written", remedy="Choose another folder.") from error


def load_plan(path: Path) -> Plan:
    """Read and check a plan file. ConfigError lists all problems with their lines."""
    return parse_plan(_read(path), str(path))


def parse_plan(content: bytes, name: str = "plan") -> Plan:
    """Parse and check the content of a plan file, such as an attachment of a recording."""
    try:
        plan = strict_yaml.load(content, Plan)
    except strict_yaml.StrictYamlError as error:
        raise _report(name, [str(problem) for problem in error.problems]) from None
    return _checked(plan, name)


def _checked(plan: Plan, name: str) -> Plan:
    if problems := _value_problems(plan):
        raise _report(name, problems)
    return plan


def _report(name: str, problems: list[str]) -> ConfigError:
    count = f"{len(problems)} problem{'s' if len(problems) > 1 else ''}"
    text = "\n".join([f"{name}: {count}", *(f"  {problem}" for problem in problems)])
    return ConfigError(text, code="invalid-plan", problems=len(problems))


def _bad_list(text: str, remedy: str = "") -> ConfigError:
    return ConfigError(text, code="invalid-list", remedy=remedy)


def _read(path: Path) -> bytes:
    try:
        return read_file(path, strict_yaml.LIMIT_BYTES)
    except OSError as error:
        code = "plan-too-large" if error.errno == errno.EFBIG else "unreadable-plan"
        text = f"cannot read {path}: {error.strerror}"
        raise ConfigError(text, code=code, remedy="Check the name.") from None


def _value_problems(plan: Plan) -> list[str]:
    """Find wrong values and contradictions that types cannot express."""
    problems = []
    if plan.motion != "stops":
        problems.append("motion: sweeps are gone. Make a plan of poses: `station plan`")
    if plan.robot not in MODELS:
        problems.append(f"robot '{plan.robot}' is unknown; known are {', '.join(MODELS)}")
    if not 1 <= len(plan.poses) <= _POSE_LIMIT:
        problems.append(f"{len(plan.poses)} poses; 1 to {_POSE_LIMIT} are possible")
    for limit, least in (
        ("joint_speed_rad_s", SLOWEST_RAD_S),
        ("joint_acceleration_rad_s2", SLOWEST_RAD_S2),
    ):
        value = getattr(plan, limit)
        if not (math.isfinite(value) and value >= least):
            problems.append(f"{limit} is {value}; it must be a number of at least {least:g}")
    names = [pose.name for pose in plan.poses]
    for number, pose in enumerate(plan.poses):
        where = f"poses[{number}] ({pose.name})"
        if names.index(pose.name) != number:
            problems.append(f"{where}: the name is used twice")
        if not np.isfinite(pose.joints_rad).all():
            problems.append(f"{where}: joints_rad has a value that is not a number")
        elif np.abs(pose.joints_rad).max() > 2 * np.pi + 1e-9:
            problems.append(f"{where}: a joint is beyond ±360°; joints are in radians, not degrees")
        matrix = pose.base_from_flange
        if matrix is not None and np.shape(np.array(matrix, dtype=object)) != (4, 4):
            problems.append(f"{where}: base_from_flange must have 4 rows of 4 numbers")
    return problems


def taught_plan(path: Path, robot: str, mount: Mount) -> Plan:
    """Make a plan of the poses at which a recording's images were taken, in their order.

    ConfigError for another arm or mounting, or without joints; RecordingError for an unfinished recording.
    """
    recording = open_recording(path)
    of = recording.info
    if (of.robot.model, of.mount) != (robot, mount):
        raise ConfigError(
            f"{path} is of a {of.robot.model or 'nameless arm'}, {of.mount}; this cell has a {robot}, "
            f"{mount}: its poses are no plan for it",
            code="other-cell",
        )
    views = recording.views()
    taught = [(view.name, view.joints_rad) for view in views if view.joints_rad is not None]
    if not taught or len(taught) < len(views):
        raise ConfigError(
            f"{path} holds {len(views)} poses, {len(taught)} of them with the arm's joints",
            code="no-joints",
            remedy="Name a recording whose poses all have joints.",
        )
    poses = tuple(pose_at(MODELS[robot], name, joints, "as taught") for name, joints in taught)
    plan = Plan(robot=robot, mount=mount, poses=poses, note=f"taught: the poses of {path.name}")
    return _checked(plan, str(path))


def import_list(path: Path, robot: str, mount: Mount, near_joints_rad: Sequence[float] | None = None) -> Plan:
    """Make a plan from CSV: header `[name,]j1_deg…j6_deg`, `[name,]j1_rad…` or `[name,]x,y,z,qx,qy,qz,qw`.

    Poses are base_from_flange in metres; each takes the arm branch nearest to the one before (the first:
    nearest to `near_joints_rad`, which is needed then). ConfigError names file, row and remedy.
    """
    try:
        rows = list(csv.reader(_read(path).decode("utf-8-sig").splitlines()))
    except UnicodeDecodeError:
        raise _bad_list(f"{path} is not a text file", "Save the list as CSV.") from None
    if not rows:
        raise _bad_list(
            f"{path} is empty", f"Name the columns in its first row, e.g. {','.join(_JOINTS_DEG)}."
        )
    header = [column.strip() for column in rows[0]]
    named, columns = header[:1] == ["name"], header[1:] if header[:1] == ["name"] else header
    if columns not in (_JOINTS_DEG, _JOINTS_RAD, _POSE):
        raise _bad_list(
            f"{path}, row 1: the columns are {','.join(header)!r}",
            f"Name them {','.join(_JOINTS_DEG)} or {','.join(_JOINTS_RAD)} or {','.join(_POSE)}, with commas "
            "between them and `name` first if you like.",
        )
    if columns == _POSE and near_joints_rad is None:
        raise ConfigError(
            f"{path} lists flange poses, which several arm branches reach",
            code="start-needed",
            remedy="Give --start with the arm's joints.",
        )
    poses: list[PlannedPose] = []
    near = np.asarray(near_joints_rad if near_joints_rad is not None else np.zeros(6), dtype=float)
    for number, row in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in row):
            continue
        name = row[0].strip() if named else f"p{len(poses) + 1:02d}"
        values = _numbers(row[1:] if named else row, len(columns), f"{path}, row {number}")
        near = _row_joints(values, columns, robot, near, f"{path}, row {number}")
        poses.append(pose_at(MODELS[robot], name, near, f"from {path.name}"))
    plan = Plan(robot=robot, mount=mount, poses=tuple(poses), note=f"imported from {path.name}")
    return _checked(plan, str(path))


def _numbers(cells: list[str], wanted: int, where: str) -> list[float]:
    if len(cells) != wanted:
        raise _bad_list(f"{where}: {len(cells)} numbers, wanted are {wanted}")
    try:
        values = [float(cell) for cell in cells]
    except ValueError as error:
        raise _bad_list(f"{where}: {error}", "Write numbers with a point, 0.25.") from error
    if not np.isfinite(values).all():
        raise _bad_list(f"{where}: a value is not a finite number")
    return values


def _row_joints(values: list[float], columns: list[str], robot: str, near: Array, where: str) -> Array:
    if columns == _JOINTS_DEG:
        return np.deg2rad(values)
    if columns == _JOINTS_RAD:
        return np.array(values)
    if np.linalg.norm(values[3:]) < 1e-6:
        raise _bad_list(f"{where}: the quaternion is zero", "Write no rotation as 0,0,0,1.")
    joints = inverse_nearest(MODELS[robot], pose_from_quaternion(values[:3], values[3:]), near)
    if joints is None:
        raise _bad_list(f"{where}: the {robot} cannot reach this flange pose", "Write lengths in metres.")
    return joints
