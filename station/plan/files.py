"""Plans as files: strict `plan.yaml`, and the taught poses of a recording."""

from __future__ import annotations

import errno
import math
from pathlib import Path

import msgspec
import numpy as np
import yaml

from calibrate.kinematics import MODELS
from recordings import strict_yaml
from recordings.files import ASKED_FOR, read_file, write_atomically
from recordings.reader import open_recording
from recordings.schema.messages import Mount
from station.cell.config import SLOWEST_RAD_S, SLOWEST_RAD_S2
from station.cell.errors import ConfigError
from station.cell.layout import pose_at
from station.cell.pose_plan import Plan

_POSE_LIMIT = 200


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
        raise ConfigError("plan-not-written", path=path, reason=error.strerror) from error


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
    listed = "".join(f"\n  {problem}" for problem in problems)
    return ConfigError("invalid-plan", path=name, problems=len(problems), listed=listed)


def _read(path: Path) -> bytes:
    try:
        return read_file(path, strict_yaml.LIMIT_BYTES)
    except OSError as error:
        code = "plan-too-large" if error.errno == errno.EFBIG else "unreadable-plan"
        raise ConfigError(code, path=path, reason=error.strerror) from None


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
            "other-cell",
            path=path,
            recorded=f"{of.robot.model or 'nameless arm'}, {of.mount}",
            configured=f"{robot}, {mount}",
        )
    views = recording.views()
    taught = [(view.name, view.joints_rad) for view in views if view.joints_rad is not None]
    if not taught or len(taught) < len(views):
        raise ConfigError("no-joints", path=path, poses=len(views), with_joints=len(taught))
    poses = tuple(pose_at(MODELS[robot], name, joints, "as taught") for name, joints in taught)
    plan = Plan(robot=robot, mount=mount, poses=poses, note=f"taught: the poses of {path.name}")
    return _checked(plan, str(path))
