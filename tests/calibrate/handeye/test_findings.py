"""What was stated of lens and board is judged by what believing it does to X."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from calibrate.handeye.priors import BoardTolerance
from calibrate.handeye.solution import Reading
from calibrate.handeye.solve import solve_views
from calibrate.pipeline.gates import judge
from tests.calibrate.cells import (
    LENSES,
    LOW,
    MID,
    MOUNTS,
    QUICK,
    error_mm_deg,
    make_cell,
    real_cell,
    seen_through,
    with_focal,
)

MEASURED = replace(QUICK, board=BoardTolerance(5e-4, 1e-4))


def closed(solution):
    return {gate.name for gate in judge(solution) if not gate.passed}


@MOUNTS
def test_true_statements_pull_X_nowhere_unexplained(mount):
    seed = int(mount == "eye-to-hand")
    lens = list(LENSES.values())[seed]
    cell = real_cell(np.random.default_rng(seed), 20, (MID, LOW)[seed], mount=mount, camera=lens)
    for options in (QUICK, MEASURED):
        solution = solve_views(cell.views, options)
        assert solution.judgement.lens_finding.sigmas < 4 and solution.judgement.board_finding.sigmas < 4
        assert (
            solution.judgement.lens_finding.unexplained_m
            == solution.judgement.board_finding.unexplained_m
            == 0
        )
        assert closed(solution) == set()


@pytest.mark.parametrize(("mount", "factor"), [("eye-in-hand", 0.95), ("eye-to-hand", 1.05)])
def test_a_lens_that_is_far_off_closes_its_gate(mount, factor):
    cell = make_cell(np.random.default_rng(2), 20, LOW, mount=mount)
    solution = solve_views(seen_through(cell.views, with_focal(cell.camera, factor)), QUICK)
    assert solution.judgement.lens_finding.sigmas > 4
    assert "lens_pull" in closed(solution)


def test_a_lens_that_is_stated_too_surely_closes_its_gate():
    """Half a percent off, said to be right to a hundredth of a percent."""
    cell = make_cell(np.random.default_rng(2), 25, LOW)
    views = seen_through(cell.views, with_focal(cell.camera, 1.005))
    sure = solve_views(views, replace(QUICK, lens_sigma=(0.15, 0.15, 0.5, 0.5, 1e-3, 1e-3, 1e-5, 1e-5, 1e-3)))
    assert sure.judgement.lens_finding.sigmas > 8
    assert sure.judgement.lens_finding.unexplained_m > sure.judgement.lens_finding.error_m
    assert "lens_pull" in closed(sure)
    assert closed(solve_views(views, QUICK)) == set()


def test_a_board_that_was_measured_wrongly_closes_its_gate():
    cell = real_cell(
        np.random.default_rng(7), 25, LOW, mount="eye-to-hand", shape=(0.01, 0.01, 2e-3, 2e-3, 0)
    )
    measured = solve_views(cell.views, MEASURED)
    assert measured.judgement.board_finding.sigmas > 8
    assert "board_pull" in closed(measured)
    assert measured.judgement.session.reading is Reading.SQUARE_SIZE
    usual = solve_views(cell.views, QUICK)
    assert usual.judgement.board_finding.unexplained_m < 5e-5 * usual.judgement.figures.predicted_error_mm
    assert "board_pull" not in closed(usual)
    # What the statement does to X: who takes it back finds it about that far away.
    apart_mm = error_mm_deg(measured.matrix, usual.matrix)[0]
    assert 0.2 < 1e3 * measured.judgement.board_finding.pull_m / apart_mm < 5


@pytest.mark.parametrize("true_scale", [0.01, 0.05])
def test_a_board_that_is_believed_exactly_is_contradicted_too(true_scale):
    """A percent of size makes X wrong by millimetres; saying "exact" must not make that unseen."""
    cell = real_cell(np.random.default_rng(7), 25, LOW, shape=(true_scale, 0, 0, 0, 0))
    exact = solve_views(cell.views, replace(QUICK, board=BoardTolerance(1e-5, 2e-5)))
    assert exact.judgement.session.reading is Reading.SQUARE_SIZE and "session" in closed(exact)


def test_a_lens_found_from_the_same_pictures_was_never_stated():
    cell = make_cell(np.random.default_rng(2), 15, LOW, refit_camera=True)
    solution = solve_views(cell.views, replace(QUICK, intrinsics_from_same_pictures=True))
    assert solution.judgement.lens_finding is None
    assert "lens_pull" not in {gate.name for gate in judge(solution)}


def test_a_principal_point_that_is_off_is_found():
    cell = make_cell(np.random.default_rng(0), 25, LOW)
    (fx, s, cx), second, third = cell.camera.matrix
    wrong = msgspec.structs.replace(cell.camera, matrix=((fx, s, cx + 3), second, third))
    solution = solve_views(seen_through(cell.views, wrong), QUICK)
    assert abs(solution.fit.camera.matrix[0][2] - cx) < 4 * np.sqrt(solution.fit.lens_covariance[2, 2])
    assert closed(solution) == set()
