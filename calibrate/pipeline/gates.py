"""Gates: named conditions that a calibration must meet before it may be installed.

A gate is, under one name, a limit in `GateLimits`, whose text says when it closes, a figure that `_measured`
yields of the solution, and a word of `calibrate/words.toml`, with title, meaning and remedy. Terminal,
screen, report, `--json`, the file of limits and docs/reference/gates.md (`make pages`) take all gates from
here.

To add one:
  1. Compute the figure in `handeye/metrics.py`; test it in tests/calibrate/handeye/test_metrics.py.
  2. Make it a field of `Judgement` in `handeye/solution.py`, or of `results.QualityFigures` where the file is
     to hold it, too (with a row in `files/fields.py`). Fill it in `handeye/describe.py`; for the paper's
     profile in `handeye/paper_profile.py`.
     Joints are `handeye.arm.recorded_joints(views)`: those of `CellFit.arm` may be computed from poses.
     The solver sees no pictures: a figure of a picture is first a field of `views.BoardView`, filled in
     `recorded_views.py` (of a recording) and `pictures.py` (of pictures that a program gives).
  3. Add its word to `calibrate/words.toml`, and here its limit and its figure; `unit` is a key of
     `results.UNITS_SHOWN`. A gate without a value has a function of its own that `judge` calls, such as
     `_session_gate`. A figure passes or fails; a warning is a gate that passed and has a remedy: `_arm_gate`,
     or one named in `ADVICE`, where the stated error holds already what the gate misses.
  4. In tests/calibrate/pipeline/test_gates.py put a good value into the fixture `solution`, a bad one into
     `spoiled`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from calibrate.arms.classes import ARM_CLASSES, UNKNOWN
from calibrate.handeye.solution import Judgement, Reading, Solution
from calibrate.results import Gate, PointError, Sense
from calibrate.words import words_of_gates


class GateLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of the gates, by their ids, as written in a limits file; None (null) switches a gate off, or
    leaves it a warning.

    The text below a limit says when its gate closes.
    """

    views: int | None = None
    """Fewer views were used. Not stated: a warning below 8."""
    weight: float | None = None
    """The mean weight of the views is smaller: too many were rejected or count for little. Not stated: a
    warning below 80 %."""
    session: bool | None = True
    """Another reading of the whole recording (inverted poses, other square size …) explains it better."""
    arm: Literal["warn", "fail"] | None = "warn"
    """`fail`: the size of the arm's own error is assumed by its class, as no joints, kinematics or accuracy
    are known."""
    rotation_deg: float | None = None
    """No two views are rotated this far against each other. Not stated: a warning below 30°."""
    axis_spread: float | None = None
    """All rotations are about nearly one axis (0: all about one, 1: all axes alike). Not stated: a warning
    below 0.1."""
    view_rms_px: float | None = 1.5
    """The rms reprojection error of some view is larger."""
    holdout_share: float | None = None
    """Held-out views miss by more than this share of the working distance. Not stated: a warning above
    1 %."""
    cross_validation: float | None = 1.0
    """Left-out views are missed by more than the stated uncertainty allows by chance."""
    predicted_error_m: float | None = None
    """A point at the working distance is placed with a larger error (1σ). Not stated: 2 mm for a recording of
    the station, whose cell is to be used; nothing fails by size where nobody asked for one."""
    coverage: float | None = None
    """The intrinsics were estimated here, and all boards together cover a smaller share of the image. Not
    stated: a warning below 25 %."""
    lens_pull: float | None = 1.0
    """Given intrinsics shift X, beyond their tolerance, by more than its error without an arm's."""
    board_pull: float | None = 1.0
    """The stated board (size, print, flatness) does the same."""
    clock_bound_s: float | None = 0.02
    # An arm counts as settled below 2 mrad/s: in 0.02 s at most 0.04 mm at one metre.
    """Image and robot pose may be further apart in time."""
    robot_error_m: float | None = None
    """The robot's positions are noisier. Not stated: a warning above 2 mm."""
    robot_error_deg: float | None = None
    """Its orientations are noisier. Not stated: a warning above 0.3°."""


