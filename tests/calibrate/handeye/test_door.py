"""The solver is a library: its documented example runs in an empty folder, and its names load on demand."""

import inspect
import subprocess
import sys
import textwrap

import numpy as np
import pytest

import calibrate.handeye
from calibrate import JobOptions
from calibrate.errors import BadViewsError, UsageError
from calibrate.handeye import (
    BoardView,
    Corners,
    MeasurementNoise,
    SolveOptions,
    ViewSet,
    solve_views,
    view_information,
)
from tests.calibrate.cells import LOW, make_cell
from tests.codes import raises

CELL = make_cell(np.random.default_rng(0), 8, LOW)
F, C = CELL.views.base_from_flange, CELL.views.camera_from_board
BOARD = CELL.views.views[0].corners.points


def informed(mount="eye-in-hand", flange=F, X=CELL.X, points=BOARD):
    return view_information(mount, CELL.views.camera, flange, X, CELL.Y, points, MeasurementNoise())


def test_lists_are_taken_like_arrays():
    of_lists = ViewSet.from_poses("eye-in-hand", F.tolist(), list(C))
    of_arrays = ViewSet.from_poses("eye-in-hand", F, C)
    quick = SolveOptions(holdout=False, folds=False)
    np.testing.assert_array_equal(solve_views(of_lists, quick).matrix, solve_views(of_arrays, quick).matrix)
    lists = informed("eye-in-hand", F.tolist(), CELL.X.tolist(), BOARD.tolist())
    np.testing.assert_array_equal(lists, informed())
    view = BoardView(0, "a", F[0].tolist(), Corners([], []), camera_from_board=C[0].tolist())
    assert view.base_from_flange.shape == (4, 4) and view.corners.pixels.shape == (0, 2)


@pytest.mark.parametrize("mount", ["eye_in_hand", "eye-in-Hand", "", None])
@pytest.mark.parametrize(
    "made",
    [
        lambda mount: ViewSet.from_poses(mount, F, C),
        lambda mount: ViewSet(mount, CELL.views.views, CELL.views.camera),
        informed,
    ],
    ids=["from_poses", "ViewSet", "view_information"],
)
def test_a_misspelt_mount_is_refused(made, mount):
    with raises("choice", UsageError, name="mount", given=str(mount)):
        made(mount)


@pytest.mark.parametrize(
    "made", [lambda: SolveOptions(profile="robst"), lambda: JobOptions(lens_model="plumb-bob")]
)
def test_a_misspelt_choice_is_refused(made):
    with raises("choice", UsageError):
        made()


@pytest.mark.parametrize(
    "made",
    [
        lambda: ViewSet.from_poses("eye-in-hand", F[:, :3], C),
        lambda: ViewSet.from_poses("eye-in-hand", F[0], C),
        lambda: ViewSet.from_poses("eye-in-hand", F, C[:-1]),
        lambda: ViewSet.from_poses("eye-in-hand", F, [*C[:-1].tolist(), [1.0]]),
        lambda: ViewSet.from_poses("eye-in-hand", F, None),
        lambda: BoardView(0, "a", F[0], Corners(np.zeros((4, 2)), np.zeros((4, 2)))),
        lambda: BoardView(0, "a", F[0], Corners(np.zeros((4, 3)), np.zeros((4, 2))), np.zeros(8)),
        lambda: informed(flange=F[:, :3]),
        lambda: informed(X=CELL.X[:3]),
        lambda: informed(points=BOARD[:, :2]),
        lambda: solve_views(CELL.views, SolveOptions(lens_sigma=(1.0, 2.0))),
    ],
)
def test_a_wrong_shape_is_refused(made):
    with raises("shape", BadViewsError):
        made()


def test_the_example_of_the_room_runs(tmp_path):
    cell = make_cell(np.random.default_rng(0), 8, LOW)
    poses = {
        "base_from_flange": cell.views.base_from_flange,
        "camera_from_board": cell.views.camera_from_board,
    }
    np.savez(tmp_path / "poses.npz", **poses)
    text = inspect.getdoc(calibrate.handeye) or ""
    example = textwrap.dedent(text[text.index("    import") : text.index("With corners")])
    assert len(example.strip().splitlines()) <= 11
    program = example + f"assert abs(flange_from_camera - np.array({cell.X.tolist()})).max() < 2e-3"
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True)
