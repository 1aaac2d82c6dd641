"""The check notices what it promises to, and cries wolf no more often than it says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from scipy import stats

from calibrate.boards.model import board_points
from calibrate.cli.drift_check import check_text
from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.files.calibration import FramePose
from calibrate.geometry import Array, Transform, inverse, perturb, pose, rotation_exp
from calibrate.job import SolvedRecording
from calibrate.kinematics import MODELS, forward
from calibrate.lens.pnp import solve_pnp
from calibrate.projection import project_at
from calibrate.quality.drift import POWER, DriftCheck, Noise, check_drift, judge_shift, pnp_covariance, powers
from calibrate.quality.drift_history import CheckEntry, append_check, earlier_results, find_trend, read_checks
from calibrate.views import BoardView, ViewSet
from recordings.schema.messages import CameraModel, Mount
from tests.calibrate.calling import raises_code
from tests.calibrate.files.test_exports import offered_arm
from tests.calibrate.sessions import PAPER_BOARD, X_TRUE, looking

CAMERA = CameraModel(1280, 1024, ((1667.0, 0, 639.5), (0, 1667.0, 511.5), (0, 0, 1)), (0.0,) * 5)
NOISE = Noise(corner_px=0.1, robot_m=0.00005, robot_rad=float(np.radians(0.005)), degrees_of_freedom=69)
INSTALLED_COVARIANCE = np.diag([(0.03e-3) ** 2] * 3 + [float(np.radians(0.0035)) ** 2] * 3)
BOARD = pose(rotation_exp([np.pi - 0.2, 0.1, 0.4]), [0.6, 0.1, 0.0])


def few_views(rng: np.random.Generator, X: Array, count: int = 5, mount: Mount = "eye-in-hand") -> ViewSet:
    """New views of a cell whose camera is truly at X."""
    found = []
    for k in range(count):
        seen = looking(PAPER_BOARD, rng, (0.25, 0.6), 0.45, 1.2)
        flange = BOARD @ inverse(X @ seen) if mount == "eye-in-hand" else X @ seen @ inverse(BOARD)
        error = np.r_[rng.normal(size=3) * NOISE.robot_m, rng.normal(size=3) * NOISE.robot_rad]
        pixels = (
            project_at(CAMERA, seen, board_points(PAPER_BOARD)) + rng.normal(size=(42, 2)) * NOISE.corner_px
        )
        found.append(BoardView(k, str(k), perturb(flange, error), board_points(PAPER_BOARD), pixels))
    return solve_pnp(ViewSet(mount, tuple(found), CAMERA))


def checks(
    count: int, shift_m: float, shift_rad: float, seed: int, mount: Mount = "eye-in-hand"
) -> list[DriftCheck]:
    """Views after an installation with its own error, and a shift in a random direction since."""
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(INSTALLED_COVARIANCE)
    found = []
    for _ in range(count):
        way = rng.normal(size=(2, 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        moved = perturb(X_TRUE, np.r_[way[0] * shift_m, way[1] * shift_rad])
        installed = perturb(X_TRUE, root @ rng.normal(size=6))
        found.append(judge_shift(few_views(rng, moved, mount=mount), installed, INSTALLED_COVARIANCE, NOISE))
    return found


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_false_alarms_and_detections(mount: Mount) -> None:
    """Few trials; `make soak` runs 400. Limits allow for the chance of so few."""
    quiet = checks(60, 0, 0, 1, mount)
    assert sum(not c.passed for c in quiet) <= stats.binom.ppf(0.999, 60, 0.05)
    assert np.mean([c.disagreement for c in quiet]) == pytest.approx(1.0, abs=0.2)
    assert sum(not c.passed for c in checks(30, 0.5e-3, 0, 2, mount)) >= 27
    assert sum(not c.passed for c in checks(30, 0, float(np.radians(0.1)), 3, mount)) >= 27


@pytest.mark.soak
@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_the_promise_in_400_trials_each(mount: Mount) -> None:
    assert sum(not c.passed for c in checks(400, 0, 0, 11, mount)) <= stats.binom.ppf(0.99, 400, 0.05)
    assert sum(not c.passed for c in checks(400, 0.5e-3, 0, 12, mount)) >= 380
    assert sum(not c.passed for c in checks(400, 0, float(np.radians(0.1)), 13, mount)) >= 380


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_where_the_robots_base_has_its_origin_changes_nothing(mount: Mount) -> None:
    """A robot's error turns the flange about the flange, however far away the base is."""
    views = few_views(np.random.default_rng(15), X_TRUE, mount=mount)
    away = pose(np.eye(3), [0.0, 2.0, -3.0])
    moved = replace(
        views,
        views=tuple(replace(v, base_from_flange=away @ v.base_from_flange) for v in views),
    )
    X = away @ X_TRUE if mount == "eye-to-hand" else X_TRUE
    here = judge_shift(views, X_TRUE, INSTALLED_COVARIANCE, NOISE)
    there = judge_shift(moved, X, INSTALLED_COVARIANCE, NOISE)
    assert there.statistic == pytest.approx(here.statistic, rel=1e-3)
    np.testing.assert_allclose(there.covariance, here.covariance, rtol=1e-3, atol=1e-12)


