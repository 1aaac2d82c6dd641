"""What a user may rely on from the final estimate: it is near the bound, and its sigma is true."""

import numpy as np
import pytest

from benchmarks.scene import Noise
from calibrate.geometry import difference
from calibrate.solve import SolveOptions, solve_views
from tests.calibrate.cells import LOW, MID, error_mm_deg, make_cell

QUICK = SolveOptions(holdout=False)


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize("same_pictures", [False, True])
def test_the_stated_sigma_is_the_error_that_is_made(mount, same_pictures):
    """20 cells: mean of δᵀC⁻¹δ is 6 for a true covariance (here within about 3 of its own sigmas)."""
    squares = []
    for seed in range(20):
        cell = make_cell(np.random.default_rng(seed), 20, MID, mount=mount, refit_camera=same_pictures)
        options = SolveOptions(holdout=False, intrinsics_from_same_pictures=same_pictures)
        solution = solve_views(cell.views, options)
        delta = difference(solution.matrix, cell.X)
        squares.append(delta @ np.linalg.solve(solution.covariance, delta))
    assert 3.8 < np.mean(squares) < 9.0
    assert np.mean(np.array(squares) < solution.confidence_threshold) >= 0.8


def test_it_beats_the_certified_pair_solution_clearly():
    ours, pairs = [], []
    for seed in range(10):
        cell = make_cell(np.random.default_rng(seed), 25, LOW)
        solution = solve_views(cell.views, QUICK)
        ours.append(error_mm_deg(solution.matrix, cell.X)[0])
        from calibrate.pairs import all_pairs
        from calibrate.robust import solve_global

        start = solve_global(all_pairs(cell.views.base_from_flange, cell.views.camera_from_board), 0)
        pairs.append(error_mm_deg(start.X, cell.X)[0])
    assert np.mean(ours) < 0.6 * np.mean(pairs)


def test_one_bad_corner_hardly_moves_it():
    from dataclasses import replace

    cell = make_cell(np.random.default_rng(3), 15, LOW)
    clean = solve_views(cell.views, QUICK)
    views = list(cell.views.views)
    for i, k, shift in ((2, 5, 30.0), (7, 0, -80.0), (9, 41, 3.0)):
        pixels = views[i].pixels.copy()
        pixels[k] += shift
        views[i] = replace(views[i], pixels=pixels)
    spoilt = solve_views(replace(cell.views, views=tuple(views)), QUICK)
    assert spoilt.rejected == ()
    delta = difference(spoilt.matrix, clean.matrix)
    assert delta @ np.linalg.solve(clean.covariance, delta) < 1.0


@pytest.mark.parametrize(
    ("noise", "expected"),
    [
        (Noise(0.6, 1e-5, 1e-5), "corners"),
        (Noise(0.02, 1e-3, 1e-5), "robot translation"),
        (Noise(0.02, 1e-5, 2e-3), "robot rotation"),
    ],
)
def test_the_dominant_source_is_named(noise, expected):
    cell = make_cell(np.random.default_rng(0), 25, noise)
    budget = solve_views(cell.views, QUICK).budget
    assert budget.dominant == expected
    assert sum(vars(budget).values()) == pytest.approx(1.0, abs=1e-6)


def test_intrinsics_from_the_same_pictures_are_part_of_the_budget():
    cell = make_cell(np.random.default_rng(0), 15, LOW, refit_camera=True)
    held = solve_views(cell.views, QUICK)
    free = solve_views(cell.views, SolveOptions(holdout=False, intrinsics_from_same_pictures=True))
    assert held.budget.intrinsics == 0.0
    assert free.budget.intrinsics > 0.2
    assert free.sigma_rotation_rad > 1.3 * held.sigma_rotation_rad
    assert sum(vars(free.budget).values()) == pytest.approx(1.0, abs=1e-6)


def test_a_lens_that_does_not_fit_the_pictures_is_told():
    import msgspec

    from benchmarks.scene import view_set

    cell = make_cell(np.random.default_rng(0), 20, LOW)
    assert solve_views(cell.views, QUICK).warnings == ()
    (fx, s, cx), second, third = cell.camera.matrix
    wrong = msgspec.structs.replace(cell.camera, matrix=((fx, s, cx + 8), second, third))
    pixels = np.array([view.pixels for view in cell.views])
    board = cell.views.views[0].board_points
    views = view_set(cell.views.base_from_flange, board, pixels, wrong, "eye-in-hand")
    assert any("given intrinsics" in text for text in solve_views(views, QUICK).warnings)


def test_what_the_pictures_leave_open_stays_as_it_is():
    from dataclasses import replace

    cell = make_cell(np.random.default_rng(5), 20, MID, refit_camera=True)
    options = SolveOptions(holdout=False, intrinsics_from_same_pictures=True)
    free = solve_views(cell.views, options)
    held = solve_views(replace(cell.views, held_intrinsics=("k2", "k3")), options)
    before, after = cell.views.camera.distortion, held.camera.distortion
    assert (after[1], after[4]) == pytest.approx((before[1], before[4]), abs=1e-12)
    assert after[0] != before[0]
    assert held.sigma_translation_m <= free.sigma_translation_m
    assert held.noise.corner_px == pytest.approx(free.noise.corner_px, rel=0.02)
