"""The solver's door: bad input is named, results are reproducible and complete, for profiles and mounts."""

import time
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from benchmarks.scene import random_rotation
from calibrate.errors import (
    BadViewsError,
    CalibrationError,
    DegenerateMotionError,
    TooFewViewsError,
    UsageError,
)
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.solve import SolveOptions, solve_views
from calibrate.views.corners import NO_CORNERS
from calibrate.views.view_set import ViewSet
from recordings.geometry import Array, inverse, perturb, pose, rotation_exp
from tests.calibrate.cells import LOW, MID, MOUNTS, QUICK, changed, error_mm_deg, exact_motions, make_cell
from tests.codes import raises

ROOT = Path(__file__).parents[3]
BOTH = pytest.mark.parametrize("profile", ["robust", "paper"])


def poses_only(H: Array, C: Array, mount="eye-in-hand") -> ViewSet:
    return ViewSet.from_poses(mount, H if mount == "eye-in-hand" else inverse(H), C)


def in_front(H: Array, X: Array, rng: np.random.Generator) -> ViewSet:
    """Exact views of a camera that sees the board in front of it, from the mount's poses H."""
    C = inverse(X) @ inverse(H) @ pose(random_rotation(rng), rng.normal(size=3))
    C[:, 2, 3] = np.abs(C[:, 2, 3]) + 0.1
    return poses_only(H, C)


@MOUNTS
def test_the_blogs_equations_hold_through_the_same_code_for_both_mounts(mount):
    X = pose(rotation_exp([0, np.radians(-15), 0]), [0.1, 0, 0])
    cell = make_cell(np.random.default_rng(0), 12, LOW, mount=mount, X=X)
    solution = solve_views(cell.views)
    assert error_mm_deg(solution.matrix, X)[0] < 0.3
    assert error_mm_deg(solution.matrix, X)[1] < 0.05
    expected = ("flange", "camera") if mount == "eye-in-hand" else ("base", "camera")
    assert (solution.fit.parent_from_child.parent, solution.fit.parent_from_child.child) == expected
    assert error_mm_deg(solution.fit.board_place.matrix, cell.Y)[0] < 1.5


@pytest.mark.parametrize("seed", range(3))
def test_any_mount_is_found(seed):
    rng = np.random.default_rng(seed)
    X = pose(random_rotation(rng), 0.5 * rng.normal(size=3))
    solution = solve_views(make_cell(rng, 15, LOW, X=X).views, QUICK)
    assert solution.judgement.figures.certificate.certified
    assert error_mm_deg(solution.matrix, X)[0] < 0.6


def test_the_papers_split_and_score():
    cell = make_cell(np.random.default_rng(0), 25, LOW)
    solution = solve_views(cell.views, SolveOptions(profile="paper"))
    score = solution.judgement.figures.holdout
    assert score.pairs == [(n, n + 1) for n in range(18, 24)]
    assert score.fitted_views == 19
    A, B = (
        inverse(M[1:]) @ M[:-1] for M in (cell.views.base_from_flange, inverse(cell.views.camera_from_board))
    )
    X = solution.matrix
    for n, (e_t, e_R) in enumerate(zip(score.samples_e_t_m, score.samples_e_R, strict=True), start=18):
        estimate = X @ B[n] @ np.linalg.inv(X)
        assert e_t == pytest.approx(np.linalg.norm(estimate[:3, 3] - A[n, :3, 3]))
        assert e_R == pytest.approx(np.linalg.norm(estimate[:3, :3] - A[n, :3, :3], 2))
    assert score.e_t_m == pytest.approx(np.mean(score.samples_e_t_m))


def test_the_paper_profile_warns_on_the_box():
    cell = make_cell(np.random.default_rng(0), 25, LOW, X=pose(rotation_exp([0, 0, 3.1]), [0, 0, 0.1]))
    solution = solve_views(cell.views, SolveOptions(profile="paper"))
    assert solution.judgement.on_box
    assert "on-box" in {remark.code for remark in solution.judgement.warnings}
    assert not solution.judgement.figures.certificate.certified


