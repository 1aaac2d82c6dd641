"""A cell's camera over time: a jump is named, noise is not."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace
from scipy import stats

from calibrate.batch.page import trends_page
from calibrate.batch.storage import BatchResult
from calibrate.batch.trends import cells, trends_text
from calibrate.geometry import Array, Transform, perturb, pose, rotation_exp

SIGMA = np.array([0.1e-3] * 3 + [0.2e-3] * 3)
X = pose(rotation_exp([0.3, -2.6, 0.9]), [0.05, -0.08, 0.11])
DAY_NS = 86_400 * 10**9


def session(number: int, shift_mm: float = 0.0, camera: str = "MER 17", seed: int = 0) -> BatchResult:
    rng = np.random.default_rng([number, seed])
    moved = perturb(X, rng.normal(size=6) * SIGMA)
    return BatchResult(
        recording=f"r{number}.mcap",
        key=f"{camera}-{number}",
        solved=True,
        passed=True,
        session=f"session-{number}",
        robot="UR10 2020300001",
        camera=camera,
        recorded_wall_ns=1_700_000_000 * 10**9 + number * DAY_NS,
        mount="eye-in-hand",
        translation_m=tuple((moved[:3, 3] + [0.0, shift_mm * 1e-3, 0.0]).tolist()),
        rotation_xyzw=quaternion(moved),
        covariance=tuple(tuple(row) for row in np.diag(SIGMA**2).tolist()),
        sigma_mm=0.17,
        sigma_deg=0.02,
        views=25,
    )


def still(number: int, shift_mm: float = 0.0) -> BatchResult:
    """A session that found X exactly, or beside it in y."""
    place = tuple((X[:3, 3] + [0.0, shift_mm * 1e-3, 0.0]).tolist())
    return replace(session(number), translation_m=place, rotation_xyzw=quaternion(X))


def quaternion(matrix: Array) -> tuple[float, ...]:
    return tuple(Transform("flange", "camera", matrix).quaternion_xyzw.tolist())


def test_a_jump_is_named_with_its_sessions_and_nothing_else_is() -> None:
    results = [session(k, shift_mm=1.8 if k >= 3 else 0.0) for k in (5, 1, 3, 0, 2, 4)]
    results += [session(k, camera="MER 18") for k in range(6)]
    moved, quiet = cells(results)
    assert [s.session for s in moved.sessions] == [f"session-{k}" for k in range(6)]
    assert quiet.findings == []
    (finding,) = moved.findings
    assert (finding.earlier.session, finding.later.session) == ("session-2", "session-3")
    assert finding.distance_mm == pytest.approx(1.8, abs=0.8) and not finding.creep
    text = trends_text((moved, quiet))
    assert text.startswith(f"{moved.name}: {finding.text}") and "2023-11-16" in finding.text
    assert next(line for line in text.splitlines() if "MOVED" in line).split()[2] == "session-3"


def test_a_creep_that_no_step_shows_is_found_from_end_to_end() -> None:
    (cell,) = cells([session(k, shift_mm=0.3 * k) for k in range(8)])
    assert not any(move.real for move in cell.moves)
    (finding,) = cell.findings
    assert finding.creep and finding.earlier.session == "session-0"


def test_an_untouched_camera_raises_no_alarm_in_hundreds_of_comparisons() -> None:
    quiet = [cells([session(k, seed=seed) for k in range(5)])[0] for seed in range(100)]
    assert sum(bool(cell.findings) for cell in quiet) <= 1


def test_three_sessions_are_enough_to_see_a_creep() -> None:
    (cell,) = cells([still(k, shift_mm=0.55 * k) for k in range(3)])
    assert not any(move.real for move in cell.moves)
    assert len(cell.findings) == 1
    assert cells([still(k, shift_mm=0.55 * k) for k in range(2)])[0].findings == []


def test_a_move_is_measured_in_millimetres_degrees_and_sigmas_of_both() -> None:
    turned = replace(still(1), rotation_xyzw=quaternion(perturb(X, np.r_[0, 0, 0, 0.003, 0, 0.004])))
    (cell,) = cells([still(0), turned])
    (move,) = cell.moves
    assert move.distance_mm == pytest.approx(0, abs=1e-9)
    assert move.angle_deg == pytest.approx(np.degrees(0.005))
    assert move.sigmas == pytest.approx(0.005 / 0.2e-3 / np.sqrt(2))
    (cell,) = cells([still(0), still(1, shift_mm=0.7)])
    assert cell.moves[0].distance_mm == pytest.approx(0.7)
    assert cell.moves[0].sigmas == pytest.approx(0.7 / 0.1 / np.sqrt(2))
    assert not cell.moves[0].real
    assert cells([still(0), still(1, shift_mm=0.9)])[0].moves[0].real


def test_the_limit_is_one_false_alarm_in_ten_thousand_for_the_session_of_fewer_views() -> None:
    """6 F(6, 3n - 6): what few views say of their own noise is worth less."""
    few = replace(still(0), views=8)
    limit_mm = np.sqrt(2 * 6 * stats.f.ppf(1 - 1e-4, 6, 18)) * 0.1
    for factor in (0.99, 1.01):
        later = still(1, shift_mm=factor * limit_mm)
        for results in ([few, later], [replace(few, views=25), replace(later, views=8)]):
            assert cells(results)[0].moves[0].real == (factor > 1)
    assert cells([still(0), still(1)])[0].moves[0].sigmas == 0.0


@pytest.mark.parametrize("part", ["robot", "camera", "mount"])
def test_cells_are_told_apart_by_robot_camera_and_mount(part: str) -> None:
    """Half a metre between two robots' cameras is no move of either."""
    other = replace(still(1, shift_mm=500.0), **{part: "eye-to-hand" if part == "mount" else "another"})
    first, second = cells([still(0), other])
    assert (len(first.sessions), len(second.sessions)) == (1, 1)
    assert {first.moves, second.moves} == {()}


