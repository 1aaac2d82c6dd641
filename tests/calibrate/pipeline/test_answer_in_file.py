"""What the solver found reaches the file whole: nothing dropped, exchanged or in another unit."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from calibrate.files.calibration import Calibration
from calibrate.files.formatting import figures
from calibrate.handeye.solution import ArmErrors, Explanation, Reading, Rival, Solution, UncorrectedArm
from calibrate.pipeline.document import make_calibration
from calibrate.pipeline.job import JobOptions, SolvedRecording, solve_recording
from calibrate.results import Arm, HoldoutScore
from calibrate.views.view_set import implied_flange
from recordings.geometry import difference, perturb
from recordings.schema.messages import SessionInfo

NUMBERS = np.random.default_rng(53)


def written(job: SolvedRecording, solution: Solution, **info: object) -> Calibration:
    """The calibration that this solution would give; `info`: other facts of the recording."""
    recording = job.recording
    if info:
        recording = _Recording(job, msgspec.structs.replace(job.recording.info, **info))
    return make_calibration(recording, job.loaded, job.views, job.intrinsics, solution, job.gates, {})


class _Recording:
    """The recording of a job with other facts about its session."""

    def __init__(self, job: SolvedRecording, info: SessionInfo) -> None:
        self.info = info
        self.path = job.recording.path
        self.sha256 = job.recording.sha256


def test_each_view_has_its_own_distance_from_the_model(solved_real: SolvedRecording) -> None:
    """In millimetres and degrees, between the recorded flange and the one that the image implies."""
    solution = solved_real.solution
    cell = solution.fit
    evidence = solution.evidence
    boards = np.array([view.camera_from_board for view in evidence.kept])
    flanges = np.array([view.base_from_flange for view in evidence.kept])
    implied = implied_flange(cell.mount, cell.X, cell.board_place.matrix, boards)
    apart = difference(implied, flanges)
    views = solved_real.calibration.quality.views
    assert [view.index for view in views] == [view.index for view in evidence.kept]
    robot_mm = [view.robot_mm for view in views]
    robot_deg = [view.robot_deg for view in views]
    # Errors of the arm are taken off the flanges: a tenth of a millimetre here.
    assert robot_mm == pytest.approx(1e3 * np.linalg.norm(apart[:, :3], axis=1), abs=0.2)
    assert robot_deg == pytest.approx(np.degrees(np.linalg.norm(apart[:, 3:], axis=1)), abs=0.02)
    assert np.corrcoef(robot_mm, np.linalg.norm(apart[:, :3], axis=1))[0, 1] > 0.6


def test_the_installed_pose_is_the_one_for_the_arm_as_it_is(solved_real: SolvedRecording) -> None:
    solution = solved_real.solution
    other = perturb(solution.matrix, np.array([1e-3, 0.0, 0.0, 0.0, 1e-3, 0.0]))
    spread = NUMBERS.normal(size=(6, 6))
    covariance = 1e-8 * spread @ spread.T
    stated = Arm(True, 9.0, 0.3, [])
    errors = ArmErrors(stated, UncorrectedArm(other, covariance))
    found = written(solved_real, replace(solution, fit=replace(solution.fit, arm=errors)))
    np.testing.assert_allclose(found.transform.matrix, other, atol=1e-12)
    np.testing.assert_allclose(found.covariance, covariance)
    assert found.sigma.translation_mm == pytest.approx(1e3 * np.sqrt(np.trace(covariance[:3, :3])))
    assert found.quality.arm == stated


def test_turned_views_and_the_plan_are_written(solved_real: SolvedRecording) -> None:
    solution = solved_real.solution
    views = msgspec.structs.replace(solution.evidence.views, turned=[3, 5])
    evidence = replace(solution.evidence, views=views)
    found = written(
        solved_real,
        replace(solution, evidence=evidence),
        plan_sha256="ab" * 32,
        created_wall_ns=1_700_000_000,
    )
    assert found.views.turned == [3, 5]
    assert found.provenance.plan_sha256 == "ab" * 32
    assert found.provenance.recorded_wall_ns == 1_700_000_000


def test_only_readings_that_are_not_excluded_are_named_beside_the_best(solved_real: SolvedRecording) -> None:
    """A change stands at the pose's number, which is not the view's place."""
    solution = solved_real.solution
    rivals = (Rival(Reading.BOARD_MOVED, 80.0, excluded=False), Rival(Reading.REFOCUSED, 20.0, excluded=True))
    session = Explanation(Reading.CAMERA_MOVED, 82.0, rivals, at=4, between=(3, 5), numbers=(9, 7, 12))
    judgement = replace(solution.judgement, session=session)
    told = written(solved_real, replace(solution, judgement=judgement)).quality.session
    assert told is not None
    assert (told.hypothesis, told.others) == ("camera-moved", ["board-moved"])
    assert (told.changed_from, told.changed_between) == (9, (7, 12))


def test_the_held_out_error_is_shown_in_millimetres(solved_real: SolvedRecording) -> None:
    score = HoldoutScore(0.00123, 0.004, [0.00123], [0.004], [(0, 1)], 12)
    solution = solved_real.solution
    figured = msgspec.structs.replace(solution.judgement.figures, holdout=score)
    found = written(solved_real, replace(solution, judgement=replace(solution.judgement, figures=figured)))
    assert found.quality.holdout == score
    assert float(figures(found)["held_out"].value.split()[0]) == pytest.approx(1.23)


def test_the_board_that_was_solved_with_is_the_one_written(solved_real: SolvedRecording) -> None:
    recorded = solved_real.recording.info.board
    job = solve_recording(solved_real.recording.path, JobOptions(square_m=1.25 * recorded.square_m))
    assert job.calibration.board.square_m == pytest.approx(1.25 * recorded.square_m)
    assert solved_real.calibration.board == recorded