@BOTH
def test_too_few_views(profile):
    cell = make_cell(np.random.default_rng(0), 3, LOW)
    for count in (1, 2, 3):
        with pytest.raises(TooFewViewsError):
            solve_views(cell.views.select(list(range(count))), SolveOptions(profile=profile))


@BOTH
def test_no_rotation_no_result(profile):
    rng = np.random.default_rng(0)
    X = pose(random_rotation(rng), [0.1, 0, 0])
    H = pose(np.broadcast_to(random_rotation(rng), (10, 3, 3)), rng.normal(size=(10, 3)))
    with raises("rotation-range", DegenerateMotionError):
        solve_views(in_front(H, X, rng), SolveOptions(profile=profile))


@BOTH
def test_one_axis_is_refused_and_named(profile):
    rng = np.random.default_rng(1)
    X = pose(random_rotation(rng), [0.1, 0, 0])
    R = rotation_exp(np.linspace(0, 1.5, 10)[:, None] * np.array([0, 0, 1.0]))
    H = pose(R, rng.normal(size=(10, 3)) * 0.2)
    C = inverse(X) @ inverse(H) @ pose(rotation_exp([0, 0, 0.3]), [0, 0, 1.0])
    C[:, 2, 3] = np.abs(C[:, 2, 3])
    with pytest.raises((DegenerateMotionError, BadViewsError)) as refused:
        solve_views(poses_only(H, C), SolveOptions(profile=profile))
    assert refused.value.code in {"one-axis", "poses-disagree"}


def test_a_wrong_pose_is_no_second_axis():
    """About one axis with the error of one robot pose X has a "best" answer, far outside its own region."""
    rng = np.random.default_rng(0)
    cell = make_cell(rng, 15, LOW)
    turns = rotation_exp(np.linspace(-0.4, 0.4, 15)[:, None] * np.array([0.0, 1.0, 0.0]))
    C = pose(turns @ cell.C[0, :3, :3], cell.C[0, :3, 3] + rng.normal(size=(15, 3)) * 0.02)
    H = perturb(cell.Y @ inverse(C) @ inverse(cell.X), rng.normal(size=(15, 6)) * 1e-4)
    H[4] = perturb(H[4], np.array([0.03, 0.0, 0.02, 0.1, 0.2, 0.1]))
    with pytest.raises((DegenerateMotionError, BadViewsError)) as refused:
        solve_views(poses_only(H, C), SolveOptions())
    assert refused.value.code in {"one-axis", "poses-disagree"}


def test_exact_poses_say_nothing_of_arm_and_bracket():
    cell = make_cell(np.random.default_rng(0), 15, MeasurementNoise(0.0, 0.0, 0.0), with_pnp=False)
    solution = solve_views(poses_only(cell.views.base_from_flange, cell.C))
    assert {remark.code for remark in solution.judgement.warnings} <= {"no-corners"}
    assert error_mm_deg(solution.matrix, cell.X)[0] < 1e-3


def test_corners_in_a_line_are_refused():
    cell = make_cell(np.random.default_rng(0), 6, LOW)
    row = {"corners": lambda view: view.corners.part(slice(6))}
    with raises("corners-in-line", BadViewsError):
        solve_views(changed(cell.views, [2], **row))


@pytest.mark.parametrize(
    "wrong",
    [
        {"robot_accuracy_m": float("nan")},
        {"robot_accuracy_rad": -1.0},
        {"working_distance_m": -0.5},
        {"lens_sigma": (1.0, 1.0, 0.0)},
    ],
)
def test_numbers_that_measure_nothing_are_refused(wrong):
    with raises("not-positive", UsageError):
        SolveOptions(**wrong)


def test_identical_views_are_refused():
    views = make_cell(np.random.default_rng(0), 1, LOW).views
    with raises("poses-identical", CalibrationError):
        solve_views(replace(views, views=views.views * 8))


