"""Plan: joint targets, the expected views, and the reason for each."""

from __future__ import annotations

import hashlib
from typing import Literal

import msgspec

from recordings.schema.messages import Matrix4, Mount, ToldJoints

Criterion = Literal["A", "D", "arm", "all"]
"""Criterion of a plan. A: smallest error of X; arm: smallest error over the workspace with the arm's
corrected table; all and D: of earlier releases."""


class ExpectedView(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """View of the board expected at a pose, by the initial camera and board poses of the planning."""

    distance_m: float
    tilt_rad: float
    """Angle between the camera's axis and the board's normal."""
    roll_rad: float
    centre_px: tuple[float, float]
    coverage: float
    """Share of the image that the board's outline fills, 0…1."""


class PlannedPose(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    name: str
    joints_rad: ToldJoints
    """Target (6,), rad; of a pose to which a person brought the arm, as the arm told them."""
    base_from_flange: Matrix4 | None = None
    """Expected flange pose; checked against the arm's kinematics."""
    view: ExpectedView | None = None
    why: str = ""
    predicted_sigma_m: float | None = None
    """Placed-point error (1σ) at the plan's working distance after this pose, at the postures of all poses.
    In plans without `floor_m`: X's part alone."""
    guided: bool = False
    """True when a person brought the arm there by hand."""


class Plan(msgspec.Struct, frozen=True, omit_defaults=True, forbid_unknown_fields=True):
    """Poses of a session, normally 25. Speeds are upper limits, besides those of the configuration."""

    robot: str
    mount: Mount
    poses: tuple[PlannedPose, ...]
    format: Literal["pose-plan/1"] = "pose-plan/1"
    joint_speed_rad_s: float = 0.6
    joint_acceleration_rad_s2: float = 1.0
    seed: int | None = None
    note: str = ""
    criterion: Criterion | None = None
    """Criterion by which the planner chose the poses; None: a person taught, listed or changed some."""
    working_distance_m: float | None = None
    """Median distance of camera and board, for which the poses state a placed-point error."""
    floor_m: float | None = None
    """Part of these errors by the arm: its noise, and what all poses leave of its links' errors. No further
    pose lowers it. None: older plans."""

    def predicted_error_m(self, index: int) -> float | None:
        """Placed-point error with the poses up to this one; None: not known, or of X alone (older plans)."""
        return None if self.floor_m is None else self.poses[index].predicted_sigma_m


def plan_sha256(plan: Plan) -> str:
    """Compute the hash by which recordings and calibrations name a plan."""
    return hashlib.sha256(msgspec.json.encode(plan, order="deterministic")).hexdigest()