def test_the_noise_of_a_calibration_comes_in_metres_and_radians(solved_real: SolvedRecording) -> None:
    calibration = solved_real.calibration
    quality = msgspec.structs.replace(
        calibration.quality, noise={"corner_px": 0.12, "robot_mm": 0.05, "robot_deg": 0.02}
    )
    noise = Noise.of(msgspec.structs.replace(calibration, quality=quality))
    assert (noise.corner_px, noise.robot_m) == (0.12, 0.00005)
    assert noise.robot_rad == pytest.approx(np.radians(0.02))
    assert noise.degrees_of_freedom == 3 * len(calibration.views.used) - 6
    exact = msgspec.structs.replace(quality, noise={"corner_px": 0.0, "robot_mm": 0.0, "robot_deg": 0.0})
    assert Noise.of(msgspec.structs.replace(calibration, quality=exact)).corner_px == 0.02  # no corner is
    silent = msgspec.structs.replace(quality, noise={})
    with raises_code(BadViewsError, "no-noise"):
        Noise.of(msgspec.structs.replace(calibration, quality=silent))


def test_the_verdict_is_that_of_the_p_value_at_five_percent() -> None:
    for check in checks(12, 0.2e-3, 0, 21):
        assert check.passed == (check.p_value >= 0.05) == (check.statistic <= check.threshold)
        assert check.p_value == pytest.approx(1 - stats.f.cdf(check.statistic / 6, 6, 69))
        assert stats.f.sf(check.threshold / 6, 6, 69) == pytest.approx(0.05)


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_twice_the_noise_everywhere_is_twice_the_doubt(mount: Mount) -> None:
    views = few_views(np.random.default_rng(23), X_TRUE, mount=mount)
    doubled = Noise(2 * NOISE.corner_px, 2 * NOISE.robot_m, 2 * NOISE.robot_rad, NOISE.degrees_of_freedom)
    once = judge_shift(views, X_TRUE, INSTALLED_COVARIANCE, NOISE)
    twice = judge_shift(views, X_TRUE, 4 * INSTALLED_COVARIANCE, doubled)
    np.testing.assert_allclose(twice.covariance, 4 * once.covariance, rtol=1e-6, atol=1e-15)
    np.testing.assert_allclose(twice.shift, once.shift, rtol=1e-6, atol=1e-12)
    assert twice.statistic == pytest.approx(once.statistic / 4)
    assert twice.disagreement == pytest.approx(once.disagreement / 4)


def test_the_power_is_that_of_half_a_millimetre_and_a_tenth_of_a_degree() -> None:
    """In the worst direction, by the non-central F distribution, for what else is unknown too."""
    covariance = np.diag([1e-4, 2e-4, 1e-4, 4e-4, 2e-4, 2e-4]) ** 2
    limit = stats.f.ppf(0.95, 6, 69)
    by_shift, by_turn = (
        stats.ncf.sf(limit, 6, 69, (size / sigma) ** 2)
        for size, sigma in ((0.0005, 2e-4), (np.pi / 1800, 4e-4))
    )
    assert powers(covariance, 69) == pytest.approx((by_shift, by_turn))


def test_a_shift_is_told_in_millimetres_and_degrees() -> None:
    (check,) = checks(1, 0, 0, 5)
    moved = replace(check, shift=np.r_[3e-4, 0.0, -4e-4, np.radians([0.0, 0.03, 0.04])])
    assert (moved.shift_mm, moved.shift_deg) == pytest.approx((0.5, 0.05))
    assert replace(check, power_translation=0.9, power_rotation=0.8).power == 0.8


def test_the_shift_is_named_and_the_stated_power_is_a_lower_bound() -> None:
    found = checks(40, 2e-3, 0, 4)
    assert np.median([c.shift_mm for c in found]) == pytest.approx(2.0, abs=0.3)
    stated = np.mean([c.power_translation for c in checks(20, 0, 0, 5)])
    noticed = np.mean([not c.passed for c in checks(40, 0.5e-3, 0, 6)])
    assert 0.5 < stated <= noticed + 0.05


