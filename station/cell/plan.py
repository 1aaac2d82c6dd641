"""A plan is data: joint targets, what they are expected to show, and why each is there."""

from __future__ import annotations

import hashlib
from typing import Literal

import msgspec

from recordings.schema.messages import Matrix4, Mount, Vector6

Criterion = Literal["A", "D", "arm", "all"]
"""Smallest error of X; smallest ellipsoid of X; smallest error over the workspace with the arm's table;
smallest ellipsoid of X, board, lens and table together."""


class ExpectedView(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Expected look of the board from here, by the guess the plan was made with."""

    distance_m: float
    tilt_rad: float
    """Angle between the camera's axis and the board's normal."""
    roll_rad: float
    centre_px: tuple[float, float]
    coverage: float
    """Share of the image that the board's outline fills, 0…1."""


class PlannedPose(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    name: str
    joints_rad: Vector6
    base_from_flange: Matrix4 | None = None
    """Expected flange pose; checked against the arm's kinematics."""
    view: ExpectedView | None = None
    why: str = ""
    predicted_sigma_m: float | None = None
    """Expected sigma of X's translation after this pose."""
    guided: bool = False
    """A hand brought the arm there."""


class Plan(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """25 poses, normally. Speeds are upper limits; code caps them further."""

    robot: str
    mount: Mount
    poses: tuple[PlannedPose, ...]
    format: Literal["pose-plan/1"] = "pose-plan/1"
    joint_speed_rad_s: float = 0.6
    joint_acceleration_rad_s2: float = 1.0
    seed: int | None = None
    note: str = ""
    criterion: Criterion | None = None
    """Criterion by which the planner chose all poses; None: a person taught, listed or changed some."""
    motion: Literal["stops", "sweep"] = "stops"
    """sweep: of an earlier release; such a plan is read, and never driven."""


def plan_sha256(plan: Plan) -> str:
    """Hash of everything that decides the motion, independent of file layout: an approval is bound to it."""
    return hashlib.sha256(msgspec.json.encode(plan, order="deterministic")).hexdigest()
