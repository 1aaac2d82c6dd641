"""Gates: named conditions that a calibration must meet before it may be installed.

A gate is, under one name, a limit in `GateLimits`, a rule in `_RULES`, and a value that `_measured` yields of
the solution; None: it is not judged. A new figure is a field of `handeye.solution.Solution`, filled by
`_describe` in `handeye.solve`. A gate without a value has a function of its own that `judge` calls, such as
`_session_gate`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from calibrate.handeye.solution import Reading, Solution
from calibrate.results import Gate, Sense


class GateLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of the gates, by their ids, as written in a limits file; None switches a gate off."""

    views: int | None = 8
    weight: float | None = 0.8
    """Smallest mean weight of the views: below it too many were rejected or down-weighted."""
    session: bool | None = True
    """No other reading of the recording (inverted poses, other square size, …) explains it better."""
    arm: Literal["warn", "fail"] | None = "warn"
    """What becomes of a stated error that holds of the arm's own only what varies smoothly with its place: no
    joints, model or accuracy are known."""
    rotation_deg: float | None = 30.0
    """Smallest allowed value of the largest rotation between two views."""
    axis_spread: float | None = 0.1
    """Smallest spread of the rotation axes; 0: all about one axis, 1: all axes alike."""
    view_rms_px: float | None = 1.5
    """Largest of the views' rms reprojection errors."""
    holdout_share: float | None = 0.01
    """Held-out translation error over the working distance."""
    cross_validation: float | None = 1.0
    """Cross-validated over predicted error, as a multiple of the largest ratio that chance explains."""
    predicted_error_m: float | None = 0.002
    """1σ of a point at the working distance."""
    coverage: float | None = 0.25
    """Share of the image in which corners were seen, when the intrinsics were estimated from these images."""
    lens_pull: float | None = 1.0
    """Shift of X caused by the given intrinsics, beyond their tolerance, over its error without an arm's."""
    board_pull: float | None = 1.0
    """The same for the stated board: size, print and flatness."""
    clock_bound_s: float | None = 0.02
    """Largest uncertainty of image time against robot time. An arm counts as settled below 2 mrad/s, so this
    is at most 0.04 mm at one metre."""
    robot_error_m: float | None = 0.002
    robot_error_deg: float | None = 0.3


def judge(
    solution: Solution, limits: GateLimits | None = None, clock_bound_s: float | None = None
) -> tuple[Gate, ...]:
    """Judge every gate that is switched on and can be judged, in order of reading.

    clock_bound_s: largest bound of the time offset over the used views; None where no clocks were recorded.
    """
    limits = limits or GateLimits()
    found = [_session_gate(solution)] if limits.session and solution.profile == "robust" else []
    if limits.arm and solution.profile == "robust":
        found.append(_arm_gate(solution.without_arm, limits.arm))
    for name, value, title, remedy in _measured(solution, clock_bound_s):
        limit = getattr(limits, name)
        if value is None or limit is None:
            continue
        rule = _RULES[name]
        text = f"{rule.title} {title}".rstrip()
        found.append(Gate.measured(name, text, value, rule.sense, limit, rule.unit, remedy or rule.remedy))
    return tuple(found)


class _Rule(NamedTuple):
    title: str
    """What is measured, for people."""
    sense: Sense
    unit: str
    """Of value and limit: m, deg, s, px, share; empty for plain numbers."""
    remedy: str = ""
    """Next step where the gate is closed; empty: `_measured` yields it with the value."""


