"""Bad views, one kind at a time: found, named where the data name a cause, and the good ones kept."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from calibrate.handeye.metrics import distance_in_sigmas
from calibrate.handeye.solve import solve_views
from calibrate.pipeline.gates import judge
from tests.calibrate.cells import (
    LOW,
    MID,
    MOUNTS,
    QUICK,
    changed,
    error_mm_deg,
    inside,
    make_cell,
    nudged,
    real_cell,
    with_flange,
)

SIGMA = np.repeat([MID.robot_m, MID.robot_rad], 3)


def cell(seed=0, views=20, mount="eye-in-hand"):
    return make_cell(np.random.default_rng(seed), views, MID, mount=mount)


@MOUNTS
def test_no_good_view_of_a_clean_cell_is_rejected_or_doubted(mount):
    for seed in range(2):
        noise = LOW if seed % 2 else MID
        shape = tuple(np.random.default_rng(seed).normal(size=5) * [0.003, 0.003, 5e-4, 5e-4, 5e-4])
        views = real_cell(np.random.default_rng(seed), 15, noise, mount=mount, shape=shape).views
        solution = solve_views(views, QUICK)
        assert (
            solution.evidence.views.rejected,
            solution.evidence.suspects,
            len(solution.evidence.views.used),
        ) == ([], {}, 15)
        assert np.mean(list(solution.evidence.weights.values())) > 0.8


@MOUNTS
def test_swapped_poses_are_named_with_the_partner(mount):
    c = cell(mount=mount)
    flange = c.views.base_from_flange
    flange[[4, 11]] = flange[[11, 4]]
    views = with_flange(c.views, flange)
    numbered = replace(views, views=tuple(replace(v, index=3 * v.index + 2) for v in views))
    solution = solve_views(numbered, QUICK)
    assert [(r.index, r.kind) for r in solution.evidence.views.rejected] == [
        (14, "wrong-pose"),
        (35, "wrong-pose"),
    ]
    assert [r.belongs_to for r in solution.evidence.views.rejected] == [35, 14]
    assert set(solution.evidence.weights) == set(range(2, 62, 3)), "numbers of the session, not places"
    assert inside(solution, c.X)


def test_a_pose_that_was_copied_is_no_swap():
    """The pose of view 12 stands at view 5 too: nobody knows where picture 5 belongs."""
    c = cell()
    flange = c.views.base_from_flange
    flange[4] = flange[11]
    (rejected,) = solve_views(with_flange(c.views, flange), QUICK).evidence.views.rejected
    assert (rejected.index, rejected.kind) == (4, "inconsistent")


@pytest.mark.parametrize(
    ("mount", "number", "size"),
    [("eye-in-hand", 0, -0.02), ("eye-to-hand", 2, 8e-3), ("eye-in-hand", 4, 0.02)],
)
def test_one_wrong_number_is_named_with_axis_and_size(mount, number, size):
    c = make_cell(np.random.default_rng(3), 14, MID, mount=mount)
    slip = size * np.eye(6)[number]
    solution = solve_views(nudged(c.views, [7], slip[None]), QUICK)
    (rejected,) = solution.evidence.views.rejected
    assert (rejected.index, rejected.kind, rejected.wrong_number) == (7, "wrong-number", number)
    assert rejected.slip == pytest.approx(size, abs=5 * SIGMA[number]), "recorded minus true"
    assert inside(solution, c.X)
    # How wrong it is hardly matters.
    far = solve_views(nudged(c.views, [7], 2 * slip[None]), QUICK)
    assert distance_in_sigmas(far.matrix, solution.matrix, solution.covariance) < 0.6


def test_a_pose_wrong_in_all_its_numbers_has_no_named_cause():
    c = cell()
    slip = np.array([[0.02, 0.03, -0.01, 0.02, 0.05, 0.04]])
    (rejected,) = solve_views(nudged(c.views, [7], slip), QUICK).evidence.views.rejected
    assert (rejected.index, rejected.kind, rejected.wrong_number) == (7, "inconsistent", None)


def test_what_is_said_of_a_view_is_its_own_where_an_earlier_one_is_rejected():
    c = cell()
    slip = np.array([[0.02, 0.03, -0.01, 0.02, 0.05, 0.04]])
    solution = solve_views(nudged(c.views, [1], slip), QUICK)
    without = solve_views(c.views.select([i for i in range(20) if i != 1]), QUICK)
    told = solution.evidence.residuals
    expected = without.evidence.residuals
    assert [one.index for one in told] == [one.index for one in expected]
    for name in ("rms_px", "robot_mm", "robot_deg"):
        found = [getattr(one, name) for one in told]
        assert found == pytest.approx([getattr(one, name) for one in expected], rel=0.15, abs=1e-3), name


def test_the_farther_off_a_view_the_likelier_it_is_called_an_outlier():
    c = cell()
    solutions = [solve_views(nudged(c.views, [7], size * SIGMA[None]), QUICK) for size in (3.0, 6.0, 9.0)]
    told = [solution.evidence.suspects[7] for solution in solutions if 7 in solution.evidence.suspects]
    assert len(told) >= 2 and told == sorted(told) and told[-1] > 0.9


def test_the_farther_off_a_view_the_less_it_counts_and_doubt_is_said():
    c = cell()
    weights, states = [], []
    for size in np.arange(0.0, 15.0, 3.0):
        solution = solve_views(nudged(c.views, [7], size * SIGMA[None]), QUICK)
        weights.append(solution.evidence.weights[7])
        rejected = 7 not in solution.evidence.views.used
        doubted = 7 in solution.evidence.suspects
        assert not (rejected and doubted)
        assert ("suspect-views" in {remark.code for remark in solution.judgement.warnings}) == bool(
            solution.evidence.suspects
        )
        states.append("bad" if rejected else "in doubt" if doubted else "good")
    assert states[0] == "good" and "in doubt" in states
    assert weights[0] > 0.8 and weights[-1] < 0.2
    assert all(later < before + 0.05 for before, later in pairwise(weights))


@pytest.mark.parametrize("share", [0.12, 0.4])
def test_shuffled_poses_cost_hardly_more_than_their_views(share):
    c = cell(0, 25)
    bad = np.random.default_rng(0).choice(25, round(25 * share), replace=False)
    flange = c.views.base_from_flange
    flange[bad] = flange[np.roll(bad, 1)]
    solution = solve_views(with_flange(c.views, flange), QUICK)
    assert not set(bad) & set(solution.evidence.views.used)
    oracle = solve_views(c.views.select([i for i in range(25) if i not in set(bad)]), QUICK)
    assert error_mm_deg(solution.matrix, c.X)[0] < 1.15 * error_mm_deg(oracle.matrix, c.X)[0]
    warned = {gate.name for gate in judge(solution) if gate.over_limit}
    assert ("weight" in warned) == (share > 0.2)


def test_forty_percent_of_moderate_errors_stay_inside_the_claim():
    """6 to 20 robot sigmas: where views cannot be told apart, the noise that is claimed is that of all."""
    held = 0
    for seed in range(4):
        rng = np.random.default_rng([seed, 40])
        c = make_cell(rng, 25, MID)
        bad = rng.choice(25, 10, replace=False).tolist()
        size = rng.uniform(6, 20, (10, 6)) * rng.choice([-1, 1], (10, 6))
        if seed % 2:  # of one number only
            size = size * np.eye(6)[rng.integers(6, size=10)]
        solution = solve_views(nudged(c.views, bad, size * SIGMA), QUICK)
        held += inside(solution, c.X)
    assert held >= 3


def test_views_without_corners_have_only_a_robot():
    c = cell(5)
    empty = changed(c.views, list(range(20)), corners=lambda v: v.corners.part(slice(0)))
    flange = empty.base_from_flange
    flange[4] = flange[5]
    solution = solve_views(with_flange(empty, flange), QUICK)
    assert "no-corners" in {remark.code for remark in solution.judgement.warnings}
    assert [r.index for r in solution.evidence.views.rejected] == [4]
    assert (
        solution.evidence.rms_px == {}
        and solution.fit.board is None
        and solution.judgement.lens_finding is None
    )
