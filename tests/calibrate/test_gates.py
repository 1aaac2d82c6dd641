"""Each gate closes for its own reason, and says so in words."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibrate.gates import Evidence, Gate, GateLimits, GatesError, judge, read_limits
from calibrate.pipeline import SolvedRecording
from calibrate.scale import ScaleCheck
from calibrate.solution import HoldoutScore, NoiseScales, Solution

GOOD = Evidence(ScaleCheck(1.0, 0.001, 0.025, "fits"), 0.6, 0.001)


@pytest.fixture
def solution(solved_real: SolvedRecording) -> Solution:
    """One that every gate lets through."""
    found = solved_real.solution
    holdout = HoldoutScore(0.0005, 0.001, np.array([0.0005]), np.array([0.001]), ((0, 1),), 12)
    certificate = replace(found.certificate, certified=True, distance_sigma=1.0)
    noise = NoiseScales(0.1, 0.0001, 0.0002)
    return replace(
        found,
        holdout=holdout,
        certificate=certificate,
        noise=noise,
        predicted_error_m=0.0005,
        working_distance_m=0.5,
        residual_px=dict.fromkeys(found.used, 0.2),
        observability=replace(found.observability, largest_angle_rad=1.2, axis_spread=0.6),
    )


def failed(gates: tuple[Gate, ...]) -> list[str]:
    return [gate.name for gate in gates if not gate.passed]


def test_a_good_solution_passes_every_gate(solution: Solution) -> None:
    gates = judge(solution, GOOD)
    assert failed(gates) == []
    assert [gate.name for gate in gates] == [
        "views", "rotation", "axes", "certificate", "agreement", "view residual", "hold-out",
        "predicted error", "lens coverage", "board scale", "clocks", "robot position", "robot orientation",
    ]  # fmt: skip


def spoiled(solution: Solution, name: str) -> tuple[Solution, Evidence]:
    seen, proof = solution.observability, solution.certificate
    assert solution.holdout is not None
    changed = {
        "views": replace(solution, used=solution.used[:5]),
        "rotation": replace(solution, observability=replace(seen, largest_angle_rad=0.2)),
        "axes": replace(solution, observability=replace(seen, axis_spread=0.01)),
        "certificate": replace(solution, certificate=replace(proof, certified=False)),
        "agreement": replace(solution, certificate=replace(proof, distance_sigma=40.0)),
        "view residual": replace(solution, residual_px={3: 9.0}),
        "hold-out": replace(solution, holdout=replace(solution.holdout, e_t_m=0.02)),
        "predicted error": replace(solution, predicted_error_m=float("nan")),
        "robot position": replace(solution, noise=NoiseScales(0.1, 0.01, 0.0)),
        "robot orientation": replace(solution, noise=NoiseScales(0.1, 0.0, 0.02)),
    }
    evidence = {
        "lens coverage": replace(GOOD, coverage=0.05),
        "board scale": replace(GOOD, scale=ScaleCheck(0.96, 0.001, 0.024, "24.00 ± 0.03 mm fit")),
        "clocks": replace(GOOD, clock_bound_s=0.05),
    }
    return changed.get(name, solution), evidence.get(name, GOOD)


@pytest.mark.parametrize(
    "name",
    [
        "views", "rotation", "axes", "certificate", "agreement", "view residual", "hold-out",
        "predicted error", "lens coverage", "board scale", "clocks", "robot position", "robot orientation",
    ],
)  # fmt: skip
def test_each_gate_closes_alone_and_says_why(solution: Solution, name: str) -> None:
    bad, evidence = spoiled(solution, name)
    gates = judge(bad, evidence)
    assert failed(gates) == [name]
    text = next(gate.text for gate in gates if gate.name == name)
    assert len(text) > 15


def test_the_sentences_carry_their_figures_in_the_units_that_people_read(solution: Solution) -> None:
    gates = {gate.name: gate for gate in judge(solution, GOOD)}
    said = {name: gate.text for name, gate in gates.items()}
    assert said["views"] == f"{len(solution.used)} views were used"
    assert said["rotation"] == "The largest turn between two views is 69°"
    assert said["agreement"] == "Certified optimum and final X are 1.0 sigmas apart"
    assert said["view residual"].endswith("fits to 0.20 px")
    assert said["hold-out"] == "Views that took no part are predicted to 0.50 mm"
    assert gates["hold-out"].limit == pytest.approx(0.01 * 0.5)
    assert said["predicted error"] == "A point 500 mm away is expected to be right to 0.50 mm (1σ)"
    assert said["lens coverage"] == "Corners were seen in 60 % of the picture"
    assert said["clocks"] == "Pictures and robot poses belong together to 1.0 ms"
    assert said["robot position"] == "The robot's positions scatter by 0.10 mm"
    assert said["robot orientation"] == "The robot's orientations scatter by 0.011°"


def test_a_scale_that_might_be_chance_does_not_close_the_gate(solution: Solution) -> None:
    uncertain = replace(GOOD, scale=ScaleCheck(0.96, 0.02, 0.024, "24.0 ± 0.5 mm fit"))
    assert failed(judge(solution, uncertain)) == []


@pytest.mark.parametrize(("sigmas", "closed"), [(4.9, False), (5.1, True), (float("nan"), True)])
def test_the_board_gate_closes_beyond_five_sigmas_and_for_what_is_no_number(
    solution: Solution, sigmas: float, closed: bool
) -> None:
    for sign in (-1, 1):
        off = replace(GOOD, scale=ScaleCheck(1 + sign * 0.004 * sigmas, 0.004, 0.024, "24.0 ± 0.1 mm fit"))
        assert (failed(judge(solution, off)) == ["board scale"]) == closed


def test_what_cannot_be_judged_is_left_out(solution: Solution) -> None:
    bare = replace(solution, noise=None, holdout=None, predicted_error_m=None)
    names = [gate.name for gate in judge(bare, Evidence())]
    assert names == ["views", "rotation", "axes", "certificate", "agreement", "view residual"]


def test_limits_come_from_a_file_and_null_switches_a_gate_off(solution: Solution, tmp_path: Path) -> None:
    path = tmp_path / "gates.yaml"
    path.write_text("views: 3\nview_rms_px: null\n")
    limits = read_limits(path)
    bad, _ = spoiled(solution, "view residual")
    assert failed(judge(bad, GOOD, limits)) == []
    assert limits.views == 3
    assert limits.rotation_deg == GateLimits().rotation_deg


@pytest.mark.parametrize("content", ["view: 3\n", "views: many\n", "views: [", "views: 3\nviews: 4\n"])
def test_wrong_limits_are_refused_with_the_file(tmp_path: Path, content: str) -> None:
    path = tmp_path / "gates.yaml"
    path.write_text(content)
    with pytest.raises(GatesError, match=r"gates\.yaml"):
        read_limits(path)
    with pytest.raises(GatesError, match=r"none\.yaml"):
        read_limits(tmp_path / "none.yaml")


def test_the_documented_defaults_are_those_in_force() -> None:
    text = (Path(__file__).parents[2] / "docs" / "calibration-file.md").read_text()
    table = text[text.index("## Gates") : text.index("Installing asks one gate more")]
    documented: dict[str, str] = {}
    for row in re.findall(r"^\| (`[^|]+) \| ([^|]+) \|", table, re.MULTILINE):
        documented |= zip(re.findall(r"`(\w+)`", row[0]), row[1].strip().split(", "), strict=True)
    defaults = msgspec.structs.asdict(GateLimits())
    assert documented == {name: f"{v}".lower() if v is True else f"{v:g}" for name, v in defaults.items()}


def test_the_pose_to_retake_is_numbered_as_on_the_screen(solution: Solution) -> None:
    """From 1, as `station retake` takes it."""
    bad = solution.used[3]
    residual_px = {**solution.residual_px, bad: 9.0}
    (gate,) = (
        g for g in judge(replace(solution, residual_px=residual_px), GOOD) if g.name == "view residual"
    )
    assert f"pose {bad + 1}, fits to 9.00 px" in gate.text and f"Retake pose {bad + 1}," in gate.text
