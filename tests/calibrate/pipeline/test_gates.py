"""Each gate closes for its own reason; one id in output, limits and documents."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibrate.cli.inputs import read_limits
from calibrate.errors import UsageError
from calibrate.files.formatting import figures
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.solution import Explanation, Finding, Reading, Solution
from calibrate.pipeline.gates import ADVICE, GateLimits, judge
from calibrate.pipeline.job import SolvedRecording
from calibrate.results import (
    CrossValidation,
    Gate,
    HoldoutScore,
    PointError,
    Remark,
    ViewQuality,
    ViewWeight,
)
from tests.codes import raises

CLOCK_S = 0.001
STATED = GateLimits(arm="fail", predicted_error_m=0.002, **ADVICE)
NAMES = [name for name, limit in msgspec.structs.asdict(STATED).items() if limit is not None]
POINT = PointError(0.5, 0.5, 1.0, 0.6, 0.1, 0.45, 0.2, 0.45, 0.49, "learned")
ASSUMED = msgspec.structs.replace(POINT, arm="assumed", arm_class="universal-robots")


def altered(
    solution: Solution,
    *,
    fit: dict[str, object] | None = None,
    figures: dict[str, object] | None = None,
    judgement: dict[str, object] | None = None,
    evidence: dict[str, object] | None = None,
    views: dict[str, object] | None = None,
) -> Solution:
    """The solution with other values of these fields of its parts."""
    judged = solution.judgement
    shown = solution.evidence
    return replace(
        solution,
        fit=replace(solution.fit, **fit or {}),
        judgement=replace(
            judged, figures=msgspec.structs.replace(judged.figures, **figures or {}), **judgement or {}
        ),
        evidence=replace(shown, views=msgspec.structs.replace(shown.views, **views or {}), **evidence or {}),
    )


def weighing(solution: Solution, weight: float) -> list[ViewWeight]:
    return [ViewWeight(index, weight) for index in solution.evidence.views.used]


@pytest.fixture
def solution(solved_real: SolvedRecording) -> Solution:
    """One that every gate lets through: the figure of a new gate gets a good value here."""
    found = solved_real.solution
    seen = replace(found.judgement.observability, largest_angle_rad=1.2, axis_spread=0.6)
    return altered(
        found,
        fit={"noise": MeasurementNoise(0.1, 0.0001, 0.0002), "lens_estimated": True},
        figures={
            "holdout": HoldoutScore(0.0005, 0.001, [0.0005], [0.001], [(0, 1)], 12),
            "cross_validation": CrossValidation(0.5, 0.06, 0.4, 5, 1.5),
            "predicted_error_mm": 0.5,
            "working_distance_m": 0.5,
            "point": POINT,
        },
        judgement={
            "coverage": 0.6,
            "session": Explanation(Reading.AS_RECORDED, 0.0),
            "lens_finding": Finding(2.0, 0.0001, 0.0005),
            "board_finding": Finding(2.0, 0.0001, 0.0005),
            "observability": seen,
        },
        evidence={"residuals": tuple(ViewQuality(i, 0.2) for i in found.evidence.views.used)},
        views={"weights": weighing(found, 1.0)},
    )


def failed(gates: tuple[Gate, ...]) -> list[str]:
    return [gate.name for gate in gates if not gate.passed]


def test_a_good_solution_passes_every_gate(solution: Solution) -> None:
    gates = judge(solution, STATED, CLOCK_S)
    assert failed(gates) == []
    assert sorted(gate.name for gate in gates) == sorted(NAMES), "a gate's id is the name of its limit"


def spoiled(solution: Solution, name: str) -> tuple[Solution, float]:
    """Solution and bound of the clocks that close this gate alone: a new gate gets a bad figure here."""
    seen = solution.judgement.observability
    figures = solution.judgement.figures
    other = Explanation(Reading.SHIFTED, 90.0, 1)
    pull = Finding(8.0, 0.0011, 0.0005)
    changed = {
        "views": altered(solution, views={"used": solution.evidence.views.used[:5]}),
        "arm": altered(solution, figures={"point": ASSUMED}),
        "rotation_deg": altered(solution, judgement={"observability": replace(seen, largest_angle_rad=0.2)}),
        "axis_spread": altered(solution, judgement={"observability": replace(seen, axis_spread=0.01)}),
        "session": altered(
            solution,
            judgement={"session": other, "warnings": (Remark(other.reading.value, "Move them."),)},
        ),
        "weight": altered(solution, views={"weights": weighing(solution, 0.79)}),
        "cross_validation": altered(
            solution, figures={"cross_validation": replace(figures.cross_validation, rms_mm=0.61)}
        ),
        "lens_pull": altered(solution, judgement={"lens_finding": pull}),
        "board_pull": altered(solution, judgement={"board_finding": pull}),
        "view_rms_px": altered(solution, evidence={"residuals": (ViewQuality(3, 9.0),)}),
        "holdout_share": altered(
            solution, figures={"holdout": msgspec.structs.replace(figures.holdout, e_t_m=0.02)}
        ),
        "predicted_error_m": altered(solution, figures={"predicted_error_mm": 3.0}),
        "robot_error_m": altered(solution, fit={"noise": MeasurementNoise(0.1, 0.01, 0.0)}),
        "robot_error_deg": altered(solution, fit={"noise": MeasurementNoise(0.1, 0.0, 0.02)}),
        "coverage": altered(solution, judgement={"coverage": 0.05}),
    }
    return changed.get(name, solution), 0.05 if name == "clock_bound_s" else CLOCK_S


@pytest.mark.parametrize("name", NAMES)
def test_each_gate_closes_alone_and_says_why(solution: Solution, name: str) -> None:
    bad, clock_s = spoiled(solution, name)
    gates = judge(bad, STATED, clock_s)
    assert failed(gates) == [name]
    gate = next(gate for gate in gates if gate.name == name)
    assert gate.remedy and gate.text.endswith(f"FAIL. {gate.remedy}")
    assert all(gate.text.endswith("PASS") and not gate.remedy for gate in gates if gate.name != name)


@pytest.mark.parametrize("name", ADVICE)
def test_what_the_stated_error_holds_already_warns_where_nobody_stated_a_limit(
    solution: Solution, name: str
) -> None:
    gates = judge(spoiled(solution, name)[0], None, CLOCK_S)
    assert failed(gates) == []
    (gate,) = (gate for gate in gates if gate.remedy)
    assert (gate.name, gate.narrow, gate.over_limit) == (name, True, True)


def test_nothing_fails_by_a_size_that_nobody_asked_for(solution: Solution) -> None:
    large, _ = spoiled(solution, "predicted_error_m")
    assert failed(judge(large, None, CLOCK_S)) == []
    assert failed(judge(large, None, CLOCK_S, of_station=True)) == ["predicted_error_m"]
    assert failed(judge(large, GateLimits(predicted_error_m=0.004), CLOCK_S, of_station=True)) == []


@pytest.mark.parametrize(
    ("arm", "from_x_mm", "closed"), [("assumed", 0.5, False), ("assumed", 2.5, True), ("learned", 0.5, True)]
)
def test_an_error_too_large_by_an_assumed_arm_alone_passes_with_that_reason(
    solution: Solution, solved_real: SolvedRecording, arm: str, from_x_mm: float, closed: bool
) -> None:
    large = msgspec.structs.replace(
        ASSUMED, error_mm=3.0, arm=arm, from_x_mm=from_x_mm, from_arm_mm=float(np.sqrt(9 - from_x_mm**2))
    )
    judged = altered(solution, figures={"point": large, "predicted_error_mm": large.error_mm})
    gates = judge(judged, GateLimits(predicted_error_m=0.002), CLOCK_S)
    assert failed(gates) == ["predicted_error_m"] * closed
    quality = msgspec.structs.replace(solved_real.calibration.quality, gates=list(gates))
    made = msgspec.structs.replace(solved_real.calibration, quality=quality)
    assert made.verdict == ("FAIL" if closed else "PASS WITH A REASON")


def test_values_and_limits_are_in_the_units_of_the_file_of_limits(solution: Solution) -> None:
    gates = {gate.name: (gate.value, gate.limit) for gate in judge(solution, None, CLOCK_S)}
    assert gates["rotation_deg"] == pytest.approx((np.degrees(1.2), 30))
    assert gates["holdout_share"] == pytest.approx((0.0005 / 0.5, 0.01))
    assert gates["cross_validation"] == pytest.approx((0.0005 / 0.0004 / 1.5, 1.0))
    assert gates["robot_error_deg"] == pytest.approx((np.degrees(0.0002), 0.3))
    assert gates["lens_pull"] == gates["board_pull"] == (0.0, 1.0)


@pytest.mark.parametrize(
    ("sigmas", "pull_m", "closed"),
    [
        (3.9, 0.1, False),  # the tolerance explains it, whatever it does to X
        (1e6, 0.0004, False),  # a clear contradiction that costs less than the predicted error
        (1e6, 0.0006, True),
        (8.0, 0.0009, False),  # half of it is explained
        (8.0, 0.0011, True),
        (8.0, float("nan"), True),
    ],
)
def test_a_statement_closes_its_gate_by_what_its_tolerance_leaves_unexplained(
    solution: Solution, sigmas: float, pull_m: float, closed: bool
) -> None:
    for name in ("lens", "board"):
        told = altered(solution, judgement={f"{name}_finding": Finding(sigmas, pull_m, 0.0005)})
        assert failed(judge(told, None, CLOCK_S)) == [f"{name}_pull"] * closed


def test_the_certificate_informs_and_closes_nothing(solution: Solution) -> None:
    bad = replace(solution.judgement.figures.certificate, certified=False, distance_sigma=40.0)
    assert failed(judge(altered(solution, figures={"certificate": bad}), None, CLOCK_S)) == []


def test_what_cannot_be_judged_is_left_out(solution: Solution) -> None:
    bare = altered(
        solution,
        fit={"noise": None, "lens_estimated": False},
        figures={"holdout": None, "cross_validation": None},
    )
    judged = {gate.name for gate in judge(bare)}
    assert judged & {"views", "holdout_share", "cross_validation", "coverage", "robot_error_m"} == {"views"}


def test_limits_come_from_a_file_and_null_switches_a_gate_off(solution: Solution, tmp_path: Path) -> None:
    path = tmp_path / "gates.yaml"
    path.write_text("views: 3\nview_rms_px: null\n")
    limits = read_limits(path)
    bad, _ = spoiled(solution, "view_rms_px")
    assert failed(judge(bad, limits, CLOCK_S)) == []
    assert limits.views == 3
    assert limits.axis_spread == GateLimits().axis_spread


@pytest.mark.parametrize("content", ["view: 3\n", "views: many\n", "views: [", "views: 3\nviews: 4\n"])
def test_wrong_limits_are_refused_with_the_file(tmp_path: Path, content: str) -> None:
    path = tmp_path / "gates.yaml"
    path.write_text(content)
    with raises("input-file", UsageError, path=str(path)):
        read_limits(path)
    with raises("input-file", UsageError):
        read_limits(tmp_path / "none.yaml")


def test_an_arm_whose_errors_are_assumed_is_a_warning_unless_the_integrator_says_more(
    solution: Solution,
) -> None:
    gates = judge(altered(solution, figures={"point": ASSUMED}), None, CLOCK_S)
    assert failed(gates) == []
    assert [gate.name for gate in gates if gate.remedy] == ["arm"]
    assert all(gate.narrow for gate in gates if gate.remedy)


def test_the_error_says_whether_the_arm_s_own_is_known_assumed_or_left_out(
    solved_real: SolvedRecording,
) -> None:
    made = solved_real.calibration

    def about(point: PointError | None) -> str:
        quality = msgspec.structs.replace(made.quality, point=point)
        return figures(msgspec.structs.replace(made, quality=quality))["error"].about

    assert len({about(POINT), about(ASSUMED), about(None)}) == 3


def test_the_pose_to_retake_is_numbered_as_on_the_screen(solution: Solution) -> None:
    """From 1, as `station retake` takes it."""
    bad = solution.evidence.views.used[3]
    residuals = tuple(
        ViewQuality(one.index, 9.0 if one.index == bad else one.rms_px) for one in solution.evidence.residuals
    )
    gates = judge(altered(solution, evidence={"residuals": residuals}), None, CLOCK_S)
    (gate,) = (gate for gate in gates if not gate.passed)
    assert (gate.name, gate.value, gate.unit) == ("view_rms_px", 9.0, "px")
    assert f"pose {bad + 1}" in gate.remedy
