"""Folders as other programs leave them: read as they are meant, asked about, or refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from benchmarks.misread_poses import MISREAD, said
from calibrate.arms.classes import ARM_CLASSES
from calibrate.files import exports
from calibrate.files.calibration import read_calibration, write_calibration
from calibrate.files.install import install
from calibrate.imported import Given, believe, board
from calibrate.imported.described import described
from calibrate.lens.pnp import Candidate
from calibrate.pipeline.job import JobOptions, solve_recording
from calibrate.report.page import report_page
from recordings.cli import main
from recordings.errors import SeveralReadingsError
from recordings.importers.conventions import possible
from recordings.importers.dataset import read_dataset
from recordings.importers.tables import look
from recordings.reader import open_recording
from recordings.schema.messages import BoardKind, BoardSpec, Mount, RobotIdentity
from tests.calibrate.chains import arm_cell
from tests.calibrate.pose_files import (
    HOLDERS,
    IMAGES,
    PAIRS,
    euler,
    in_two_tables,
    kuka,
    quaternions,
    rotation_vectors,
    unnamed,
)
from tests.calibrate.sessions import BOARD_PLACE, Scene, write_session
from tests.codes import raises
from tests.command_line import call

Write = Callable[[Path, np.ndarray], None]
TURNED = Scene(views=12)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A folder of images, and base_from_flange (n, 4, 4) at each."""
    folder = tmp_path_factory.mktemp("camera")
    recording = open_recording(write_session(folder / "session.mcap", TURNED))
    for view, image in recording.images():
        cv2.imwrite(str(folder / f"{view.index + 1}.png"), image.pixels)
    (folder / "session.mcap").unlink()
    return folder, np.array([view.base_from_flange for view in recording.views()])