MID = Noise(corner_px=0.15, robot_m=0.0001, robot_rad=float(np.radians(0.01)), degrees_of_freedom=69)


def test_it_says_how_many_views_would_do() -> None:
    rng = np.random.default_rng(17)
    weak = judge_shift(few_views(rng, X_TRUE, 5), X_TRUE, 4 * INSTALLED_COVARIANCE, MID)
    assert weak.power < POWER and weak.views_needed is not None and weak.views_needed > 5
    views = few_views(rng, X_TRUE, weak.views_needed + 4)
    enough = judge_shift(views, X_TRUE, 4 * INSTALLED_COVARIANCE, MID)
    assert enough.power >= POWER and enough.views_needed == len(views)
    blind_to_turns = INSTALLED_COVARIANCE * np.repeat([1.0, 100.0], 3)
    half = judge_shift(views, X_TRUE, blind_to_turns, MID)
    assert half.power_translation >= POWER > half.power_rotation and half.views_needed is None
    hopeless = judge_shift(few_views(rng, X_TRUE, 5), X_TRUE, 100 * INSTALLED_COVARIANCE, MID)
    assert hopeless.views_needed is None


def test_a_check_states_its_verdict_and_how_many_views_more(solved_real: SolvedRecording) -> None:
    strong = replace(checks(1, 0, 0, 5)[0], passed=True, power_translation=0.97, power_rotation=0.99)
    weak = replace(strong, power_translation=0.6, views_needed=8)
    texts = [
        check_text(check, solved_real.calibration)
        for check in (strong, weak, replace(weak, passed=False, p_value=1e-6))
    ]
    assert [text.split(":")[0] for text in texts] == ["PASS", "PASS, low sensitivity", "FAIL"]
    assert "--poses 8" in texts[1] and "--poses" not in texts[2]


@pytest.mark.parametrize("rounding", [-1e-9, 0.0, 1e-9])
def test_views_that_say_nothing_have_no_power(rounding: float) -> None:
    blind = np.diag([1e12] * 6)
    blind[0, 1] = blind[1, 0] = 1e12 * (1 - 1e-8 + rounding)
    assert powers(blind, 69) == pytest.approx((0.05, 0.05), abs=1e-3)


def test_noisier_views_are_said_to_disagree() -> None:
    rng = np.random.default_rng(7)
    quiet = replace(NOISE, corner_px=0.02, robot_m=0.00001, robot_rad=0.00001)
    result = judge_shift(few_views(rng, X_TRUE), X_TRUE, INSTALLED_COVARIANCE, quiet)
    assert result.disagreement > 3


def test_too_few_or_untelling_views_are_refused() -> None:
    rng = np.random.default_rng(8)
    with raises_code(TooFewViewsError, "too-few-views", views=2, needed=3):
        judge_shift(few_views(rng, X_TRUE, 2), X_TRUE, INSTALLED_COVARIANCE, NOISE)
    views = few_views(rng, X_TRUE, 3)
    same = replace(views, views=(views.views[0],) * 3)
    with raises_code(BadViewsError, "shift-open"):
        judge_shift(same, X_TRUE, INSTALLED_COVARIANCE, NOISE)


def test_the_pose_covariance_is_that_of_many_repetitions() -> None:
    rng = np.random.default_rng(9)
    seen = looking(PAPER_BOARD, rng, (0.4, 0.41), 0.45)
    points = board_points(PAPER_BOARD)
    exact = project_at(CAMERA, seen, points)
    pictures = exact + rng.normal(size=(300, *exact.shape)) * 0.1
    views = tuple(BoardView(k, "", np.eye(4), points, pixels) for k, pixels in enumerate(pictures))
    measured = np.cov(solve_pnp(ViewSet("eye-in-hand", views, CAMERA)).camera_from_board[:, :3, 3].T)
    predicted = pnp_covariance(points, CAMERA, seen)[:3, :3] * 0.01
    assert np.sqrt(np.diag(measured)) == pytest.approx(np.sqrt(np.diag(predicted)), rel=0.15)


def entry(day: float, shift_mm: float, generation: int = 1, turn_deg: float = 0.0) -> CheckEntry:
    """1σ is 0.05 mm and 1e-5 rad."""
    covariance = np.diag([(0.05e-3) ** 2] * 3 + [1e-10] * 3)
    rows = tuple(tuple(row) for row in covariance.tolist())
    shift = (shift_mm / 1e3, 0.0, 0.0, 0.0, float(np.radians(turn_deg)), 0.0)
    return CheckEntry(day * 86400, generation, "r", True, shift, rows, 1.0, 13.0)


