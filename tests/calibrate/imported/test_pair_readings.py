"""Two tables of poses without images: taken as they are meant, or asked about, never silently otherwise.

The truth is known: both mountings, tables told either way, in cameras with other axes, in four units.
"""

from __future__ import annotations

import io
import itertools
import json
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibrate.handeye.board_motion import boards_own_motion
from calibrate.handeye.solve import solve_views
from calibrate.imported import Believed, Given, believe, is_described
from calibrate.imported.directions import Told, directions, unit_named
from calibrate.views.corners import NO_CORNERS
from calibrate.views.view_set import BoardView, ViewSet
from recordings.cli import main
from recordings.errors import SeveralReadingsError
from recordings.geometry import inverse, pose
from recordings.importers.conventions import OPTICAL_FROM_AXES
from recordings.importers.tables import look
from recordings.reader import open_recording
from recordings.schema.messages import CameraAxes, CameraModel, Mount
from tests.calibrate.pose_files import quaternions
from tests.codes import raises
from tests.command_line import call

PER_METRE = {"m": 1.0, "mm": 1e3, "cm": 1e2, "inch": 1 / 0.0254}


@dataclass(frozen=True)
class Cell:
    """Poses of a robot and a board as a program wrote them, and as they are meant."""

    mount: Mount = "eye-in-hand"
    board_told: str = "camera-from-board"
    axes: CameraAxes = "optical"
    faces_camera: bool = True
    """The board's z points out of its face (tags), not into it (OpenCV's chessboards)."""
    unit: str = "m"
    outliers: int = 0
    views: int = 14
    seed: int = 0

    @property
    def truth(self) -> tuple[np.ndarray, np.ndarray]:
        """(base_from_flange, camera_from_board in the camera's own axes), both (n, 4, 4), metres."""
        rng = np.random.default_rng(self.seed)
        turned = Rotation.from_rotvec([0.1, -0.2, 1.4]).as_matrix()
        carried, stands = pose(turned, [0.045, -0.03, 0.065]), pose(np.eye(3), [0.48, 0.08, 0.015])
        if self.mount == "eye-to-hand":
            at, to = np.array([1.1, 0.1, 0.6]), np.array([0.45, 0.0, 0.4])
            z = (to - at) / np.linalg.norm(to - at)
            x = np.cross(z, [0.0, 0.0, 1.0])
            x /= np.linalg.norm(x)
            stands = pose(np.column_stack([x, np.cross(z, x), z]), at)
        boards = []
        for _ in range(self.views):
            tilt = Rotation.from_rotvec([*rng.uniform(-0.55, 0.55, 2), rng.uniform(-1.0, 1.0)])
            away = np.array([*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.35, 0.5)])
            face = np.diag([1.0, -1.0, -1.0]) if self.faces_camera else np.eye(3)
            boards.append(pose(tilt.as_matrix() @ face, away))
        C = np.array(boards)
        if self.mount == "eye-in-hand":
            flange = stands @ inverse(carried @ C)
        else:
            flange = stands @ C @ inverse(carried)
        noise = Rotation.from_rotvec(rng.normal(0, 3e-4, (len(C), 3))).as_matrix()
        flange = flange @ np.array([pose(R, rng.normal(0, 2e-4, 3)) for R in noise])
        flange[len(C) - self.outliers :, :3, 3] += rng.normal(0, 0.15, (self.outliers, 3))
        return flange, pose(np.array(OPTICAL_FROM_AXES[self.axes]).T, np.zeros(3)) @ C

    def write(self, folder: Path, robot: str = "robot", board: str = "marker", board_unit: str = "") -> Path:
        flange, C = self.truth
        told = inverse(C) if self.board_told == "board-from-camera" else C
        tables = {robot: in_unit(flange, self.unit), board: in_unit(told, board_unit or self.unit)}
        np.savez(folder / "samples.npz", **tables)
        return folder

    def is_read(self, found: Believed) -> bool:
        """Whether a reading is the one that is meant."""
        flange, C = self.truth
        read = [np.array([getattr(row, name) for row in found.rows]) for name in POSES]
        return found.dataset.mount == self.mount and all(map(near, read, (flange, C)))


POSES = ("base_from_flange", "camera_from_board")


def near(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.abs(one - other).max() < 1e-6)