@pytest.fixture
def put(
    images: tuple[Path, np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Path]:
    """Copy the images beside poses that `write` writes; the board is looked for once for all tests."""

    def make(write: Write, change: Callable[[np.ndarray], np.ndarray] = lambda T: T) -> Path:
        folder = tmp_path / "data"
        folder.mkdir()
        for path in images[0].iterdir():
            (folder / path.name).hardlink_to(path)
        write(folder, change(images[1]))
        return folder

    def seen(held, given, paths, progress):
        key = (given, described(held.facts), len(paths))
        if key not in _SEEN:
            _SEEN[key] = board.see_board(held, given, paths, progress)
        found = _SEEN[key]
        renamed = {path.name: path for path in paths}
        views = {renamed[path.name]: view for path, view in found.views.items()}
        candidates = {renamed[path.name]: each for path, each in found.candidates.items()}
        return replace(found, views=views, candidates=candidates)

    monkeypatch.setattr("calibrate.imported.folder.see_board", seen)
    return make


_SEEN: dict[object, board.Seen] = {}


@pytest.mark.parametrize("write", IMAGES)
def test_poses_are_read_as_they_are_meant(
    write: Write, put: Callable[..., Path], images: tuple[Path, np.ndarray]
) -> None:
    found = believe(look(put(write)))
    assert found.dataset.mount == "eye-in-hand"
    for n, T in enumerate(images[1], 1):
        (row,) = (row for row in found.rows if row.image == f"{n}.png")
        np.testing.assert_allclose(row.base_from_flange, T, atol=1e-6)
    shown, true = found.dataset.board, TURNED.board
    assert {shown.columns, shown.rows} == {true.columns, true.rows}
    assert shown.square_m == pytest.approx(true.square_m, rel=0.02)


def with_noise(poses: np.ndarray, sigma_m: float) -> np.ndarray:
    """As an arm tells them that misses by so much, each pose by itself."""
    noisy = poses.copy()
    noisy[:, :3, 3] += np.random.default_rng(7).normal(0.0, sigma_m, (len(poses), 3))
    return noisy


@pytest.mark.parametrize("sigma_m", [0.0, 0.002])
def test_squares_that_nobody_told_keep_what_the_arm_says_of_them(
    put: Callable[..., Path], images: tuple[Path, np.ndarray], tmp_path: Path, sigma_m: float
) -> None:
    """A guess is not rounded to what looks well, is never called stated, and holds within its sigma."""
    folder = put(HOLDERS[0], lambda poses: with_noise(poses, sigma_m))
    found = believe(look(folder)).dataset.board
    assert found.square_guessed and found.square_tolerance is not None
    assert abs(found.square_m / TURNED.board.square_m - 1) < found.square_tolerance
    rec = tmp_path / "guessed.mcap"
    assert call(main, "import", folder, "-o", rec, "--json").returncode == 0
    solved = solve_recording(rec)
    assert solved.calibration.board.square_guessed
    shape = solved.calibration.quality.board
    square_m = found.square_m * (1 + shape.scale)
    assert abs(square_m - TURNED.board.square_m) < 4 * shape.sigma[0] * found.square_m
    assert shape.sigma[1] < 0.004, "how square they are is known as for any print"
    file = tmp_path / "guessed.yaml"
    write_calibration(solved.calibration, file)
    assert read_calibration(file).board == solved.calibration.board


def test_where_two_sizes_that_people_print_fit_it_is_asked(put: Callable[..., Path]) -> None:
    folder = put(HOLDERS[0], lambda poses: with_noise(poses, 0.004))
    with raises("square-unclear"):
        believe(look(folder))
    told = believe(look(folder), Given(board=TURNED.board)).dataset.board
    assert not told.square_guessed and told.square_m == TURNED.board.square_m


def of_a_frame_at_the_table(T: np.ndarray) -> np.ndarray:
    """As arms with a user frame tell them: board and camera are as near to both frames."""
    return np.linalg.inv(BOARD_PLACE) @ T


@pytest.mark.parametrize("write", HOLDERS)
def test_poses_are_found_in_whatever_holds_them(write: Write, tmp_path: Path) -> None:
    """What their numbers allow is among what the images may decide."""
    T = TURNED.flange_poses()[0]
    write(tmp_path, T)
    (table,) = (table for table in look(tmp_path).tables if table.whose in ("robot", ""))
    assert any(np.allclose(how.poses(table.numbers), T, atol=1e-6) for how, _ in possible(table.numbers))


def test_what_nothing_tells_is_asked(put: Callable[..., Path], images: tuple[Path, np.ndarray]) -> None:
    """A camera in hand looks like a fixed one with inverted poses."""
    held, told = look(put(unnamed, of_a_frame_at_the_table)), of_a_frame_at_the_table(images[1])
    with raises("which-mount", mount="eye-in-hand"):
        believe(held)
    with raises("which-mount"):
        believe(held, Given("euler-ZYX-deg-mm"))
    assert believe(held, Given("kuka-abc")).dataset.mount == "eye-in-hand"  # always the tool in the base
    straight = believe(held, Given(mount="eye-in-hand"))
    np.testing.assert_allclose([row.base_from_flange for row in straight.rows], told, atol=1e-6)
    turned = np.array([row.base_from_flange for row in believe(held, Given(mount="eye-to-hand")).rows])
    np.testing.assert_allclose(turned, np.linalg.inv(told), atol=1e-6)


def test_distances_confirm_poses_of_the_tool_in_the_base(put: Callable[..., Path]) -> None:
    """Arms tell them, so that one hint to the same is enough."""
    found = believe(look(put(unnamed)))
    assert (found.dataset.mount, found.dataset.poses.convention) == ("eye-in-hand", "euler-ZYX-deg-mm")


def test_distances_of_camera_and_board_contradict_but_do_not_say_alone_that_poses_are_inverted(
    put: Callable[..., Path], images: tuple[Path, np.ndarray]
) -> None:
    """A frame at the table or a camera near the base would deceive them."""
    folder = put(unnamed, np.linalg.inv)
    assert look(folder, Path("poses.txt")).told and not look(folder, Path("others")).told
    with raises("which-mount"):
        believe(look(folder))
    found = believe(look(folder), Given(mount="eye-in-hand"))
    np.testing.assert_allclose([row.base_from_flange for row in found.rows], images[1], atol=1e-6)
    against = believe(look(folder), Given(mount="eye-to-hand"))
    assert against.dataset.mount == "eye-to-hand", "what is told wins over what deceives now and then"
    turned = np.linalg.inv(images[1])
    np.testing.assert_allclose([row.base_from_flange for row in against.rows], turned, atol=1e-6)
    (folder / "rig-eih.txt").write_text("of a camera in hand")
    assert believe(look(folder)).dataset.mount == "eye-in-hand"
    (folder / "rig-eih.txt").unlink()
    (folder / "eye_to_hand.txt").write_text("of a fixed camera")
    with raises("which-mount"):
        believe(look(folder))


def test_a_folder_of_images_named_like_poses_says_nothing_of_the_board(put: Callable[..., Path]) -> None:
    folder = put(kuka)
    (folder / "cam2board").mkdir()
    for path in folder.glob("*.png"):
        path.rename(folder / "cam2board" / path.name)
    assert believe(look(folder)).dataset.mount == "eye-in-hand"


@pytest.mark.parametrize("what", MISREAD)
def test_a_mistake_is_named_or_read_as_meant(
    what: str, put: Callable[..., Path], images: tuple[Path, np.ndarray]
) -> None:
    """The same on other people's recordings: `benchmarks/misread_poses.py`."""
    case = MISREAD[what]
    answer = said(case, images[1], "eye-in-hand", look(put(lambda folder, T: None)))
    assert answer in case.says.split()


def test_the_boards_own_poses_are_not_taken_for_the_robots(put: Callable[..., Path]) -> None:
    """They agree with the images perfectly."""
    camera_from_board = np.array(TURNED.camera_from_board())
    with raises("boards-own-poses", table="robot_pose.csv"):
        believe(look(put(kuka, lambda T: camera_from_board)))


def test_centimetres_are_told_by_a_board_and_asked_about_without_one(
    put: Callable[..., Path], images: tuple[Path, np.ndarray]
) -> None:
    """No arm ends at 80 mm."""

    def centimetres(folder: Path, T: np.ndarray) -> None:
        np.savetxt(folder / "tcp_pose.csv", euler("ZYX", 1e2, True)(T), delimiter=",")

    folder, board_told = put(centimetres), TURNED.board
    with raises("several-readings") as asked:
        believe(look(folder))
    assert isinstance(asked.value, SeveralReadingsError)
    answers = [believe(look(folder), Given(**each.options)) for each in asked.value.readings]
    for found in (*answers[:1], believe(look(folder), Given(board=board_told))):
        by_name = {row.image: row.base_from_flange for row in found.rows}
        np.testing.assert_allclose(
            [by_name[f"{n}.png"] for n in range(1, len(images[1]) + 1)], images[1], atol=1e-6
        )
    assert answers[0].dataset.board.square_m == pytest.approx(board_told.square_m, rel=0.02)


def test_what_was_believed_needs_no_flags_again(put: Callable[..., Path], tmp_path: Path) -> None:
    folder, out = put(unnamed, of_a_frame_at_the_table), tmp_path / "mine.mcap"
    assert call(main, "import", folder, "-o", out).returncode == 1
    told = call(main, "import", folder, "-o", out, "--mount", "eye-in-hand", "--json")
    assert told.returncode == 0, told.stderr
    assert json.loads(told.stdout)["found"]["mount"][0] == "eye-in-hand"
    first = open_recording(out)
    out.rename(folder / "killed.mcap.part")  # an import into the folder that was killed
    assert call(main, "import", folder, "-o", out).returncode == 0
    assert open_recording(out).views() == first.views()
    assert first.info.mount == "eye-in-hand"
    assert first.info.robot == RobotIdentity(), "a folder's name is nobody's word on the arm"
    out.unlink()
    other = shutil.copytree(folder, tmp_path / "other")
    assert call(main, "import", other, "-o", out).returncode == 1, "what is believed of one holds of no other"
    assert call(main, "import", folder, "-o", out, "--mount", "eye-to-hand").returncode == 0
    assert open_recording(out).info.mount == "eye-to-hand"  # what is said now counts, and from now on
    out.unlink()
    assert call(main, "import", folder, "-o", out).returncode == 0
    assert open_recording(out).info.mount == "eye-to-hand"


def test_who_the_arm_is_is_kept_as_it_was_told(put: Callable[..., Path], tmp_path: Path) -> None:
    folder, out = put(kuka), tmp_path / "mine.mcap"
    told = call(main, "import", folder, "-o", out, "--mount", "eye-in-hand", "--arm-class", "seven-joints")
    assert told.returncode == 0, told.stderr
    seven = ARM_CLASSES["seven-joints"]
    assumed = f"{1e3 * seven.shift_m:g} mm and {1e3 * seven.turn_rad:g} mrad"
    assert assumed in told.stdout, "what is assumed as no joints are recorded"
    assert open_recording(out).info.robot == RobotIdentity(arm_class="seven-joints")
    out.unlink()
    assert call(main, "import", folder, "-o", out).returncode == 0
    assert open_recording(out).info.robot.arm_class == "seven-joints"
    beside = out.with_suffix(".dataset.yaml")  # as earlier versions wrote it
    kept = msgspec.structs.replace(read_dataset(beside)[0], robot=folder.name)
    beside.write_bytes(msgspec.yaml.encode(kept))
    out.unlink()
    assert call(main, "import", folder, "-o", out).returncode == 0
    assert open_recording(out).info.robot == RobotIdentity()
    wrong = call(main, "import", folder, "--dry-run", "--arm-class", "cheap", "--json")
    assert wrong.returncode == 2
    assert "industrial-six" in wrong.stderr


def test_a_described_folder_takes_no_options(tmp_path: Path) -> None:
    """They would be ignored."""
    for name in ("dataset.yaml", "poses.csv"):
        (tmp_path / name).touch()
    told = call(main, "import", tmp_path, "--dry-run", "--mount", "eye-in-hand", "--json")
    assert json.loads(told.stdout)["error"]["code"] == "described"


def test_a_folder_without_poses_or_images_says_what_is_there(
    put: Callable[..., Path], tmp_path: Path
) -> None:
    with raises("no-pairs", tables="none"):
        believe(look(put(lambda folder, T: None)))
    (tmp_path / "packed").mkdir()
    for name in ("data.zip", "poses.xlsx"):
        (tmp_path / "packed" / name).touch()
    lfs = "version https://git-lfs.github.com/spec/v1\noid sha256:0\n"
    (tmp_path / "packed" / "poses.csv").write_text(lfs)
    with raises("no-pairs") as refused:
        believe(look(tmp_path / "packed"))
    told = refused.value.values["images"]
    assert all(name in told for name in ("data.zip", "poses.xlsx", "poses.csv"))
    (pointer := tmp_path / "1.png").write_text(lfs)
    with raises("bad-image", image="1.png"):
        board.see_board(look(pointer), None, [pointer], lambda *_: None)


def test_a_lost_image_is_told_by_the_numbers_of_the_others(
    put: Callable[..., Path], images: tuple[Path, np.ndarray]
) -> None:
    folder = put(rotation_vectors)
    (folder / "5.png").unlink()
    for row in believe(look(folder)).rows:
        np.testing.assert_allclose(row.base_from_flange, images[1][int(row.image[:-4]) - 1], atol=1e-6)
    (folder / "12.png").unlink()
    with raises("no-pairs"):  # they may have been counted anew
        believe(look(folder))


@pytest.mark.parametrize("unit", [1.0, 180 / np.pi])
@pytest.mark.parametrize("told", [lambda T: T, np.linalg.inv])
@pytest.mark.parametrize(("arm", "mount"), [("ur", "eye-in-hand"), ("seven joints", "eye-to-hand")])
def test_recorded_joints_tell_the_mounting(
    arm: str, mount: Mount, told: Callable[[np.ndarray], np.ndarray], unit: float, tmp_path: Path
) -> None:
    """Their axes belong to the arm: to its poses and not to the inverses."""
    views = arm_cell(arm, mount, 0.1, 1, views=16).views
    in_two_tables(tmp_path, told(views.base_from_flange), views.camera_from_board)
    joints = np.array([view.joints_rad for view in views])
    np.savetxt(tmp_path / "joints.csv", unit * joints, fmt="%.4f", delimiter=",")
    found = believe(look(tmp_path))
    assert found.dataset.mount == mount
    poses = np.array([row.base_from_flange for row in found.rows])
    np.testing.assert_allclose(poses, views.base_from_flange, atol=1e-6)
    np.testing.assert_allclose([row.joints_rad for row in found.rows], joints, atol=1e-4)
    assert found.facts["mount"][1].startswith("by joints")


def test_joints_contradict_a_mounting_that_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are the arm's own motion, no hint: neither side is taken."""
    cell = arm_cell("ur", "eye-in-hand", 0.1, 1, views=16)
    paths = [tmp_path / f"{n}.png" for n in range(16)]
    for path in paths:
        cv2.imwrite(str(path), np.zeros((8, 8), np.uint8))
    seen = board.Seen(
        TURNED.board,
        True,
        dict(zip(paths, cell.views.views, strict=True)),
        {path: [Candidate(T, 0)] for path, T in zip(paths, cell.views.camera_from_board, strict=True)},
        cell.views.camera,
        True,
        16,
    )
    monkeypatch.setattr("calibrate.imported.folder.see_board", lambda held, given, paths, progress: seen)
    joints = np.array([view.joints_rad for view in cell.views.views])
    np.savetxt(tmp_path / "joints.csv", joints, fmt="%.6f", delimiter=",")
    rotation_vectors(tmp_path, cell.views.base_from_flange)
    assert believe(look(tmp_path), Given(mount="eye-in-hand")).dataset.mount == "eye-in-hand"
    with raises("joints-contradict", told="eye-to-hand", fits="eye-in-hand"):
        believe(look(tmp_path), Given(mount="eye-to-hand"))


def test_circles_that_nobody_described_are_found(tmp_path: Path) -> None:
    circles = BoardSpec(BoardKind.ASYMMETRIC_CIRCLES, 4, 7, 0.012)
    recording = open_recording(write_session(tmp_path / "s.mcap", Scene(circles, views=8)))
    for view, image in recording.images():
        pixels = image.pixels.copy()
        for n in range(view.index % 3):  # screws of the table, as large
            cv2.circle(pixels, (20 + 45 * n, 20), 6, 0, cv2.FILLED)
        cv2.imwrite(str(tmp_path / f"{view.index}.png"), pixels)
    seen = board.see_board(look(tmp_path), None, sorted(tmp_path.glob("*.png")), lambda *_: None)
    assert (seen.board.kind, seen.board.columns, seen.board.rows) == (circles.kind, 4, 7)


MOVEIT = Path(__file__).parents[4] / "shared/datasets/pose-pairs/moveit50.csv"


@pytest.mark.parametrize("write", PAIRS)
def test_pairs_of_poses_are_read_as_they_are_meant(
    write: Callable[[Path, np.ndarray, np.ndarray], None], tmp_path: Path
) -> None:
    robot, board = TURNED.flange_poses()[0], TURNED.camera_from_board()
    write(tmp_path, robot, board)
    rows = believe(look(tmp_path), Given(mount="eye-in-hand")).rows
    np.testing.assert_allclose([row.base_from_flange for row in rows], robot, atol=1e-6)
    np.testing.assert_allclose([row.camera_from_board for row in rows], board, atol=1e-6)
    if len(files := list(tmp_path.iterdir())) == 1:  # the robot's file holds the board's poses, too
        assert believe(look(tmp_path, files[0]), Given(mount="eye-in-hand")).rows == rows


def test_pairs_of_poses_are_a_recording_without_pictures(tmp_path: Path) -> None:
    """Solved; what needs pictures is judged by no gate, and a lens is not invented."""
    in_two_tables(tmp_path, TURNED.flange_poses()[0], TURNED.camera_from_board())
    rec, file = tmp_path / "pairs.mcap", tmp_path / "pairs.calibration.yaml"
    told = call(main, "import", tmp_path, "-o", rec, "--mount", "eye-in-hand", "--json")
    assert told.returncode == 0, told.stderr
    job = solve_recording(rec)
    np.testing.assert_allclose(job.solution.matrix, TURNED.X, atol=1e-5)
    gates = {gate.name for gate in job.gates}
    assert "cross_validation" in gates and not gates & {"view_rms_px", "coverage", "lens_pull"}
    assert "no-pictures" in job.calibration.quality.warning_codes
    write_calibration(job.calibration, file)
    assert not read_calibration(file).intrinsics.matrix
    for export in ("opencv", "ros-camera-info"):
        with raises("no-intrinsics"):
            exports.export(job.calibration, export)
    exports.export(job.calibration, "urdf")
    with raises("objection"):
        install(file, tmp_path / "root", cell="imported")
    assert "Not known" in report_page(job)
    with raises("board-unseen"):
        solve_recording(rec, JobOptions(square_m=0.025))
    with raises("pairs-only"):
        next(iter(open_recording(rec).images()))
    views = open_recording(rec).views()
    rec.unlink()
    assert call(main, "import", tmp_path, "-o", rec).returncode == 0  # as before
    assert open_recording(rec).views() == views


def test_one_of_two_tables_is_named_the_robots_and_a_reading_told_whole_is_taken(tmp_path: Path) -> None:
    """A poor arm is not refused for its noise: gates judge it. Told wrongly it is, by name."""
    rng = np.random.default_rng(3)
    robot, board = TURNED.flange_poses()[0][:8], np.array(TURNED.camera_from_board())[:8]
    np.savetxt(tmp_path / "b.txt", quaternions(board))
    for noise_m in (0.0, 0.03):
        robot[:, :3, 3] += noise_m * rng.standard_normal((len(robot), 3))
        rotation_vectors(tmp_path, robot)
        (tmp_path / "tcp_pose.txt").rename(tmp_path / "a.txt")
        with raises("which-poses"):
            believe(look(tmp_path))
        held = look(tmp_path, Path("a.txt"))
        found = believe(held, Given("ur-rotvec", "eye-in-hand"))
        np.testing.assert_allclose([row.base_from_flange for row in found.rows], robot, atol=1e-6)
        wrong = {"nearest": "a.txt: eye-in-hand, rotvec"} if noise_m else {"fits": "rotvec"}
        with raises("no-reading" if noise_m else "other-convention", **wrong) as refused:
            believe(held, Given("euler-ZYX", "eye-in-hand"))
        assert refused.value.values.get("options", []) == [], "nothing that was told is asked for"


@pytest.mark.skipif(not MOVEIT.is_file(), reason="the pose pairs of MoveIt's own test are not here")
def test_moveits_own_pairs_give_what_its_test_expects(tmp_path: Path) -> None:
    rec = tmp_path / "pairs.mcap"
    assert call(main, "import", MOVEIT, "-o", rec, "--mount", "eye-to-hand").returncode == 0
    solution = solve_recording(rec).solution
    np.testing.assert_allclose(solution.matrix[:3, 3], [0.659, -0.249, 0.830], rtol=0.01)
    assert solution.judgement.figures.certificate.certified


@pytest.mark.parametrize("counts", [(8, 8), (12, 6), (6, 14)])
def test_two_boards_in_a_set_are_told_apart(counts: tuple[int, int], tmp_path: Path) -> None:
    """The one that more corners show is taken alone, and the other one is named."""
    boards = BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025), BoardSpec(BoardKind.CHESSBOARD, 9, 6, 0.02)
    poses: list[np.ndarray] = []
    for seed, (shown, count) in enumerate(zip(boards, counts, strict=True)):
        recording = open_recording(
            write_session(tmp_path / f"{seed}.mcap", Scene(shown, views=count, seed=seed))
        )
        for view, image in recording.images():
            poses.append(np.array(view.base_from_flange))
            cv2.imwrite(str(tmp_path / f"{len(poses):02d}.png"), image.pixels)
        (tmp_path / f"{seed}.mcap").unlink()
    np.savetxt(tmp_path / "robot.txt", quaternions(np.array(poses)))
    found = believe(look(tmp_path), Given(mount="eye-in-hand"))
    taken = found.dataset.board
    (true,) = (each for each in boards if (each.columns, each.rows) == (taken.columns, taken.rows))
    (other,) = (each for each in boards if each is not true)
    assert taken.square_m == pytest.approx(true.square_m, rel=0.01)
    assert f"{other.columns}×{other.rows}" in found.facts["another"][0]
    assert "outliers" not in found.facts