STATION_ERROR_M = 0.002
"""Limit of `predicted_error_m` for a recording of the station, where none is stated."""


def judge(
    solution: Solution,
    limits: GateLimits | None = None,
    clock_bound_s: float | None = None,
    of_station: bool = False,
) -> tuple[Gate, ...]:
    """Judge every gate that is switched on and can be judged, in order of reading.

    clock_bound_s: largest bound of the time offset over the used views; None where no clocks were recorded.
    of_station: the station took the recording, so that the error has a limit even where none is stated.
    """
    limits = limits or GateLimits()
    if limits.predicted_error_m is None and of_station:
        limits = msgspec.structs.replace(limits, predicted_error_m=STATION_ERROR_M)
    found = [_session_gate(solution.judgement)] if limits.session and solution.profile == "robust" else []
    if limits.arm and solution.profile == "robust":
        found.append(_arm_gate(solution.judgement.figures.point, limits.arm))
    point = solution.judgement.figures.point
    for figure in _measured(solution, clock_bound_s):
        name = figure.name
        stated = getattr(limits, name)
        limit = ADVICE.get(name) if stated is None else stated
        if figure.value is None or limit is None:
            continue
        gate = Gate.measured(
            name, figure.title, figure.value, figure.sense, limit, figure.unit, figure.remedy
        )
        if not gate.passed and stated is None and point is not None:
            gate = gate.as_advice(_cost(name, point))
        if not gate.passed and name == "predicted_error_m" and _by_assumption_alone(point, limit):
            gate = gate.as_advice(_ASSUMED)
        found.append(gate)
    return tuple(found)


ADVICE = {
    "views": 8,
    "weight": 0.8,
    "rotation_deg": 30.0,
    "axis_spread": 0.1,
    "holdout_share": 0.01,
    "coverage": 0.25,
    "robot_error_m": 0.002,
    "robot_error_deg": 0.3,
}
"""Gates that warn at these values where nobody states a limit: the stated error holds already what they miss.
Whether it is true, `cross_validation` judges."""
_ASSUMED = (
    "It is larger only by the arm's own error, whose size is assumed. Record joints, or have it measured."
)


def _cost(name: str, point: PointError) -> str:
    """Say how much of the stated error at most is due to what a gate of `ADVICE` misses."""
    by_lens = name == "coverage"
    part_mm = point.from_board_lens_mm if by_lens else float(np.hypot(point.from_x_mm, point.from_arm_mm))
    whose = "of lens and board" if by_lens else "of views and arm"
    return f"It is in the error: {part_mm:.2g} of {point.error_mm:.2g} mm are {whose}."


def _by_assumption_alone(point: PointError | None, limit_m: float) -> bool:
    """Tell whether the error would be within its limit but for an arm whose size of errors is assumed."""
    if point is None or point.arm != "assumed":
        return False
    others_mm = np.hypot(point.from_x_mm, point.from_board_lens_mm)
    return bool(others_mm <= 1e3 * limit_m)


class _Figure(NamedTuple):
    """What `Gate.measured` judges by the limit of this name; title and remedy are in the table of words."""

    name: str
    value: float | None
    """In `unit`; None: not judged."""
    sense: Sense
    unit: str
    """Of value and limit, a key of `results.UNITS_SHOWN`: m, deg, s, px, share; empty for plain numbers."""
    about: str = ""
    """What of it is told in brackets behind the title."""
    way: str = ""
    """What of this solution the remedy is told more by."""

    @property
    def title(self) -> str:
        """What is measured, for people."""
        return f"{_title(self.name)} ({self.about})" if self.about else _title(self.name)

    @property
    def remedy(self) -> str:
        """Next step where the gate is closed."""
        return f"{words_of_gates()[self.name].bad} {self.way}".rstrip()


