"""A recording goes in, a right calibration comes out: rendered with a known truth, and other people's."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml

from calibrate.errors import BadViewsError, UsageError
from calibrate.handeye.pose_fit import pose_views
from calibrate.handeye.readings import explain_recording
from calibrate.handeye.solution import Reading, SolveOptions
from calibrate.pipeline.job import (
    JobOptions,
    SolvedRecording,
    prepare_views,
    solve_recording,
    solver_options,
    with_board_poses,
)
from calibrate.views.corners import MAIN_BOARD
from calibrate.views.view_set import ViewSet
from recordings.geometry import difference
from recordings.importers.folder import import_folder
from recordings.schema.messages import CameraIdentity, CameraModel, RobotIdentity
from tests.calibrate.cells import error_mm_deg, inside
from tests.calibrate.sessions import CAMERA, SYMMETRIC_BOARD, X_TRUE, Scene, write_session
from tests.codes import raises

SolveSet = Callable[[Path], SolvedRecording]


def test_the_camera_is_found_with_an_unknown_lens(solved: SolvedRecording) -> None:
    mm, degrees = error_mm_deg(solved.solution.matrix, X_TRUE)
    assert mm < 1.0
    assert degrees < 0.1
    assert solved.intrinsics is not None
    assert solved.calibration.intrinsics.matrix[0][0] == pytest.approx(620.0, rel=0.005)
    assert solved.calibration.source == "simulated"
    told = {gate.name: gate.value or 0.0 for gate in solved.gates}
    assert 0.2 < told["coverage"] < 0.95 and told["clock_bound_s"] == 0.001


def test_a_symmetric_board_solves_by_the_robots_motion(tmp_path: Path) -> None:
    """Every picture is read one of two ways; a single wrong one would miss by half a turn."""
    scene = Scene(board=SYMMETRIC_BOARD, mount="eye-to-hand", seed=17, roll_rad=3.1)
    path = write_session(tmp_path / "s.mcap", scene, known_lens=True)
    job = solve_recording(path)
    turned = [
        not np.allclose(a.corners.points, b.corners.points)
        for a, b in zip(job.loaded.views, job.views, strict=True)
    ]
    assert 0 < sum(turned) < len(turned), "the scene does not show what it should"
    mm, degrees = error_mm_deg(job.solution.matrix, X_TRUE)
    assert mm < 1.0
    assert degrees < 0.15


def test_what_the_solver_kept_says_of_which_camera_and_board_it_is(tmp_path: Path) -> None:
    scene = Scene(board=SYMMETRIC_BOARD, mount="eye-to-hand", seed=17, roll_rad=3.1)
    identity = CameraIdentity("rendered", "MER", "17", name="wrist")
    path = write_session(tmp_path / "s.mcap", scene, known_lens=True, camera_identity=identity)
    corners = [view.corners for view in solve_recording(path).solution.evidence.kept]
    assert corners and {(each.camera, each.board) for each in corners} == {("wrist", MAIN_BOARD)}


def test_a_wrong_square_size_is_found_and_said(real_session_file: Path, solved_real: SolvedRecording) -> None:
    job = solve_recording(real_session_file, JobOptions(square_m=0.026))
    session = job.solution.judgement.session
    assert session.reading is Reading.SQUARE_SIZE
    assert 0.026 * session.factor == pytest.approx(0.025, rel=0.005)
    assert {"session", "board_pull"} & {gate.name for gate in job.gates if not gate.passed}
    right = solved_real
    assert all(gate.passed for gate in right.gates if gate.name in ("session", "board_pull"))
    assert abs(right.solution.fit.board.scale) < 4 * right.solution.fit.board.sigma[0]


def test_another_board_or_lens_can_be_tried_on_the_old_pictures(
    real_session_file: Path, small_session_file: Path
) -> None:
    found = solve_recording(real_session_file, JobOptions(find_intrinsics=True))
    assert found.intrinsics is not None
    given = solve_recording(small_session_file, JobOptions(camera=CAMERA))
    assert given.intrinsics is None
    assert given.calibration.provenance.options["camera"]["width"] == CAMERA.width


def test_a_number_held_fixed_leaves_the_others_their_stated_error(real_session_file: Path) -> None:
    camera = CameraModel(480, 384, ((620.0, 0, 243), (0, 620, 189), (0, 0, 1)), (-0.1, 0.2, 0.0, 0.0, 0.0))
    options = JobOptions(camera=camera, camera_sigma={"fx": 17.0, "fy": 16.0, "k1": 0.3, "k3": 0.0})
    sigma = solver_options(options, prepare_views(real_session_file, options)).lens_sigma
    assert sigma is not None and sigma[:2] == (17.0, 16.0) and sigma[4] == 0.3
    assert 0 < sigma[8] < 1e-6 and sigma[2] > 0.1


@pytest.mark.parametrize(
    ("recorded", "told", "used"),
    [
        ("", "", ""),
        ("servo", "", "servo"),
        ("", "servo", "servo"),
        ("servo", "industrial-six", "industrial-six"),
    ],
)
def test_the_class_of_the_arm_is_what_was_told_last(
    tmp_path: Path, recorded: str, told: str, used: str
) -> None:
    robot = RobotIdentity("xArm 6", arm_class=recorded)
    path = write_session(tmp_path / "a.mcap", Scene(views=6), known_lens=True, robot=robot)
    options = JobOptions(arm_class=told)
    assert solver_options(options, prepare_views(path, options)).arm_class == used
    assert options.chosen.get("arm_class", "") == told


def test_a_class_of_arms_that_does_not_exist_is_refused() -> None:
    with raises("choice", UsageError):
        JobOptions(arm_class="cheap")
    with raises("choice", UsageError):
        SolveOptions(arm_class="cheap")


def test_a_lens_of_another_camera_never_passes(real_session_file: Path) -> None:
    other = CameraModel(480, 384, ((1240.0, 0, 243), (0, 1240, 189), (0, 0, 1)), (-0.9, 2.0, 0.0, 0.0, 0.0))
    with contextlib.suppress(BadViewsError):
        assert not solve_recording(real_session_file, JobOptions(camera=other)).passed
    small = CameraModel(640, 480, CAMERA.matrix, CAMERA.distortion)
    with raises("image-size", BadViewsError, view=1, width_px=480, height_px=384):
        solve_recording(real_session_file, JobOptions(camera=small))


DATASETS = {
    # name: (views used at least, spread of the board in mm at most, truth error in mm or None)
    "ur5-chessboard": (19, 6.0, None),
    "charuco-eye-to-hand": (14, 4.0, None),
    "denso-long": (40, 15.0, None),
    "six-views": (6, 2.0, None),
    "rendered-truth": (24, 0.5, 1.0),
    "rendered-truth-eye-to-hand": (27, 2.0, 8.0),
    "far-small-board": (24, 4.0, 8.0),
}
WITHOUT_BOARD = {"far-small-board": (1, 2, *range(12, 30), *range(39, 45), 55, *range(57, 63))}
"""Rows of poses that are left out: looking long for a board that is not there is the same in the others."""


@pytest.fixture(scope="module")
def solved_set(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], SolvedRecording]:
    """Import and solve a folder of `datasets`, once."""

    @cache
    def solve(folder: Path) -> SolvedRecording:
        place = tmp_path_factory.mktemp("set")
        if left_out := WITHOUT_BOARD.get(folder.name):
            (place / "images").symlink_to(folder / "images")
            shutil.copyfile(folder / "dataset.yaml", place / "dataset.yaml")
            head, *rows = (folder / "poses.csv").read_text().splitlines()
            kept = [row for number, row in enumerate(rows) if number not in left_out]
            (place / "poses.csv").write_text("\n".join([head, *kept]))
            folder = place
        import_folder(folder, place / "r.mcap")
        return solve_recording(place / "r.mcap")

    return solve


@pytest.mark.parametrize("name", DATASETS)
def test_other_peoples_recordings_solve(datasets: Path, solved_set: SolveSet, name: str) -> None:
    fewest, spread_mm, truth_mm = DATASETS[name]
    job = solved_set(datasets / name)
    assert len(job.solution.evidence.views.used) >= fewest
    assert job.solution.judgement.figures.board_spread_mm < spread_mm
    assert job.solution.judgement.figures.certificate.certified
    if truth_mm is not None:
        truth = np.array(yaml.safe_load((datasets / name / "truth.yaml").read_text())["matrix"])
        assert error_mm_deg(job.solution.matrix, truth)[0] < truth_mm
        assert inside(job.solution, truth), "the simulated arm has errors of 0.1 mm that go with its position"


def test_a_slip_of_typing_in_a_real_list_of_poses_is_named_and_costs_one_number(
    datasets: Path, solved_set: SolveSet, tmp_path: Path
) -> None:
    shutil.copytree(datasets / "rendered-truth", tmp_path / "typed", copy_function=shutil.copyfile)
    poses = tmp_path / "typed/poses.csv"
    lines = poses.read_text().splitlines()
    image, x, y, *others = lines[6].split(",")
    lines[6] = ",".join([image, x, str(float(y) + 0.09), *others])
    poses.write_text("\n".join(lines) + "\n")
    typed, right = (
        solved_set(folder / name).solution
        for folder, name in ((tmp_path, "typed"), (datasets, "rendered-truth"))
    )
    (rejected,) = typed.evidence.views.rejected
    assert rejected.index == 5
    assert (rejected.kind, rejected.wrong_number) == ("wrong-number", 1)
    assert error_mm_deg(typed.matrix, right.matrix)[0] < 0.05


def with_poses(done: SolvedRecording) -> ViewSet:
    """Before the solver read any board otherwise."""
    return with_board_poses(done.loaded.views, done.loaded.board)[0]


def test_the_wrong_mount_of_a_real_recording_is_named(datasets: Path, solved_set: SolveSet) -> None:
    """An approximate X once made quaternions with w first look likelier."""
    views = replace(with_poses(solved_set(datasets / "charuco-eye-to-hand")), mount="eye-in-hand")
    poses = pose_views(views, 0.002, 0.003)
    assert explain_recording(poses).reading is Reading.INVERSE_POSES


def test_the_colours_decide_the_small_board_in_every_view(datasets: Path, solved_set: SolveSet) -> None:
    views = with_poses(solved_set(datasets / "rendered-truth-eye-to-hand"))
    assert len(views) == 29
    truth = np.array(
        yaml.safe_load((datasets / "rendered-truth-eye-to-hand/truth.yaml").read_text())["matrix"]
    )
    places = [np.linalg.inv(v.base_from_flange) @ truth @ v.camera_from_board for v in views]
    turns = [np.degrees(np.linalg.norm(difference(p, places[0])[3:])) for p in places]
    assert max(turns) < 5.0, "a view was read turned by 180°"


def test_options_leave_a_trace_and_threads_do_not(small_session_file: Path) -> None:
    options = JobOptions(working_distance_m=0.3, threads=1)
    job = solve_recording(small_session_file, replace(options, seed=4))
    assert job.calibration.provenance.options == {"working_distance_m": 0.3}
    assert job.calibration.provenance.seed == 4
