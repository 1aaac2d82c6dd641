"""The check notices what it promises to, and cries wolf no more often than it says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy import stats

from calibrate.boards.model import board_points
from calibrate.check.drift import POWER, DriftCheck, check_drift, known_cell, moved_point, powers
from calibrate.check.history import CheckEntry, append_check, read_checks
from calibrate.check.trend import entry_of, find_trend
from calibrate.cli.drift_check import check_text
from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.files.calibration import read_calibration, write_calibration
from calibrate.handeye.cell_state import CellState, Quadratic
from calibrate.handeye.noise_scales import Scales
from calibrate.handeye.posterior import KnownCell
from calibrate.handeye.priors import BoardTolerance
from calibrate.handeye.solve import solve_views
from calibrate.lens.pnp import solve_pnp
from calibrate.pipeline.job import SolvedRecording
from calibrate.views.corners import Corners
from calibrate.views.projection import intrinsics_vector, project_at, with_intrinsics_vector
from calibrate.views.view_set import BoardView, ViewSet, extent_of
from recordings.geometry import Array, inverse, perturb, pose, rotation_exp
from recordings.schema.messages import BoardSpec, CameraModel, Mount
from tests.calibrate.cells import MOUNTS, QUICK, changed
from tests.calibrate.chains import arm_cell, later_views
from tests.calibrate.sessions import PAPER_BOARD, X_TRUE, looking
from tests.codes import raises

CAMERA = CameraModel(1280, 1024, ((1667.0, 0, 639.5), (0, 1667.0, 511.5), (0, 0, 1)), (0.0,) * 5)
POINTS = board_points(PAPER_BOARD)
BOARD = pose(rotation_exp([np.pi - 0.2, 0.1, 0.4]), [0.6, 0.1, 0.0])
SIGMA = np.r_[
    np.full(3, 3e-5), np.full(3, 6e-5), np.full(4, 0.1), np.full(5, 1e-4), np.full(2, 2e-4), np.full(3, 1e-5)
]
"""1σ of X, of the lens, and of the board's shape."""
ROBOT_M, ROBOT_RAD, CORNER_PX = 5e-5, 9e-5, 0.1


def installed(wide: float = 1.0, noise: float = 1.0, X: Array = X_TRUE) -> KnownCell:
    state = CellState(X, np.eye(4), np.zeros((0, 4, 4)), CAMERA, np.zeros(5), np.zeros(0))
    corner_px, shares = noise * CORNER_PX, np.array([0.985, 0.005, 0.005, 0.005])
    scales = Scales(noise * np.array([ROBOT_M, ROBOT_RAD]), corner_px, corner_px, corner_px, shares)
    return KnownCell(state, np.diag(wide * SIGMA) ** 2, scales, 69.0, extent_of(POINTS), None, None)


def few_views(
    rng: np.random.Generator, known: KnownCell, shift: Array, count: int = 5, mount: Mount = "eye-in-hand"
) -> ViewSet:
    """New views of a cell whose truth is drawn from what is known, and whose camera has shifted since."""
    error = rng.normal(size=len(known.covariance)) * np.sqrt(np.diag(known.covariance))
    X = perturb(perturb(known.mean.X, error[:6]), shift)
    camera = with_intrinsics_vector(CAMERA, intrinsics_vector(CAMERA) + error[6:15])
    s, a, *_ = error[15:]
    points = POINTS * [1 + s + a / 2, 1 + s - a / 2, 1.0]
    found = []
    for k in range(count):
        seen = looking(PAPER_BOARD, rng, (0.25, 0.6), 0.45, 1.2)
        flange = BOARD @ inverse(X @ seen) if mount == "eye-in-hand" else X @ seen @ inverse(BOARD)
        wrong = np.r_[rng.normal(size=3) * ROBOT_M, rng.normal(size=3) * ROBOT_RAD]
        pixels = project_at(camera, seen, points) + rng.normal(size=(42, 2)) * CORNER_PX
        found.append(BoardView(k, str(k), perturb(flange, wrong), Corners(POINTS, pixels)))
    return solve_pnp(ViewSet(mount, tuple(found), known.mean.camera))