def in_unit(T: np.ndarray, unit: str) -> np.ndarray:
    scaled = T.copy()
    scaled[:, :3, 3] *= PER_METRE[unit]
    return scaled


def answered(folder: Path, given: Given) -> Iterator[Believed]:
    """What is read, or what would be by each answer to the question."""
    try:
        yield believe(look(folder), given)
    except SeveralReadingsError as asked:
        for reading in asked.readings:
            yield believe(look(folder), replace(given, **reading.options))


CELLS = [
    *(
        Cell(mount, told, axes, faces)
        for mount, told, axes, faces in itertools.product(
            ("eye-in-hand", "eye-to-hand"),
            ("camera-from-board", "board-from-camera"),
            ("optical", "opengl", "ros"),
            (False, True),
        )
    ),
    *(
        Cell(mount, told, unit=unit)
        for mount, told, unit in itertools.product(
            ("eye-in-hand", "eye-to-hand"), ("camera-from-board", "board-from-camera"), ("cm", "inch")
        )
    ),
]
NAMES = {
    "camera-from-board": ("T_base_flange", "T_cam_marker"),
    "board-from-camera": ("T_base_flange", "T_marker_cam"),
}


def name_of(cell: Cell) -> str:
    face = "out" if cell.faces_camera else "in"
    return f"{cell.mount} {cell.board_told} {cell.axes} {face} {cell.unit}"


@pytest.mark.parametrize("named", ["robot", "robot and mount", "both"])
@pytest.mark.parametrize("cell", CELLS, ids=name_of)
def test_pairs_are_read_as_they_are_meant_or_asked_about(cell: Cell, named: str, tmp_path: Path) -> None:
    """Whatever is asked, one of the answers gives the poses as they are meant."""
    robot, board = NAMES[cell.board_told] if named == "both" else ("tcp_pose", "marker")
    given = Given(mount=cell.mount) if named == "robot and mount" else Given()
    found = list(answered(cell.write(tmp_path, robot, board), given))
    assert any(map(cell.is_read, found))
    if named == "both" and cell.unit == "m":
        assert len(found) == 1, "names tell both directions"


def test_what_opencv_writes_is_not_asked_about(tmp_path: Path) -> None:
    """Its chessboards have their z away from the camera: the inverse would have the camera behind them."""
    cell = Cell(faces_camera=False)
    found = believe(look(cell.write(tmp_path, "tcp_pose", "board")))
    assert cell.is_read(found)


def test_a_question_tells_each_readings_x_and_the_option_that_chooses_it(tmp_path: Path) -> None:
    """A scanner's log: the board's z out of its face, the camera told in the board."""
    cell = Cell(board_told="board-from-camera")
    with raises("several-readings", count=2) as asked:
        believe(look(cell.write(tmp_path, "tcp_pose", "marker")))
    assert isinstance(asked.value, SeveralReadingsError)
    X = {reading.options["board_pose"]: reading.translation_mm for reading in asked.value.readings}
    np.testing.assert_allclose(X["board-from-camera"], [45, -30, 65], atol=1)
    np.testing.assert_allclose(X["camera-from-board"], [480, 80, 15], atol=1)
    told = call(main, "import", tmp_path, "--dry-run", "--json")
    assert told.returncode == 2
    error = json.loads(told.stdout)["error"]
    assert error["code"] == "several-readings"
    assert len(error["values"]["options"]) == 2
    told_mm = sorted(error["values"]["translations_mm"])
    np.testing.assert_allclose(told_mm, [[45, -30, 65], [480, 80, 15]], atol=1)
    for options in error["values"]["options"]:
        assert call(main, "import", tmp_path, "--dry-run", *shlex.split(options)).returncode == 0


