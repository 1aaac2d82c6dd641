"""Gates: named conditions that a calibration must meet before it may be installed, in plain words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from calibrate.errors import CalibrationError
from calibrate.scale import ScaleCheck
from calibrate.solution import Solution
from recordings import strict_yaml


class GatesError(CalibrationError):
    """The file of limits is wrong."""

    exit_code = 2


class GateLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits as an owner writes them; None switches a gate off."""

    views: int | None = 8
    rotation_deg: float | None = 30.0
    """Largest turn between two views."""
    axis_spread: float | None = 0.1
    """0: all turns about one axis, 1: about all axes alike."""
    certificate: bool | None = True
    agreement_sigma: float | None = 6.0
    """Between the certified optimum of the quadratic objective and the final X."""
    view_rms_px: float | None = 1.5
    """Worst view."""
    holdout_share: float | None = 0.01
    """Hold-out translation error over the working distance."""
    predicted_error_m: float | None = 0.002
    """1σ of a point at the working distance."""
    coverage: float | None = 0.25
    """Share of the picture in which corners were seen, when the lens was found from these pictures."""
    board_scale: float | None = 0.01
    """|scale - 1| of the board against the robot's motion, when it is also significant."""
    clock_bound_s: float | None = 0.02
    """The arm is at rest: at the stillness limit of 2 mrad/s this is 0.04 mm at one metre."""
    robot_error_m: float | None = 0.002
    robot_error_deg: float | None = 0.3


class Gate(msgspec.Struct, frozen=True, omit_defaults=True):
    name: str
    passed: bool
    value: float | None
    """In the unit of the limit of its name in `GateLimits`; None in a file where it was no finite number."""
    limit: float | None
    text: str
    """What was found and, where it failed, what to do."""


@dataclass(frozen=True)
class Evidence:
    """What the gates look at besides the solution."""

    scale: ScaleCheck | None = None
    coverage: float | None = None
    """None when the lens was not found from these pictures."""
    clock_bound_s: float | None = None
    """Worst over the used views; None where no clocks were recorded."""


def read_limits(path: Path) -> GateLimits:
    """YAML with some of GateLimits' fields. Raises GatesError naming file and field."""
    try:
        with path.open("rb") as file:
            return strict_yaml.load(file.read(strict_yaml.LIMIT_BYTES + 1), GateLimits)
    except (OSError, strict_yaml.StrictYamlError) as problem:
        raise GatesError(f"{path}: {problem}. Allowed: {', '.join(GateLimits.__struct_fields__)}.") from None


def judge(solution: Solution, evidence: Evidence, limits: GateLimits | None = None) -> tuple[Gate, ...]:
    """Every gate that is switched on and can be judged, in the order a person would read them."""
    limits = limits or GateLimits()
    return (
        *_motion_gates(solution, limits),
        *_optimum_gates(solution, limits),
        *_accuracy_gates(solution, limits),
        *_evidence_gates(evidence, limits),
        *_robot_gates(solution, limits),
    )


def _at_most(name: str, value: float, limit: float, text: str, remedy: str) -> Gate:
    passed = bool(np.isfinite(value) and value <= limit)
    return Gate(name, passed, float(value), float(limit), text if passed else f"{text}. {remedy}")


def _at_least(name: str, value: float, limit: float, text: str, remedy: str) -> Gate:
    passed = bool(np.isfinite(value) and value >= limit)
    return Gate(name, passed, float(value), float(limit), text if passed else f"{text}. {remedy}")


def _motion_gates(solution: Solution, limits: GateLimits) -> Iterator[Gate]:
    seen = solution.observability
    if limits.views is not None:
        count = len(solution.used)
        yield _at_least(
            "views",
            count,
            limits.views,
            f"{count} views were used",
            "Capture more poses that show the board.",
        )
    if limits.rotation_deg is not None:
        angle = float(np.degrees(seen.largest_angle_rad))
        compared = "two views" if solution.profile == "robust" else "neighbouring views"
        yield _at_least(
            "rotation",
            angle,
            limits.rotation_deg,
            f"The largest turn between {compared} is {angle:.0f}°",
            "Add poses that tilt and roll the flange further.",
        )
    if limits.axis_spread is not None:
        yield _at_least(
            "axes",
            seen.axis_spread,
            limits.axis_spread,
            f"The axes of the turns spread by {seen.axis_spread:.2f} (0 parallel, 1 all alike)",
            f"Add turns about other axes: {seen.weakest_text}.",
        )