def test_a_trend_is_found_before_a_check_fails(tmp_path: Path) -> None:
    for day in range(8):
        append_check(entry(day, 0.05 * day), tmp_path)
    trend = find_trend(read_checks(tmp_path), 1)
    assert trend is not None and (trend.days, trend.checks) == (7, 8)
    assert (trend.shift_mm, trend.shift_deg) == pytest.approx((0.35, 0.0), abs=1e-6)
    assert find_trend(read_checks(tmp_path), 2) is None
    steady = [entry(day, 0.1) for day in range(8)]
    assert find_trend(steady, 1) is None and find_trend(steady[:3], 1) is None
    failed = msgspec.structs.replace(steady[0], passed=False)
    assert earlier_results([*steady[:3], failed], 1) == [True, True, True, False]
    assert earlier_results(steady, 2) == []


def test_a_trend_is_told_from_chance_at_one_percent() -> None:
    """The slope of eight days has a variance of σ² / 42; its square follows χ²(6)."""
    slope_mm = 0.05 * np.sqrt(stats.chi2.ppf(0.99, 6) / 42)
    for factor in (0.99, 1.01):
        wandering = find_trend([entry(day, 0.3 + factor * slope_mm * day) for day in range(8)], 1)
        assert bool(wandering) == (factor > 1)


def test_four_checks_or_one_moment_are_no_trend() -> None:
    strong = [entry(day, 1.0 * day) for day in range(5)]
    assert find_trend(strong, 1) is not None
    assert find_trend(strong[:4], 1) is None
    assert find_trend([entry(3.0, 1.0 * k) for k in range(5)], 1) is None


@pytest.mark.parametrize(
    ("days", "said"), [(2.0, "2 days"), (1.9, "46 hours"), (2.1 / 24, "2 hours"), (1.9 / 24, "114 min")]
)
def test_a_turning_camera_is_told_in_degrees_over_the_time_that_was_looked_at(days: float, said: str) -> None:
    trend = find_trend([entry(100 + days * k / 4, 0.0, turn_deg=0.05 * k) for k in range(5)], 1)
    assert trend is not None and trend.shift_deg == pytest.approx(0.2) and f" in {said} " in trend.text


def test_a_cut_history_line_is_skipped(tmp_path: Path) -> None:
    append_check(entry(1, 0.0), tmp_path)
    path = tmp_path / "calibrations/checks.jsonl"
    path.write_bytes(path.read_bytes() + b'{"wall_s": 12')
    assert len(read_checks(tmp_path)) == 1


def test_a_worn_arm_is_checked_with_its_table_where_joints_are_recorded(solved_real: SolvedRecording) -> None:
    """Views of the corrected arm, its camera where it was: nothing moved. Without joints `result` counts."""
    rng = np.random.default_rng(6)
    own = pose(rotation_exp([0.02, -0.01, 0.3]), [0.01, -0.06, 0.087])
    arm = offered_arm(FramePose.of(Transform("corrected_flange", "camera", own)))
    quality = msgspec.structs.replace(
        solved_real.calibration.quality,
        board=None,
        noise={"corner_px": 0.1, "robot_mm": 0.05, "robot_deg": 0.003},
    )
    elsewhere = own @ pose(rotation_exp([0.0, 0.004, 0.0]), [0.002, 0.0, 0.0])
    calibration = msgspec.structs.replace(
        solved_real.calibration,
        mount="eye-in-hand",
        result=FramePose.of(Transform("flange", "camera", elsewhere)),
        quality=quality,
        arm_table=arm,
    )
    nominal, seen = MODELS[arm.model], few_views(rng, X_TRUE, 8)
    joints = rng.uniform(-0.3, 0.3, (8, 6)) + np.array([0.0, -1.5, 1.5, -1.5, -1.5, 0.0])
    true = np.array([arm.base_from_flange(q).matrix for q in joints])
    Y = true[0] @ own @ seen.camera_from_board[0]
    told = [
        replace(v, base_from_flange=forward(nominal, q), joints_rad=q, camera_from_board=inverse(F @ own) @ Y)
        for v, q, F in zip(seen, joints, true, strict=True)
    ]
    views = replace(seen, views=tuple(told))
    with_table = check_drift(views, calibration)
    assert with_table.passed and with_table.shift_mm < 0.05
    bare = replace(views, views=tuple(replace(v, joints_rad=None) for v in told))
    assert check_drift(bare, calibration).shift_mm > 1.0