@pytest.mark.parametrize("answer", ["2\n", "5\n2\n", "\n"])
def test_at_a_terminal_a_number_answers_and_nothing_is_no_answer(
    answer: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (data := tmp_path / "data").mkdir()
    Cell(board_told="board-from-camera").write(data, "tcp_pose", "marker")

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr("sys.stdin", Terminal(answer))
    told = call(main, "import", data, "-o", tmp_path / "pairs.mcap")
    if answer.strip():
        assert told.returncode == 0, told.stderr
        assert open_recording(tmp_path / "pairs.mcap").info.mount == "eye-in-hand"
    else:
        assert told.returncode == 2
        assert not (tmp_path / "pairs.mcap").exists()


def test_tf_and_opencv_names_tell_directions() -> None:
    assert directions("R_gripper2base", "R_target2cam") == Told(False, False)
    assert directions("t_gripper#base", "t_cam#target") == Told(False, True)
    assert directions("T_base_ee", "T_cam_marker") == Told(False, False)
    assert directions("gripper_to_base", "target_to_camera") == Told(False, False)
    assert directions("base_to_hand", "camera_to_marker") == Told(same=True)  # tf, or maps of both
    assert directions("base_to_gripper", "target_to_camera") == Told(same=False)
    assert directions("arm", "camera_in_board") == Told(None, True)
    assert directions("samples.csv tcp", "board") == Told(False)
    assert directions("robot", "marker") == Told()
    assert unit_named("x_cm y_cm") == "cm"
    assert unit_named("tx_in rx pos_in_base") == "inch"
    assert unit_named("x_mm pos_in_base squares_cm") == ""


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_names_of_tf_are_one_school(mount: Mount, tmp_path: Path) -> None:
    cell = Cell(mount)
    found = list(answered(cell.write(tmp_path, "base_to_hand", "camera_to_marker"), Given()))
    assert any(map(cell.is_read, found))


@pytest.mark.parametrize("board_unit", ["m", "mm", "cm", "inch"])
@pytest.mark.parametrize("unit", ["m", "mm", "cm", "inch"])
def test_each_table_has_its_own_unit(unit: str, board_unit: str, tmp_path: Path) -> None:
    """The motions tell the ratio; no arm ends at 80 mm."""
    cell = Cell(unit=unit)
    cell.write(tmp_path, *NAMES["camera-from-board"], board_unit)
    found = list(answered(tmp_path, Given()))
    assert any(map(cell.is_read, found))
    if unit != board_unit:
        assert len(found) == 1


@pytest.mark.parametrize("unit", ["cm", "inch"])
def test_names_of_columns_tell_the_unit(unit: str, tmp_path: Path) -> None:
    cell, end = Cell(unit=unit), {"cm": "cm", "inch": "in"}[unit]
    flange, C = cell.truth
    names = [f"{of}_{part}" for of in ("flange", "board") for part in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    names = [f"{name}_{end}" if name[-2:] in ("_x", "_y", "_z") else name for name in names]
    rows = np.column_stack([quaternions(in_unit(T, unit)) for T in (flange, C)])
    np.savetxt(tmp_path / "pairs.csv", rows, delimiter=",", header=",".join(names), comments="")
    given = Given(mount="eye-in-hand", board_pose="camera-from-board")
    assert cell.is_read(believe(look(tmp_path), given))


@pytest.mark.parametrize("axes", ["opengl", "ros"])
@pytest.mark.parametrize("told", ["camera-from-board", "board-from-camera"])
def test_axes_that_are_told_make_the_camera_optical(axes: CameraAxes, told: str, tmp_path: Path) -> None:
    cell = Cell("eye-to-hand", told, axes)
    given = Given(camera_axes=axes, board_pose=told, mount=cell.mount)
    rows = believe(look(cell.write(tmp_path, "tcp_pose", "marker")), given).rows
    optical = replace(cell, axes="optical").truth[1]
    np.testing.assert_allclose([row.camera_from_board for row in rows], optical, atol=1e-6)
    assert call(main, "import", tmp_path, "-o", tmp_path / "p.mcap", *shell(given)).returncode == 0
    first = open_recording(tmp_path / "p.mcap").views()
    (tmp_path / "p.mcap").unlink()
    assert call(main, "import", tmp_path, "-o", tmp_path / "p.mcap").returncode == 0, "as before"
    assert open_recording(tmp_path / "p.mcap").views() == first


def shell(given: Given) -> Iterator[str]:
    for name, value in vars(given).items():
        if value:
            yield from (f"--{name.replace('_', '-')}", value)


def test_many_outliers_among_good_pairs_are_named_and_the_rest_is_taken(tmp_path: Path) -> None:
    cell = Cell(faces_camera=False, views=27, outliers=14)
    found = believe(look(cell.write(tmp_path, *NAMES["camera-from-board"])))
    assert cell.is_read(found)
    assert found.facts["outliers"][0].startswith("14 of 27")
    rng = np.random.default_rng(0)
    turned = Rotation.random(27, random_state=1).as_matrix()
    random = np.array([pose(R, rng.normal(0, 0.5, 3)) for R in turned])
    np.savez(tmp_path / "samples.npz", T_base_flange=random, T_cam_marker=cell.truth[1])
    with raises("no-reading"):
        believe(look(tmp_path))


def test_options_of_pairs_are_refused_where_images_show_the_board(tmp_path: Path) -> None:
    """They would be ignored."""
    for name in ("dataset.yaml", "poses.csv"):
        (tmp_path / name).touch()
    with raises("described"):
        is_described(tmp_path, None, "camera-from-board")


def seen_by_another_program(C: np.ndarray, change: str) -> np.ndarray:
    """The board's poses (n, 4, 4) of other squares, another lens, counted from another corner, and so on."""
    if change == "inverse":
        return inverse(C)
    if change == "another corner":
        return C @ pose(np.diag([-1.0, -1.0, 1.0]), [0.09, 0.06, 0.0])
    if change == "opengl":
        return pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3)) @ C
    told = C.copy()
    scale = {"as it is": 1.0, "another lens": np.array([1.0, 1.0, 1.07]), "squares": 1.2}[change]
    told[:, :3, 3] *= scale
    return told