def test_recordings_that_were_not_solved_are_of_no_cell() -> None:
    (cell,) = cells([still(0), replace(still(1, shift_mm=9.0), solved=False)])
    assert [s.session for s in cell.sessions] == ["session-0"]


def test_a_session_that_failed_a_gate_says_so_in_its_row() -> None:
    found = cells([still(0), replace(still(1), failed_gates=["views", "axis_spread"])])
    assert "failed: views, axis_spread" in trends_text(found)


def test_one_unnamed_robot_does_not_silence_the_others() -> None:
    found = cells([still(0), still(1), replace(still(2), robot="", camera="x")])
    assert "No camera moved by more than chance explains." in trends_text(found)


def test_the_page_is_whole_and_asks_the_network_for_nothing() -> None:
    results = [session(k, shift_mm=1.8 if k >= 3 else 0.0) for k in range(6)]
    results.append(BatchResult("<broken>.mcap", "b", False, error="cut & short"))
    page = trends_page(results, cells(results))
    assert "1 of 1 cameras moved" in page and page.count("<svg") == 1
    assert "&lt;broken&gt;.mcap" in page and "cut &amp; short" in page
    for word in ('src="http', 'href="http', "@import", "<script"):
        assert word not in page
    assert page == trends_page(results, cells(results))


@pytest.mark.parametrize("count", [0, 1])
def test_few_results_are_no_trouble(count: int) -> None:
    results = [session(k) for k in range(count)]
    assert "No camera moved" in trends_text(cells(results))
    assert "No camera moved" in trends_page(results, cells(results))


def test_recordings_that_name_no_robot_are_listed_but_not_taken_for_one_cell() -> None:
    """Imports of six strangers' data sets: no camera of anybody moved by half a metre."""
    results = [replace(session(k, shift_mm=500.0 * k), robot="unknown", camera="unknown") for k in range(4)]
    found = cells(results)
    assert [cell.findings for cell in found] == [[]]
    text, page = trends_text(found), trends_page(results, found)
    for shown in (text, page):
        assert "MOVED" not in shown and "do not say of which robot" in shown
        assert "No camera was followed" in shown and "No camera moved" not in shown
        assert all(f"session-{k}" in shown for k in range(4))
    assert "<svg" not in page


def test_a_camera_that_moves_all_the_time_does_not_hide_the_others() -> None:
    restless = [session(k, shift_mm=1.8 * k) for k in range(8)]
    page = trends_page(restless, cells(restless))
    verdict = page[page.index("verdict") : page.index("<h2>")]
    assert verdict.count("Camera moved") == 3
    assert "and 4 more" in verdict