def _optimum_gates(solution: Solution, limits: GateLimits) -> Iterator[Gate]:
    proof = solution.certificate
    if limits.certificate:
        gap = f"relative gap {proof.relative_gap:.1e}" if proof.relative_gap > 1e-15 else "no gap at all"
        yield Gate(
            "certificate",
            proof.certified,
            proof.relative_gap,
            proof.tolerance,
            f"The optimum of the {proof.problem or 'quadratic objective'} is proven global ({gap})"
            if proof.certified
            else f"The optimum is not proven ({gap}). Add views, or look for wrong ones.",
        )
    if limits.agreement_sigma is not None and proof.distance_sigma is not None:
        yield _at_most(
            "agreement",
            proof.distance_sigma,
            limits.agreement_sigma,
            f"Certified optimum and final X are {proof.distance_sigma:.1f} sigmas apart",
            "The robot's orientations contradict its positions: see the warning below."
            if solution.frames_finding
            else "Two sound methods disagree: look for views that do not belong, or a wrong lens.",
        )


def _accuracy_gates(solution: Solution, limits: GateLimits) -> Iterator[Gate]:
    if limits.view_rms_px is not None and solution.residual_px:
        worst = max(solution.residual_px, key=lambda index: solution.residual_px[index])
        value = solution.residual_px[worst]
        yield _at_most(
            "view residual",
            value,
            limits.view_rms_px,
            f"The worst view, pose {worst + 1}, fits to {value:.2f} px",
            f"Retake pose {worst + 1}, or check the lens.",
        )
    if limits.holdout_share is not None and solution.holdout is not None and solution.working_distance_m:
        e_t_mm = solution.holdout.e_t_m * 1000
        yield _at_most(
            "hold-out",
            solution.holdout.e_t_m,
            limits.holdout_share * solution.working_distance_m,
            f"Views that took no part are predicted to {e_t_mm:.2f} mm",
            "The robot's poses or the corners are worse than this cell needs.",
        )
    if limits.predicted_error_m is not None and solution.predicted_error_m is not None:
        value_mm = solution.predicted_error_m * 1000
        distance = solution.working_distance_m or 0.0
        yield _at_most(
            "predicted error",
            solution.predicted_error_m,
            limits.predicted_error_m,
            f"A point {distance * 1000:.0f} mm away is expected to be right to {value_mm:.2f} mm (1σ)",
            f"Weakest: {solution.observability.weakest_text}. More turns about that direction help.",
        )


def _evidence_gates(evidence: Evidence, limits: GateLimits) -> Iterator[Gate]:
    if limits.coverage is not None and evidence.coverage is not None:
        share = evidence.coverage * 100
        yield _at_least(
            "lens coverage",
            evidence.coverage,
            limits.coverage,
            f"Corners were seen in {share:.0f} % of the picture",
            "Bring the board into the corners of the picture, or give a lens calibrated before.",
        )
    if limits.board_scale is not None and evidence.scale is not None:
        check = evidence.scale
        miss = abs(check.scale - 1.0)
        passed = miss <= limits.board_scale or not check.significant
        yield Gate("board scale", passed, float(miss), limits.board_scale, check.text)
    if limits.clock_bound_s is not None and evidence.clock_bound_s is not None:
        bound_ms = evidence.clock_bound_s * 1000
        yield _at_most(
            "clocks",
            evidence.clock_bound_s,
            limits.clock_bound_s,
            f"Pictures and robot poses belong together to {bound_ms:.1f} ms",
            "Check the camera's clock and the network; use a hardware trigger.",
        )


def _robot_gates(solution: Solution, limits: GateLimits) -> Iterator[Gate]:
    noise = solution.noise
    if noise is None:
        return
    remedy = "Check payload, mounting, looseness of board and camera, and the robot's calibrated kinematics."
    if limits.robot_error_m is not None:
        text = f"The robot's positions scatter by {noise.robot_m * 1000:.2f} mm"
        yield _at_most("robot position", noise.robot_m, limits.robot_error_m, text, remedy)
    if limits.robot_error_deg is not None:
        degrees = float(np.degrees(noise.robot_rad))
        text = f"The robot's orientations scatter by {degrees:.3f}°"
        yield _at_most("robot orientation", degrees, limits.robot_error_deg, text, remedy)