CHANGES = ["as it is", "inverse", "another lens", "squares", "another corner", "opengl"]


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("faces_camera", [False, True])
def test_poses_of_the_board_are_not_a_robots(change: str, faces_camera: bool) -> None:
    C = Cell(faces_camera=faces_camera).truth[1]
    rng = np.random.default_rng(5)
    turned = Rotation.from_rotvec(rng.normal(0, 3e-3, (len(C), 3))).as_matrix()
    told = seen_by_another_program(C, change) @ np.array([pose(R, rng.normal(0, 5e-4, 3)) for R in turned])
    near_to = boards_own_motion(told, C)
    assert near_to is not None
    assert near_to.away_m < 0.007


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize("seed", range(8))
def test_a_robots_poses_are_never_the_boards(mount: Mount, seed: int) -> None:
    """Also of a camera that is parallel to the flange, above a frame that is parallel to the board."""
    flange, C = Cell(mount, seed=seed).truth
    assert boards_own_motion(flange, C) is None
    for offset in ([0.0, 0.0, 0.06], [0.05, 0.0, 0.0], [0.0, 0.03, 0.04]):
        X, Y = pose(np.eye(3), offset), pose(np.eye(3), [0.4, 0.1 * seed, 0.0])
        parallel = Y @ inverse(X @ C) if mount == "eye-in-hand" else X @ C @ inverse(Y)
        assert boards_own_motion(parallel, C) is None
    at_the_camera = pose(np.eye(3), [0.4, 0.1, 0.0]) @ inverse(C)  # a TCP that was set to the camera
    assert boards_own_motion(at_the_camera, C) is None


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_a_recording_of_the_boards_own_poses_is_not_solved(mount: Mount) -> None:
    C = Cell().truth[1]
    flange = inverse(C) if mount == "eye-in-hand" else C
    views = tuple(
        BoardView(n, str(n), F, NO_CORNERS, camera_from_board=T)
        for n, (F, T) in enumerate(zip(flange, C, strict=True))
    )
    with raises("boards-own-poses"):
        solve_views(ViewSet(mount, views, CameraModel(0, 0)))


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
@pytest.mark.parametrize("axes", ["opengl", "ros"])
def test_pairs_of_a_camera_whose_axes_are_not_optical_are_solved(
    axes: CameraAxes, mount: Mount, tmp_path: Path
) -> None:
    """X is of the frame in which the board was told, behind it or beside it as it may lie."""
    cell = Cell(mount, axes=axes)
    found = believe(look(cell.write(tmp_path, *NAMES["camera-from-board"])), Given(mount=mount))
    flange = np.array([row.base_from_flange for row in found.rows])
    solved = solve_views(
        ViewSet.from_poses(mount, flange, np.array([r.camera_from_board for r in found.rows]))
    )
    optical = solve_views(ViewSet.from_poses(mount, flange, replace(cell, axes="optical").truth[1]))
    turned = pose(np.array(OPTICAL_FROM_AXES[axes]), np.zeros(3))
    np.testing.assert_allclose(
        solved.fit.parent_from_child.matrix, optical.fit.parent_from_child.matrix @ turned, atol=1e-4
    )


