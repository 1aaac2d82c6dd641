"""Every published method on the same views: all there, right on clean data, each in its known weakness."""

import numpy as np
import pytest

from benchmarks.scene import random_rotation
from calibrate.handeye.axxb.objective import build_objective
from calibrate.handeye.axxb.pairs import all_pairs, consecutive_pairs
from calibrate.handeye.axxb.peer_methods import linear_system, orthonormalised, zhao_minimax
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.peers import compare_all, reprojection_px
from calibrate.handeye.solve import SolveOptions, solve_views
from calibrate.views.corners import NO_CORNERS
from recordings.geometry import inverse, is_rigid, pose, rotation_exp
from tests.calibrate.cells import LOW, MID, MOUNTS, error_mm_deg, make_cell

NAMES = [
    "Tsai-Lenz", "Park-Martin", "Horaud", "Andreff", "Daniilidis", "Shah", "Li", "Zhao CO", "Zhao CO + SVD",
    "Zhi-Schwertfeger", "Strobl-Hirzinger", "Heller, certified", "reprojection only", "DE, paper", "ours",
]  # fmt: skip


@MOUNTS
def test_all_methods_agree_on_nearly_clean_views(mount):
    cell = make_cell(np.random.default_rng(0), 14, MeasurementNoise(1e-3, 1e-7, 1e-7), mount=mount)
    rows = compare_all(cell.views)
    assert [row.name for row in rows] == NAMES
    for row in rows:
        assert row.note == "" or row.name in ("ours", "Zhao CO")
        miss_mm, miss_deg = error_mm_deg(orthonormalised(row.matrix), cell.X)
        slack = 40 if row.name == "DE, paper" else 1  # its budget ends before the minimum
        assert miss_mm < 0.1 * slack, row.name
        assert miss_deg < 0.01 * slack, row.name


def test_columns_are_filled_and_ours_is_the_reference():
    cell = make_cell(np.random.default_rng(1), 14, MID)
    rows = {row.name: row for row in compare_all(cell.views)}
    ours = rows["ours"]
    assert ours.distance_sigma == pytest.approx(0.0, abs=1e-6)
    for row in rows.values():
        assert row.e_t_m > 0
        assert row.e_R > 0
        assert row.time_ms > 0
        if row.rigid:
            assert row.board_spread_m > 0
            assert row.reprojection_px > 0
    assert not rows["Zhao CO"].rigid
    assert "not a rigid" in rows["Zhao CO"].note
    assert rows["reprojection only"].reprojection_px == min(
        r.reprojection_px for r in rows.values() if r.rigid
    )


def test_the_papers_row_says_when_its_answer_lies_on_the_box():
    beyond = pose(rotation_exp([0.1, 0.2, 0.0]), [1.25, 0.0, 0.6])
    cell = make_cell(np.random.default_rng(1), 12, MID, mount="eye-to-hand", X=beyond)
    rows = {row.name: row for row in compare_all(cell.views)}
    assert rows["DE, paper"].on_box == ("translation x",)
    assert all(row.on_box == () for name, row in rows.items() if name != "DE, paper")
    assert solve_views(cell.views, SolveOptions(profile="paper")).judgement.on_box == ("translation x",)


def test_the_papers_gap_is_that_of_the_X_returned():
    cell = make_cell(np.random.default_rng(1), 25, MID)
    solved = solve_views(cell.views, SolveOptions(profile="paper"))
    fitted = consecutive_pairs(cell.views.base_from_flange, cell.views.camera_from_board).select(slice(0, 18))
    value = build_objective(fitted, "log").value(solved.matrix)
    proof = solved.judgement.figures.certificate
    assert proof.objective == pytest.approx(value, rel=1e-9)
    assert proof.relative_gap == pytest.approx((value - proof.lower_bound) / max(value, proof.floor))


def test_the_minimax_solution_has_the_smallest_largest_residual():
    cell = make_cell(np.random.default_rng(2), 10, MID)
    pairs = all_pairs(cell.views.base_from_flange, cell.views.camera_from_board)
    M, d = linear_system(pairs)

    def largest(X):
        x = np.append(X[:3, :3].ravel(), X[:3, 3])
        return np.linalg.norm(M @ x - d, axis=1).max()

    best = zhao_minimax(pairs)
    assert largest(best) < largest(cell.X)
    rng = np.random.default_rng(0)
    for _ in range(100):
        other = best.copy()
        other[:3] += 1e-4 * rng.normal(size=(3, 4))
        assert largest(best) <= largest(other) * (1 + 1e-6)


def test_reprojection_at_the_truth_is_the_corner_noise():
    cell = make_cell(np.random.default_rng(4), 20, MeasurementNoise(0.3, 0.0, 0.0))
    assert reprojection_px(cell.views, cell.X) == pytest.approx(0.3 * np.sqrt(2), rel=0.05)
    wrong = pose(random_rotation(np.random.default_rng(0)), [0, 0, 0])
    assert reprojection_px(cell.views, wrong) > 50


def test_a_method_that_fails_is_a_row_not_a_crash():
    from dataclasses import replace

    cell = make_cell(np.random.default_rng(5), 12, LOW)
    views = tuple(replace(view, corners=NO_CORNERS) for view in cell.views)
    rows = {row.name: row for row in compare_all(replace(cell.views, views=views))}
    assert rows["reprojection only"].matrix is None
    assert rows["ours"].reprojection_px is None
    assert is_rigid(inverse(rows["ours"].matrix))