CHARUCO = BoardSpec(BoardKind.CHARUCO, 6, 8, 0.03, 0.022, "DICT_5X5_100")


def shown_to_a_camera(folder: Path, shown: BoardSpec, views: int = 6) -> np.ndarray:
    """Write images of a board, and return the robot's poses."""
    recording = open_recording(write_session(folder / "s.mcap", Scene(shown, views=views)))
    poses = []
    for view, image in recording.images():
        poses.append(view.base_from_flange)
        cv2.imwrite(str(folder / f"{view.index}.png"), image.pixels)
    (folder / "s.mcap").unlink()
    return np.array(poses)


@pytest.mark.parametrize("legacy", [False, True])
def test_a_charuco_board_that_nobody_described_is_no_chessboard(legacy: bool, tmp_path: Path) -> None:
    true = msgspec.structs.replace(CHARUCO, legacy=legacy)
    np.savetxt(tmp_path / "robot.txt", quaternions(shown_to_a_camera(tmp_path, true)))
    found = believe(look(tmp_path), Given(mount="eye-in-hand")).dataset.board
    layout = ("kind", "columns", "rows", "legacy")
    assert [getattr(found, name) for name in layout] == [getattr(true, name) for name in layout]
    assert found.dictionary == "DICT_5X5_50"
    assert found.square_m == pytest.approx(true.square_m, rel=0.01)
    assert found.marker_m is not None and true.marker_m is not None
    assert found.marker_m / found.square_m == pytest.approx(true.marker_m / true.square_m, rel=0.05)


def test_a_charuco_board_of_an_unusual_layout_is_asked_about(tmp_path: Path) -> None:
    """Its markers begin with another number than 0."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    painted = cv2.aruco.CharucoBoard((6, 8), 0.03, 0.022, dictionary, np.arange(60, 84))
    flat = painted.generateImage((480, 640), marginSize=20)
    corners = np.array([[0, 0], [480, 0], [480, 640], [0, 640]], np.float32)
    rng = np.random.default_rng(0)
    paths = [tmp_path / f"{n}.png" for n in range(6)]
    for path in paths:
        seen_at = (corners + np.array([80, 60]) + rng.uniform(-25, 25, (4, 2))).astype(np.float32)
        H = cv2.getPerspectiveTransform(corners, seen_at)
        cv2.imwrite(str(path), cv2.warpPerspective(flat, H, (640, 760), borderValue=200))
    with raises("charuco-undescribed", dictionary="DICT_5X5_100"):
        board.see_board(look(tmp_path), None, paths, lambda *_: None)