def opencvs_rows(cell: Cell, robot: str, board: str) -> list[dict[str, object]]:
    flange, C = cell.truth
    rows: list[dict[str, object]] = []
    for F, T in zip(flange, C, strict=True):
        turn = Rotation.from_matrix(T[:3, :3]).as_rotvec().tolist()
        solved = {"rvec": turn, "tvec": T[:3, 3].tolist()}
        rows.append({robot: F.tolist(), **({board: solved} if board else solved)})
    return rows


@pytest.mark.parametrize("board", ["target", "board_pose", ""])
@pytest.mark.parametrize("faces_camera", [False, True])
def test_opencvs_rvec_and_tvec_are_a_rotation_vector_of_the_board_in_the_camera(
    board: str, faces_camera: bool, tmp_path: Path
) -> None:
    cell = Cell(faces_camera=faces_camera)
    (tmp_path / "samples.json").write_text(json.dumps(opencvs_rows(cell, "tcp_pose", board)))
    (table,) = (table for table in look(tmp_path).tables if table.whose == "board")
    assert table.rotation == "rotvec"
    assert cell.is_read(believe(look(tmp_path)))


def write_opencvs_columns(folder: Path, cell: Cell, robot: str, position: str, turn: str) -> Path:
    """One CSV whose columns are named by the robot's `x`, `y` … and by OpenCV's two halves of the board's."""
    flange, C = cell.truth
    rows = np.column_stack([quaternions(flange), C[:, :3, 3], Rotation.from_matrix(C[:, :3, :3]).as_rotvec()])
    names = [f"{robot}{part}" for part in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    names += [position.format(part) for part in "xyz"]
    names += [turn.format(part) for part in "xyz"]
    np.savetxt(folder / "pairs.csv", rows, delimiter=",", header=",".join(names), comments="")
    return folder


OPENCVS_COLUMNS = [
    ("tvec_{}", "rvec_{}"),
    ("board_tvec_{}", "board_rvec_{}"),
    ("tvec{}", "rvec{}"),
    ("t{}", "rvec_{}"),
]


@pytest.mark.parametrize("robot", ["tcp_pose_", "tcp_"])
@pytest.mark.parametrize(("position", "turn"), OPENCVS_COLUMNS)
def test_columns_of_opencvs_names_tell_the_form(position: str, turn: str, robot: str, tmp_path: Path) -> None:
    """A TCP is told in the base by every pendant, and OpenCV tells the board in the camera."""
    cell = Cell()
    assert cell.is_read(believe(look(write_opencvs_columns(tmp_path, cell, robot, position, turn))))


@pytest.mark.parametrize(("position", "turn"), OPENCVS_COLUMNS)
def test_columns_of_opencvs_names_are_the_boards_beside_an_unnamed_pose(
    position: str, turn: str, tmp_path: Path
) -> None:
    cell = Cell()
    with raises("several-readings", SeveralReadingsError):
        believe(look(write_opencvs_columns(tmp_path, cell, "", position, turn)))
    assert any(map(cell.is_read, answered(tmp_path, Given())))


def test_rvec_and_tvec_of_a_robot_stay_the_robots(tmp_path: Path) -> None:
    rows = [
        {"robot": row} for row in ({"rvec": [0.1 * n, 0, 1], "tvec": [0.3, 0.1 * n, 0.5]} for n in range(5))
    ]
    (tmp_path / "samples.json").write_text(json.dumps(rows))
    (table,) = look(tmp_path).tables
    assert (table.whose, table.rotation) == ("robot", "rotvec")


def test_columns_of_hand_and_eye_tell_the_two_sides_of_a_pair(tmp_path: Path) -> None:
    cell = Cell(faces_camera=False)
    flange, C = cell.truth
    names = [f"{of}_{part}" for of in "he" for part in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    rows = np.column_stack([quaternions(T) for T in (flange, C)])
    np.savetxt(tmp_path / "pairs.csv", rows, delimiter=",", header=",".join(names), comments="")
    assert {table.whose for table in look(tmp_path).tables} == {"robot", "board"}
    assert any(map(cell.is_read, answered(tmp_path, Given())))