@pytest.mark.parametrize("with_pixels", [True, False])
def test_a_view_counts_once(with_pixels):
    """Ten views given twice would claim an error smaller by the root of two."""
    views = make_cell(np.random.default_rng(0), 10, LOW).views
    if not with_pixels:
        bare = (replace(v, corners=NO_CORNERS) for v in views)
        views = replace(views, views=tuple(bare))
    with pytest.raises(BadViewsError) as refused:
        solve_views(views.select([*range(10), 0]))
    assert (refused.value.code, refused.value.values["view"], refused.value.values["other"]) == (
        "view-twice",
        1,
        1,
    )


def broken(field, value):
    cell = make_cell(np.random.default_rng(0), 8, LOW)
    views = list(cell.views.views)
    views[3] = replace(views[3], **{field: value(getattr(views[3], field))})
    return replace(cell.views, views=tuple(views))


def mirrored(C):
    return C @ np.diag([1.0, 1.0, -1.0, 1.0])


@BOTH
@pytest.mark.parametrize(
    ("field", "value", "code"),
    [
        ("base_from_flange", lambda F: F * np.nan, "robot-pose"),
        ("base_from_flange", lambda F: F * 2, "robot-pose"),
        ("camera_from_board", lambda C: None, "no-board-pose"),
        ("camera_from_board", mirrored, "board-pose"),
        ("camera_from_board", lambda C: C @ pose(np.eye(3), [0, 0, -9.0]), "board-pose"),
        ("corners", lambda seen: replace(seen, pixels=seen.pixels * np.nan), "corners"),
        ("corners", lambda seen: replace(seen, pixels=seen.pixels[:-1]), "corners"),
        ("corners", lambda seen: seen.part(slice(3)), "corners"),
    ],
)
def test_a_broken_view_is_named(profile, field, value, code):
    with pytest.raises(BadViewsError) as refused:
        solve_views(broken(field, value), SolveOptions(profile=profile))
    assert (refused.value.code, refused.value.values["view"]) == (code, 4)


@pytest.mark.parametrize("entry", [0.0, np.nan, -5.0])
def test_a_singular_camera_matrix_is_refused(entry):
    cell = make_cell(np.random.default_rng(0), 8, LOW)
    (_, *rest), second, third = cell.camera.matrix
    camera = msgspec.structs.replace(cell.camera, matrix=((entry, *rest), second, third))
    with raises("camera-matrix", BadViewsError):
        solve_views(replace(cell.views, camera=camera))


def test_thousands_of_views_end_in_bounded_time():
    rng = np.random.default_rng(0)
    X = pose(random_rotation(rng), 0.1 * rng.normal(size=3))
    H, C = exact_motions(rng, 3_000, X)
    keep = C[:, 2, 3] > 0.05
    H = perturb(H, 1e-4 * rng.normal(size=(3_000, 6)))
    start = time.process_time()
    solution = solve_views(poses_only(H[keep], C[keep]), QUICK)
    assert time.process_time() - start < 20
    assert error_mm_deg(solution.matrix, X)[0] < 0.05
    with raises("too-many-views", BadViewsError):
        solve_views(poses_only(np.repeat(H[:5], 5000, axis=0), np.repeat(C[:5], 5000, axis=0)))


def test_a_covariance_is_positive_and_is_in_the_error_at_work():
    cell = make_cell(np.random.default_rng(0), 15, MID)
    solution = solve_views(cell.views, SolveOptions(working_distance_m=0.5))
    assert (np.linalg.eigvalsh(solution.covariance) > 0).all()
    assert solution.judgement.figures.working_distance_m == 0.5
    rng = np.random.default_rng(1)
    deltas = rng.multivariate_normal(np.zeros(6), solution.covariance, size=4000)
    point = np.array([0, 0, 0.5, 1.0])
    moved = (perturb(solution.matrix, deltas) @ point)[:, :3] - (solution.matrix @ point)[:3]
    rms_mm = 1e3 * np.sqrt((moved**2).sum(axis=1).mean())
    point = solution.judgement.figures.point
    assert solution.judgement.figures.predicted_error_mm == point.error_mm
    assert np.hypot(point.from_x_mm, point.from_board_lens_mm) < 1.05 * rms_mm < 1.05 * point.error_mm
    assert solution.judgement.observability.weakest_text
    assert 0 < solution.judgement.observability.axis_spread <= 1
