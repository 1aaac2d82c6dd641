"""Gates: named conditions that a calibration must meet before it may be installed, in plain words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from calibrate.errors import CalibrationError
from calibrate.files.calibration import Gate
from calibrate.handeye.readings import Reading
from calibrate.handeye.solution import Solution
from recordings import strict_yaml


class GatesError(CalibrationError):
    """The file of limits is wrong."""

    exit_code = 2


class GateLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits as an owner writes them; None switches a gate off."""

    views: int | None = 8
    weight: float | None = 0.8
    """Mean weight of the views: below it too much was left out of account."""
    session: bool | None = True
    """The recording is what it says: no other reading of it as a whole explains it better."""
    rotation_deg: float | None = 30.0
    """Largest turn between two views."""
    axis_spread: float | None = 0.1
    """0: all turns about one axis, 1: about all axes alike."""
    view_rms_px: float | None = 1.5
    """Worst view."""
    holdout_share: float | None = 0.01
    """Hold-out translation error over the working distance."""
    cross_validation: float | None = 1.0
    """Error of left-out views over the claimed one, in units of the largest that chance allows."""
    predicted_error_m: float | None = 0.002
    """1σ of a point at the working distance."""
    coverage: float | None = 0.25
    """Share of the picture in which corners were seen, when the lens was found from these pictures."""
    lens_pull: float | None = 1.0
    """By which believing the given lens moves X beyond its tolerance, over the predicted error."""
    board_pull: float | None = 1.0
    """The same of the stated board: size, print and flatness."""
    clock_bound_s: float | None = 0.02
    """The arm is at rest: at the stillness limit of 2 mrad/s this is 0.04 mm at one metre."""
    robot_error_m: float | None = 0.002
    robot_error_deg: float | None = 0.3
    certificate: bool | None = None
    """No effect: of files for earlier versions. The certificate is information."""
    agreement_sigma: float | None = None
    """No effect: of files for earlier versions."""
    board_scale: float | None = None
    """No effect: of files for earlier versions; see `board_pull`."""


@dataclass(frozen=True)
class GateInputs:
    """What the gates look at besides the solution."""

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


def judge(solution: Solution, inputs: GateInputs, limits: GateLimits | None = None) -> tuple[Gate, ...]:
    """Every gate that is switched on and can be judged, in the order a person would read them."""
    limits = limits or GateLimits()
    return (
        *_session_gates(solution, limits),
        *_motion_gates(solution, limits),
        *_accuracy_gates(solution, limits),
        *_input_gates(inputs, limits),
        *_statement_gates(solution, limits),
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


def _session_gates(solution: Solution, limits: GateLimits) -> Iterator[Gate]:
    session = solution.session
    if limits.session and solution.profile == "robust":
        as_recorded = session.reading is Reading.AS_RECORDED or solution.move_accepted
        text = "The recording is what it says"
        remark = next((w.text for w in solution.warnings if w.code == session.reading.value), "")
        if session.reading is not Reading.AS_RECORDED:
            text = f"{remark} Accepted: both parts were used" if as_recorded else remark
        yield Gate("session", as_recorded, session.log_evidence_gain, None, text)
    if limits.weight is not None and solution.weights:
        weight = float(np.mean(list(solution.weights.values())))
        yield _at_least(
            "weight",
            weight,
            limits.weight,
            f"The views count for {weight:.0%} of their number",
            "Retake the rejected and suspect views, or leave them out with a reason (--without).",
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
    folds = solution.cross_validation
    if limits.cross_validation is not None and folds is not None:
        value = folds.rms_m / folds.claimed_m / folds.limit
        yield _at_most(
            "cross-validation",
            value,
            limits.cross_validation,
            f"Left-out views are missed by {folds.rms_m * 1e3:.2f} mm, {folds.claimed_m * 1e3:.2f} mm are "
            f"claimed (at most {folds.claimed_m * folds.limit * 1e3:.2f})",
            "The stated error is too small for this cell: check lens, board and looseness of the mounts.",
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


def _input_gates(inputs: GateInputs, limits: GateLimits) -> Iterator[Gate]:
    if limits.coverage is not None and inputs.coverage is not None:
        share = inputs.coverage * 100
        yield _at_least(
            "lens coverage",
            inputs.coverage,
            limits.coverage,
            f"Corners were seen in {share:.0f} % of the picture",
            "Bring the board into the corners of the picture, or give a lens calibrated before.",
        )
    if limits.clock_bound_s is not None and inputs.clock_bound_s is not None:
        bound_ms = inputs.clock_bound_s * 1000
        yield _at_most(
            "clocks",
            inputs.clock_bound_s,
            limits.clock_bound_s,
            f"Pictures and robot poses belong together to {bound_ms:.1f} ms",
            "Check the camera's clock and the network; use a hardware trigger.",
        )


def _statement_gates(solution: Solution, limits: GateLimits) -> Iterator[Gate]:
    """What was stated of lens and board, by what believing it does to X."""
    remedies = {
        "lens": "Solve with --estimate-intrinsics, or calibrate the camera again.",
        "board": "Measure the squares both ways and the flatness, correct square_m and solve again.",
    }
    for name, finding, limit in (
        ("lens", solution.lens_finding, limits.lens_pull),
        ("board", solution.board_finding, limits.board_pull),
    ):
        if finding is None or limit is None or not solution.predicted_error_m:
            continue
        told = f"The stated {name} moves the camera by {finding.pull_m * 1e3:.2f} mm at the working distance"
        yield _at_most(
            name,
            finding.unexplained_m / solution.predicted_error_m,
            limit,
            f"{told}, {finding.unexplained_m * 1e3:.2f} mm more than its tolerance explains "
            f"(predicted error {solution.predicted_error_m * 1e3:.2f} mm)",
            remedies[name],
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