def checks(
    count: int, shift_m: float, shift_rad: float, seed: int, mount: Mount = "eye-in-hand"
) -> list[DriftCheck]:
    """Checks after shifts in random directions."""
    rng, known, found = np.random.default_rng(seed), installed(), []
    for _ in range(count):
        way = rng.normal(size=(2, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        shift = np.r_[way[0] * shift_m, way[1] * shift_rad]
        found.append(check_drift(few_views(rng, known, shift, mount=mount), known))
    return found


@cache
def quiet_check() -> DriftCheck:
    return checks(1, 0, 0, 5)[0]


@MOUNTS
def test_false_alarms_and_detections(mount: Mount) -> None:
    """Few trials; `python -m benchmarks drift` has more. Limits allow for the chance of so few."""
    quiet = checks(24, 0, 0, 1, mount)
    assert sum(not c.passed for c in quiet) <= stats.binom.ppf(0.999, 24, 0.05)
    assert np.mean([c.disagreement for c in quiet]) == pytest.approx(1.0, abs=0.3)
    assert stats.kstest([c.p_value for c in quiet], "uniform").pvalue > 1e-3
    assert sum(not c.passed for c in checks(8, 0.5e-3, 0, 2, mount)) >= 7
    assert sum(not c.passed for c in checks(8, 0, float(np.radians(0.1)), 3, mount)) >= 7


@MOUNTS
def test_errors_of_an_arm_that_nobody_described_are_no_shift(mount: Mount) -> None:
    """Six views at other postures, links off by .3 mm and mrad; then a shift. The benchmark counts alarms."""
    for seed in range(900, 902):
        cell = arm_cell("seven joints", mount, 0.3, seed)
        solution = solve_views(cell.views, QUICK)
        known = KnownCell.of(solution.fit.posterior, solution.fit.camera)
        views = later_views(cell, np.zeros(6), 0, 6)
        still = check_drift(views, known)
        assert still.arm_known and still.p_value > 1e-3
        # as heavy tails as the fit's region, which is an average over sizes of errors
        assert still.threshold == pytest.approx(solution.fit.confidence_threshold) and known.freedom < 60
        assert not check_drift(later_views(cell, np.r_[1e-3, 0, 0, 0, 0, 0], 0, 6), known).passed
    assert _with_joints(views, known, np.degrees).statistic == pytest.approx(still.statistic, rel=1e-6)
    assert not _with_joints(views, known, lambda q: 1.1 * q).arm_known, "not this arm's"


def _with_joints(views: ViewSet, known: KnownCell, told: Callable[[Array], Array | None]) -> DriftCheck:
    every = list(range(len(views)))
    return check_drift(changed(views, every, joints_rad=lambda view: told(view.joints_rad)), known)


@MOUNTS
def test_without_joints_an_arm_errs_smoothly_at_other_postures(mount: Mount) -> None:
    """Whether the calibration knew the joints, or a stated accuracy. The benchmark counts alarms.

    What an arm errs alike in calibration and check is no shift of the camera; elsewhere it errs otherwise.
    """
    for stated_m in (None, 6e-4):
        cell = arm_cell("ur", mount, 0.3, 902, joints=stated_m is None)
        solution = solve_views(cell.views, replace(QUICK, robot_accuracy_m=stated_m))
        known = KnownCell.of(solution.fit.posterior, solution.fit.camera)
        still = [_with_joints(later_views(cell, np.zeros(6), k, 6), known, lambda _: None) for k in range(4)]
        assert min(check.p_value for check in still) > 1e-3 and still[0].arm_known == bool(stated_m)
        away = later_views(cell, np.r_[2e-3, np.zeros(5)], 0, 6)
        assert not _with_joints(away, known, lambda _: None).passed
    elsewhere = replace(known, flange_extent=np.add(known.flange_extent, [1, 0, 0, 0]))
    missed = _with_joints(away, elsewhere, lambda _: None)
    assert missed.passed and missed.elsewhere and not still[0].elsewhere


@MOUNTS
def test_where_the_robots_base_has_its_origin_changes_nothing(mount: Mount) -> None:
    """A robot's error turns the flange about the flange, however far away the base is."""
    views = few_views(np.random.default_rng(15), installed(), np.zeros(6), mount=mount)
    away = pose(np.eye(3), [0.0, 2.0, -3.0])
    moved = replace(views, views=tuple(replace(v, base_from_flange=away @ v.base_from_flange) for v in views))
    here = check_drift(views, installed())
    there = check_drift(moved, installed(X=away @ X_TRUE if mount == "eye-to-hand" else X_TRUE))
    assert there.statistic == pytest.approx(here.statistic, rel=1e-3)
    np.testing.assert_allclose(there.covariance, here.covariance, rtol=1e-3, atol=1e-12)


def test_a_file_without_a_posterior_is_checked_by_its_stated_figures(solved_real: SolvedRecording) -> None:
    """So is an earlier one, whose errors of the arm are for views with joints alone."""
    posterior = solved_real.calibration.posterior
    assert posterior is not None and posterior.errors
    earlier = msgspec.structs.replace(posterior, flange_extent_m=None)
    assert known_cell(msgspec.structs.replace(solved_real.calibration, posterior=earlier)).gravity is None
    calibration = msgspec.structs.replace(solved_real.calibration, posterior=None)
    quality = msgspec.structs.replace(
        calibration.quality, noise={"corner_px": 0.12, "robot_mm": 0.05, "robot_deg": 0.02}
    )
    known = known_cell(msgspec.structs.replace(calibration, quality=quality))
    assert known.scales.robot == pytest.approx([0.00005, np.radians(0.02)]) and known.chain is None
    np.testing.assert_allclose(known.covariance[:6, :6], calibration.covariance)
    assert known.freedom == 3 * len(calibration.views.used) - 6
    exact = msgspec.structs.replace(quality, noise={"corner_px": 0.0, "robot_mm": 0.0, "robot_deg": 0.0})
    assert (
        known_cell(msgspec.structs.replace(calibration, quality=exact)).scales.tau_px == 0.02
    )  # none is exact
    silent = msgspec.structs.replace(quality, noise={})
    with raises("no-noise", BadViewsError):
        known_cell(msgspec.structs.replace(calibration, quality=silent))


def test_the_file_gives_back_what_the_fit_left_known(solved_real: SolvedRecording, tmp_path: Path) -> None:
    path = tmp_path / "calibration.yaml"
    write_calibration(solved_real.calibration, path)
    assert path.stat().st_size <= 256 * 1024
    before, after = known_cell(solved_real.calibration), known_cell(read_calibration(path))
    np.testing.assert_array_equal(after.covariance, before.covariance)
    np.testing.assert_array_equal(after.mean.X, before.mean.X)
    assert after.flange_extent is not None
    np.testing.assert_array_equal(after.flange_extent, before.flange_extent)
    assert check_drift(solved_real.views, after).statistic == check_drift(solved_real.views, before).statistic


def test_another_board_is_not_expected_to_have_this_ones_shape() -> None:
    known, other = installed(), installed().with_board(BoardTolerance(0.002, 0.003))
    assert np.sqrt(np.diag(other.covariance)[15:]) == pytest.approx([0.002, 0.002, 0.003, 0.003, 0.003])
    np.testing.assert_array_equal(other.covariance[:15, :15], known.covariance[:15, :15])


def test_the_power_is_that_of_half_a_millimetre_and_a_tenth_of_a_degree() -> None:
    """In the worst direction, by the non-central F distribution, for what else is unknown too."""
    covariance = np.diag([1e-4, 2e-4, 1e-4, 4e-4, 2e-4, 2e-4]) ** 2
    limit = stats.f.ppf(0.95, 6, 69)
    by_shift, by_turn = (
        stats.ncf.sf(limit, 6, 69, (size / sigma) ** 2)
        for size, sigma in ((0.0005, 2e-4), (np.pi / 1800, 4e-4))
    )
    assert powers(covariance, 69) == pytest.approx((by_shift, by_turn))


def test_the_shift_is_named_and_the_stated_power_is_a_lower_bound() -> None:
    assert np.median([c.shift_mm for c in checks(5, 3e-3, 0, 4)]) == pytest.approx(3.0, abs=0.4)
    moved = checks(12, 0.5e-3, 0, 6)
    stated = np.mean([c.power_translation for c in moved])
    assert 0.1 < stated <= np.mean([not c.passed for c in moved]) + 0.05


def test_it_says_how_far_a_point_moved(solved_real: SolvedRecording) -> None:
    """By a shift alone, by a turn alone, and by a turn about the point itself."""
    calibration = solved_real.calibration
    X = calibration.transform.matrix
    at_m = moved_point(quiet_check(), calibration).at_m
    aside, axis = X[:3, 0], X[:3, 2]
    shift = np.array([*(1e-3 * aside), 0.0, 0.0, 0.0])
    turn = np.array([0.0, 0.0, 0.0, *(2e-3 * aside)])
    about_point = np.array([*np.cross(2e-3 * aside, -at_m * axis), *(2e-3 * aside)])
    moved = [
        moved_point(msgspec.structs.replace(quiet_check(), shift=by), calibration)
        for by in (shift, turn, about_point)
    ]
    assert [point.moved_mm for point in moved] == pytest.approx([1.0, 2.0 * at_m, 0.0], abs=1e-6)
    assert moved[0].placed_mm == calibration.quality.point.error_mm


def test_it_says_how_many_views_would_do() -> None:
    rng, known = np.random.default_rng(17), installed(0.1, 2.0)
    weak = check_drift(few_views(rng, known, np.zeros(6), 3), known)
    assert weak.power < POWER and weak.views_needed is not None and weak.views_needed > 3
    enough = check_drift(few_views(rng, known, np.zeros(6), weak.views_needed + 6), known)
    assert enough.power >= POWER and enough.views_needed == enough.views
    assert check_drift(few_views(rng, known, np.zeros(6), 5), installed(10.0)).views_needed is None


def test_a_check_states_its_verdict_and_how_many_views_more(solved_real: SolvedRecording) -> None:
    strong = msgspec.structs.replace(quiet_check(), passed=True, power_translation=0.97, power_rotation=0.99)
    weak = msgspec.structs.replace(strong, power_translation=0.6, views_needed=8)
    texts = [
        check_text(check, solved_real.calibration)
        for check in (strong, weak, msgspec.structs.replace(weak, passed=False, p_value=1e-6))
    ]
    assert [text.split(":")[0] for text in texts] == ["PASS", "PASS, low sensitivity", "FAIL"]
    assert "--poses 8" in texts[1] and "--poses" not in texts[2]


@pytest.mark.parametrize("rounding", [-1e-9, 0.0, 1e-9])
def test_views_that_say_nothing_have_no_power(rounding: float) -> None:
    blind = np.diag([1e12] * 6)
    blind[0, 1] = blind[1, 0] = 1e12 * (1 - 1e-8 + rounding)
    assert powers(blind, 69) == pytest.approx((0.05, 0.05), abs=1e-3)


def test_noisier_views_are_said_to_disagree() -> None:
    views = few_views(np.random.default_rng(7), installed(), np.zeros(6))
    assert check_drift(views, installed(0.1, 0.2)).disagreement > 3


def test_too_few_or_untelling_views_are_refused() -> None:
    views = few_views(np.random.default_rng(8), installed(), np.zeros(6), 3)
    with raises("too-few-views", TooFewViewsError, views=2, needed=3):
        check_drift(views.select([0, 1]), installed())
    with raises("no-corners", BadViewsError):
        bare = {"corners": lambda view: view.corners.part(slice(0))}
        check_drift(changed(views, [0, 1, 2], **bare), installed())
    with raises("shift-open", BadViewsError):
        first = views.views[0]
        shown = (replace(first.corners, pixels=first.corners.pixels + 1e-9 * k) for k in range(3))
        alike = tuple(replace(first, corners=corners) for corners in shown)
        check_drift(replace(views, views=alike), installed())


KNOWN = installed()


def entry(day: float, shift_mm: float, board: BoardSpec | None = None) -> CheckEntry:
    """A check that tells X ⊕ δ to 0.05 mm and 1e-5 rad, and nothing of lens and board."""
    N = np.zeros((len(SIGMA), len(SIGMA)))
    N[:6, :6] = np.diag(np.r_[np.full(3, 0.05e-3), np.full(3, 1e-5)] ** -2.0)
    shift = np.r_[shift_mm / 1e3, np.zeros(5)]
    check = quiet_check()
    evidence = Quadratic(N, N[:, :6] @ shift)
    return entry_of(
        msgspec.structs.replace(check, evidence=evidence, shift=shift), day * 86400, 1, "r", board
    )


def test_a_trend_is_found_before_a_check_fails() -> None:
    trend = find_trend([entry(day, 0.05 * day) for day in range(8)], KNOWN)
    assert trend is not None and (trend.days, trend.checks) == (7, 8)
    assert (trend.shift_mm, trend.shift_deg) == pytest.approx((0.35, 0.0), abs=1e-6)
    steady = [entry(day, 0.1) for day in range(8)]
    assert find_trend(steady, KNOWN) is None


def test_a_history_that_has_grown_large_keeps_its_newest_checks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hourly checks fill the limit within months; they go on."""
    (tmp_path / "calibrations").mkdir()
    for day in range(8):
        append_check(entry(day, 0.0), tmp_path)
    size = (tmp_path / "calibrations/checks.jsonl").stat().st_size
    monkeypatch.setattr("calibrate.files.lines.LOG_LIMIT_BYTES", size // 2)
    assert [round(check.wall_s / 86400) for check in read_checks(tmp_path)] in ([4, 5, 6, 7], [5, 6, 7])


@pytest.mark.parametrize("freedom", [9.0, 69.0])
def test_a_trend_is_told_from_chance_at_one_percent(freedom: float) -> None:
    """The slope of eight days has a variance of σ² / 42; σ is the calibration's, its square follows 6·F."""
    slope_mm, known = 0.05 * np.sqrt(6 * stats.f.ppf(0.99, 6, freedom) / 42), replace(KNOWN, freedom=freedom)
    for factor in (0.99, 1.01):
        wandering = find_trend([entry(day, 0.3 + factor * slope_mm * day) for day in range(8)], known)
        assert bool(wandering) == (factor > 1)


def test_another_board_is_not_a_step_of_the_trend() -> None:
    """Printed larger, it shows the camera elsewhere in each of its checks; its own trend is found."""
    swapped = [entry(day, 0.5 * (day > 2), board=PAPER_BOARD if day > 2 else None) for day in range(6)]
    assert find_trend(swapped, KNOWN) is None and find_trend(swapped, KNOWN, PAPER_BOARD) is None
    creeping = [*swapped, *(entry(day, 0.5 * day, board=PAPER_BOARD) for day in range(6, 12))]
    trend = find_trend(creeping, KNOWN, PAPER_BOARD)
    assert trend is not None and trend.checks == 9 and find_trend(creeping, KNOWN) is None


def test_four_checks_or_one_moment_are_no_trend() -> None:
    strong = [entry(day, 1.0 * day) for day in range(5)]
    assert find_trend(strong[:4], KNOWN) is None
    assert find_trend([entry(3.0, 1.0 * k) for k in range(5)], KNOWN) is None
