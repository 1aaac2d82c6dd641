"""Plans as files: strict `plan.yaml`."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import yaml

from recordings import strict_yaml
from recordings.files import ASKED_FOR, read_file, write_atomically
from station.cell.errors import ConfigError
from station.cell.pose_plan import Plan

_POSE_LIMIT = 200


def save_plan(plan: Plan, path: Path) -> None:
    """Write a plan file atomically. ConfigError with the remedy when it cannot be written."""
    text = yaml.safe_dump(
        msgspec.to_builtins(plan),  # lists of their own, so that no anchors are written
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
    try:
        plan = strict_yaml.load(read_file(path, strict_yaml.LIMIT_BYTES), Plan)
        problems = _value_problems(plan)
    except OSError as error:
        raise ConfigError("unreadable-plan", path=path, reason=error.strerror) from None
    except strict_yaml.StrictYamlError as error:
        problems = [str(problem) for problem in error.problems]
    if problems:
        listed = "".join(f"\n  {problem}" for problem in problems)
        raise ConfigError("invalid-plan", path=path, problems=len(problems), listed=listed)
    return plan


def _value_problems(plan: Plan) -> list[str]:
    """Find what types cannot express, and the check of its motion (`check_plan`) does not find."""
    problems = []
    if not 1 <= len(plan.poses) <= _POSE_LIMIT:
        problems.append(f"{len(plan.poses)} poses; 1 to {_POSE_LIMIT} are possible")
    names = [pose.name for pose in plan.poses]
    for number, pose in enumerate(plan.poses):
        where = f"poses[{number}] ({pose.name})"
        if names.index(pose.name) != number:
            problems.append(f"{where}: the name is used twice")
        if not np.abs(pose.joints_rad).max(initial=0.0) <= 2 * np.pi + 1e-9:
            problems.append(f"{where}: a joint is beyond ±360°; joints are in radians, not degrees")
        matrix = pose.base_from_flange
        if matrix is not None and np.shape(np.array(matrix, dtype=object)) != (4, 4):
            problems.append(f"{where}: base_from_flange must have 4 rows of 4 numbers")
    return problems