_ARM = "Check payload, mounting, looseness of board and camera, and the robot's calibrated kinematics."
_RULES = {
    "weight": _Rule("Mean view weight", "≥", "share", "Retake the rejected and suspect views."),
    "views": _Rule("View count", "≥", "", "Capture more poses that show the board."),
    "rotation_deg": _Rule("Rotation range", "≥", "deg", "Add poses with more tilt and roll."),
    "axis_spread": _Rule("Rotation diversity", "≥", ""),
    "view_rms_px": _Rule("Largest rms error of a view", "≤", "px"),
    "holdout_share": _Rule("Held-out error", "≤", "share", "Check robot accuracy and corner detection."),
    "cross_validation": _Rule(
        "Cross-validated error",
        "≤",
        "",
        "Check intrinsics, board and looseness of the mounts.",
    ),
    "predicted_error_m": _Rule("Predicted error", "≤", "m"),
    "coverage": _Rule("Image coverage", "≥", "share", "Bring the board into the corners of the image."),
    "clock_bound_s": _Rule("Time sync", "≤", "s", "Check the camera's clock, or use a hardware trigger."),
    "lens_pull": _Rule(
        "Shift by fixed intrinsics",
        "≤",
        "",
        "Solve with --estimate-intrinsics, or calibrate the camera again.",
    ),
    "board_pull": _Rule(
        "Shift by the stated board",
        "≤",
        "",
        "Measure the squares both ways and the flatness, correct square_m and solve again.",
    ),
    "robot_error_m": _Rule("Position noise", "≤", "m", _ARM),
    "robot_error_deg": _Rule("Orientation noise", "≤", "deg", _ARM),
}


def _measured(
    solution: Solution, clock_bound_s: float | None
) -> Iterator[tuple[str, float | None, str, str]]:
    """Yield each gate's id, value in its unit (None: not judged), end of its title, and own remedy or ""."""
    seen, folds, noise = solution.observability, solution.cross_validation, solution.noise
    predicted_m, distance_m = solution.predicted_error_m, solution.working_distance_m
    weights = list(solution.weights.values())
    yield "weight", float(np.mean(weights)) if weights else None, "", ""
    yield "views", len(solution.used), "", ""
    yield "rotation_deg", float(np.degrees(seen.largest_angle_rad)), "", ""
    yield "axis_spread", seen.axis_spread, "", f"Add rotations about other axes: {seen.weakest_text}."
    if solution.residual_px:
        worst = max(solution.residual_px, key=lambda index: solution.residual_px[index])
        remedy = f"Retake pose {worst + 1}, or check the intrinsics."
        yield "view_rms_px", solution.residual_px[worst], f"(pose {worst + 1})", remedy
    if solution.holdout is not None and distance_m:
        missed_m = solution.holdout.e_t_m
        yield "holdout_share", missed_m / distance_m, f"({1e3 * missed_m:.2g} mm)", ""
    if folds is not None:
        figures = f"({folds.rms_mm:.2f} mm, predicted {folds.claimed_mm:.2f} mm; 1 is what chance explains)"
        yield "cross_validation", folds.rms_mm / folds.claimed_mm / folds.limit, figures, ""
    remedy = f"Least known: {seen.weakest_text}. Add rotations about that direction."
    yield "predicted_error_m", predicted_m, f"at {(distance_m or 0.0) * 1e3:.0f} mm", remedy
    yield "coverage", solution.coverage if solution.lens_estimated else None, "", ""
    yield "clock_bound_s", clock_bound_s, "", ""
    for name, finding in (("lens_pull", solution.lens_finding), ("board_pull", solution.board_finding)):
        if finding is not None:
            of_mm = f"{finding.unexplained_m * 1e3:.2f} of {finding.pull_m * 1e3:.2f} mm"
            figures = f"({of_mm} unexplained; 1 is the error of X)"
            yield name, finding.unexplained_m / finding.error_m, figures, ""
    if noise is not None:
        yield "robot_error_m", noise.robot_m, "", ""
        yield "robot_error_deg", float(np.degrees(noise.robot_rad)), "", ""


def _arm_gate(without: bool, limit: Literal["warn", "fail"]) -> Gate:
    if not without:
        return Gate("arm", True, None, None, "Arm's own error: in the predicted error PASS")
    remedy = "Record joints, or state --robot-accuracy-mm."
    text = f"Arm's own error: only in part in the predicted error {limit.upper()}. {remedy}"
    return Gate("arm", limit == "warn", None, None, text, remedy=remedy)


def _session_gate(solution: Solution) -> Gate:
    session = solution.session
    passed = session.reading is Reading.AS_RECORDED
    told = next((remark.text for remark in solution.warnings if remark.code == session.reading.value), "")
    remedy = "" if passed else told
    found = "yes PASS" if passed else f"no, {session.reading.value} FAIL. {told}"
    text = f"Poses and board as told: {found}".rstrip()
    return Gate("session", passed, session.log_evidence_gain, None, text, remedy=remedy)
