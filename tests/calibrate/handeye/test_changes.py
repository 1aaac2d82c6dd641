"""What moved half-way is named with its place; an arm whose errors follow its posture moves nothing."""

import numpy as np
import pytest

from benchmarks.moved import MOUNTS, measure, moved_cell
from calibrate.handeye.changes import ChangeSearch, errors_by_posture
from calibrate.handeye.pose_fit import FREE, fit_poses, pose_views
from calibrate.handeye.readings import explain_changes, explain_recording, explain_text
from calibrate.handeye.solution import Reading
from recordings.geometry import perturb
from tests.calibrate.cells import MID, make_cell, slipped, with_flange
from tests.calibrate.chains import arm_cell

SLIP = np.array([0.02, -0.015, 0.01, 0.02, 0.03, -0.02])


def changes(views):
    return explain_changes(pose_views(views, 0.002, 0.003))


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("order", ["random", "swept", "halves"])
def test_an_arm_with_errors_of_its_own_moves_no_board(mount, order):
    for seed in range(2):
        rng = np.random.default_rng([seed, len(mount), len(order)])
        views = moved_cell(rng, "nothing", 0.0, order, False, mount, 12, seed)
        assert changes(views).reading is Reading.AS_RECORDED


@pytest.mark.parametrize(("what", "mount"), [("board", "eye-in-hand"), ("camera", "eye-to-hand")])
def test_a_millimetre_half_way_is_found_in_a_solve_that_nothing_else_disturbs(what, mount):
    trial = measure((what, 1.0, "random", False, mount, 0))
    assert trial.named and trial.truly and trial.held


def test_the_range_of_the_first_changed_view_is_told_as_values_and_in_words():
    rng = np.random.default_rng([8, 0])
    views, _, _ = slipped(make_cell(rng, 24, MID), "board", 12, SLIP, MID, rng)
    found = changes(views)
    first, last = found.between
    assert found.reading is Reading.BOARD_MOVED and first <= 12 <= last and first <= found.at <= last
    assert views.views[found.at].name in explain_text(found, views)


def test_one_wrong_view_at_the_end_is_a_wrong_view():
    cell = make_cell(np.random.default_rng(3), 20, MID)
    flange = cell.views.base_from_flange
    flange[-1] = perturb(flange[-1], SLIP)
    views = with_flange(cell.views, flange)
    assert changes(views).reading is Reading.AS_RECORDED


def test_a_cause_carries_the_rivals_that_it_was_held_against():
    rng = np.random.default_rng([8, 1])
    views, _, _ = slipped(make_cell(rng, 20, MID), "camera", 10, SLIP, MID, rng)
    found = explain_recording(pose_views(views, 0.002, 0.003))
    assert found.readings == (Reading.CAMERA_MOVED,)
    held = {rival.reading: rival for rival in found.rivals}
    assert {Reading.SQUARE_SIZE, Reading.ROTATION_VECTOR_AS_ANGLES} <= held.keys()
    assert Reading.INVERSE_POSES not in held, "by it the board moves more than as recorded: nothing to fit"
    assert all(rival.excluded for rival in held.values())
    gains = [rival.log_evidence_gain for rival in found.rivals]
    assert gains == sorted(gains, reverse=True) and gains[0] < found.log_evidence_gain


def test_a_boards_size_that_the_arms_motion_tells_is_within_what_is_stated_of_it():
    """The fit that knows no errors of the arm says three times too little."""
    found = []
    for seed in range(6):
        for mount in MOUNTS:
            cell = arm_cell(("ur", "spherical wrist")[seed % 2], mount, 0.4, seed, 20, joints=False)
            views = pose_views(cell.views, focal_sigma=0.02, size_sigma=FREE)
            search = ChangeSearch(views, errors_by_posture(views.flange), fit_poses(views))
            factor, sigma = search.board_size()
            found.append((factor - 1) / sigma)
    assert np.sqrt(np.mean(np.square(found))) < 2.1