def _title(name: str) -> str:
    return words_of_gates()[name].title


def _measured(solution: Solution, clock_bound_s: float | None) -> Iterator[_Figure]:
    judgement = solution.judgement
    evidence = solution.evidence
    figures = judgement.figures
    seen = judgement.observability
    folds = figures.cross_validation
    noise = solution.fit.noise
    distance_m = figures.working_distance_m or 0.0
    weights = list(evidence.weights.values())
    weight = float(np.mean(weights)) if weights else None
    least_known = f"Least known: {seen.weakest_text}."
    yield _Figure("weight", weight, "≥", "share")
    yield _Figure("views", len(evidence.views.used), "≥", "")
    yield _Figure("rotation_deg", float(np.degrees(seen.largest_angle_rad)), "≥", "deg")
    yield _Figure("axis_spread", seen.axis_spread, "≥", "", way=least_known)
    if px := evidence.rms_px:
        worst = max(px, key=lambda index: px[index])
        at = f"pose {worst + 1}"
        yield _Figure("view_rms_px", px[worst], "≤", "px", about=at, way=f"It is {at}.")
    if figures.holdout is not None and distance_m:
        missed_m = figures.holdout.e_t_m
        missed = f"{1e3 * missed_m:.2g} mm"
        yield _Figure("holdout_share", missed_m / distance_m, "≤", "share", about=missed)
    if folds is not None:
        ratio = folds.rms_mm / folds.claimed_mm / folds.limit
        missed = f"{folds.rms_mm:.2f} mm, predicted {folds.claimed_mm:.2f} mm; 1 is what chance explains"
        yield _Figure("cross_validation", ratio, "≤", "", about=missed)
    error_mm = figures.predicted_error_mm
    error_m = None if error_mm is None else error_mm / 1e3
    at = f"at {distance_m * 1e3:.0f} mm"
    yield _Figure("predicted_error_m", error_m, "≤", "m", about=at, way=least_known)
    coverage = judgement.coverage if solution.fit.lens_estimated else None
    yield _Figure("coverage", coverage, "≥", "share")
    yield _Figure("clock_bound_s", clock_bound_s, "≤", "s")
    for name, finding in (("lens_pull", judgement.lens_finding), ("board_pull", judgement.board_finding)):
        if finding is not None:
            of_mm = f"{finding.unexplained_m * 1e3:.2f} of {finding.pull_m * 1e3:.2f} mm"
            about = f"{of_mm} unexplained; 1 is the error of the camera pose"
            yield _Figure(name, finding.unexplained_m / finding.error_m, "≤", "", about=about)
    if noise is not None:
        yield _Figure("robot_error_m", noise.robot_m, "≤", "m")
        yield _Figure("robot_error_deg", float(np.degrees(noise.robot_rad)), "≤", "deg")


def _arm_gate(point: PointError | None, limit: Literal["warn", "fail"]) -> Gate:
    if point is None or point.arm != "assumed":
        known = "" if point is None else f", {point.arm}"
        return Gate("arm", True, None, None, f"{_title('arm')}: in the stated one{known} PASS")
    of_class = ARM_CLASSES[point.arm_class].title
    remedy = (
        "Record joints, or state --robot-accuracy-mm."
        if point.arm_class != UNKNOWN
        else words_of_gates()["arm"].bad
    )
    text = f"{_title('arm')}: assumed as of {of_class}, {limit.upper()}. {remedy}"
    return Gate("arm", limit == "warn", None, None, text, remedy=remedy)


def _session_gate(judgement: Judgement) -> Gate:
    session = judgement.session
    passed = session.reading is Reading.AS_RECORDED
    told = next((remark.text for remark in judgement.warnings if remark.code == session.reading.value), "")
    remedy = "" if passed else told
    found = "yes PASS" if passed else f"no, {session.reading.value} FAIL. {told}"
    text = f"{_title('session')}: {found}".rstrip()
    return Gate("session", passed, session.log_evidence_gain, None, text, remedy=remedy)
