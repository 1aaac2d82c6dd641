"""Folders as other programs leave them: read as they are meant, asked about, or refused."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from benchmarks.misread_poses import MISREAD, said
from calibrate.files import exports
from calibrate.files.calibration import read_calibration, write_calibration
from calibrate.files.install import install
from calibrate.imported import Given, believe, board
from calibrate.job import JobOptions, solve_recording
from calibrate.kinematics import MODELS
from calibrate.report.page import report_page
from recordings.cli import main
from recordings.importers.conventions import possible
from recordings.importers.tables import look
from recordings.reader import open_recording
from recordings.schema.messages import BoardKind, BoardSpec, Mount
from tests.calibrate.chains import arm_cell
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

    def seen(lies, given, paths, progress):  # type: ignore[no-untyped-def]
        key = (given, json.dumps(lies.facts), len(paths))
        if key not in _SEEN:
            _SEEN[key] = board.see_board(lies, given, paths, progress)
        found = _SEEN[key]
        renamed = {path.name: path for path in paths}
        views = {renamed[path.name]: view for path, view in found.views.items()}
        candidates = {renamed[path.name]: each for path, each in found.candidates.items()}
        return replace(found, views=views, candidates=candidates)

    monkeypatch.setattr("calibrate.imported.folder.see_board", seen)
    return make


_SEEN: dict[object, board.Seen] = {}


def euler(order: str, unit: float = 1.0, degrees: bool = False) -> Callable[[np.ndarray], np.ndarray]:
    def rows(T: np.ndarray) -> np.ndarray:
        angles = Rotation.from_matrix(T[:, :3, :3]).as_euler(order, degrees=degrees)
        return np.column_stack([T[:, :3, 3] * unit, angles])

    return rows


def quaternions(T: np.ndarray, roll: int = 0) -> np.ndarray:
    return np.column_stack([T[:, :3, 3], np.roll(Rotation.from_matrix(T[:, :3, :3]).as_quat(), roll, 1)])


def kuka(folder: Path, T: np.ndarray) -> None:
    np.savetxt(folder / "robot_pose.csv", euler("ZYX", 1e3, True)(T), delimiter=",", header="X,Y,Z,A,B,C")


def rotation_vectors(folder: Path, T: np.ndarray) -> None:
    rotvec = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    rows = np.column_stack([T[:, :3, 3], rotvec]).tolist()
    (folder / "tcp_pose.txt").write_text("\n".join(f"[{row}]" for row in rows))


def matrices_in_blocks(folder: Path, T: np.ndarray) -> None:
    T = T.copy()
    T[:, :3, 3] *= 1000
    (folder / "gripper2base.txt").write_text(f"{len(T)}\n")
    with (folder / "gripper2base.txt").open("a") as file:
        for each in T:
            np.savetxt(file, each)
            file.write("\n")


def one_matrix_each(folder: Path, T: np.ndarray) -> None:
    """As a simulator's plugin writes them beside its images: the TCP in base, rows of text."""
    for n, each in enumerate(T, 1):
        np.savetxt(folder / f"tcp_pose{n:05d}.txt", each)


def one_yaml_each(folder: Path, T: np.ndarray) -> None:
    (folder / "tcp_pose").mkdir()
    for n, row in enumerate(quaternions(T), 1):
        keys = ("x", "y", "z", "qx", "qy", "qz", "qw")
        lines = (f"{key}: {value!r}" for key, value in zip(keys, row.tolist(), strict=True))
        (folder / f"tcp_pose/{n}.yaml").write_text("\n".join(sorted(lines)))


def opencvs_yaml(folder: Path, T: np.ndarray, name: str = "end2base.yml") -> None:
    file = cv2.FileStorage(str(folder / name), cv2.FILE_STORAGE_WRITE)
    for n, each in enumerate(T):
        file.write(f"pose_{n}", each)
    file.release()


opencvs_xml = partial(opencvs_yaml, name="end2base.xml")


def json_by_image(folder: Path, T: np.ndarray) -> None:
    rows = [
        {
            "robot": "UR10",
            "image": f"{n + 1}.png",
            "robot_pose": {"position": row[:3], "orientation": row[3:]},
        }
        for n, row in enumerate(quaternions(T, 1).tolist())
    ]
    (folder / "samples.json").write_text(json.dumps(rows[::-1]))


def arrays(folder: Path, T: np.ndarray) -> None:
    np.savez(folder / "arm_poses.npz", arm_pose=euler("xyz")(T))


@pytest.mark.parametrize(
    "write",
    [
        kuka,
        rotation_vectors,
        matrices_in_blocks,
        one_matrix_each,
        one_yaml_each,
        opencvs_yaml,
        opencvs_xml,
        json_by_image,
        arrays,
    ],
)
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


def unnamed(folder: Path, T: np.ndarray) -> None:
    np.savetxt(folder / "poses.txt", euler("ZYX", 1e3, True)(T))


def of_a_frame_at_the_table(T: np.ndarray) -> np.ndarray:
    """As arms with a user frame tell them: board and camera are as near to both frames."""
    return np.linalg.inv(BOARD_PLACE) @ T


def halves_in_files(folder: Path, T: np.ndarray) -> None:
    """As OpenCV's hand-eye calls take them."""
    np.save(folder / "R_gripper2base.npy", T[:, :3, :3])
    np.save(folder / "t_gripper2base.npy", T[:, :3, 3])


def halves_under_headings(folder: Path, T: np.ndarray) -> None:
    R = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    text = (
        f"{n}:\nRotation:\n{R[n].tolist()}\nTranslation:\n{T[n, :3, 3].tolist()}\n" for n in range(len(T))
    )
    (folder / "robot.txt").write_text("\n".join(text))


def stamped(folder: Path, T: np.ndarray) -> None:
    np.savetxt(folder / "tcp.txt", np.column_stack([1.6e9 + np.arange(len(T)) / 7, quaternions(T)]))


def numbered_turn_first(folder: Path, T: np.ndarray) -> None:
    turn = Rotation.from_matrix(T[:, :3, :3]).as_rotvec(degrees=True)
    rows = np.column_stack([3 * np.arange(1, len(T) + 1), turn, 1e3 * T[:, :3, 3]])
    np.savetxt(folder / "robot.csv", rows, delimiter=",")


def matlabs(folder: Path, T: np.ndarray) -> None:
    savemat(folder / "poses.mat", {"robotPoses": euler("XYZ", 1, True)(T)})


@pytest.mark.parametrize(
    "write", [halves_in_files, halves_under_headings, stamped, numbered_turn_first, matlabs]
)
def test_poses_are_found_in_whatever_holds_them(write: Write, tmp_path: Path) -> None:
    """What their numbers allow is among what the images may decide."""
    T = TURNED.flange_poses()[0]
    write(tmp_path, T)
    (table,) = (table for table in look(tmp_path).tables if table.whose in ("robot", ""))
    assert any(np.allclose(how.poses(table.numbers), T, atol=1e-6) for how, _ in possible(table.numbers))


def test_what_nothing_tells_is_asked(put: Callable[..., Path], images: tuple[Path, np.ndarray]) -> None:
    """A camera in hand looks like a fixed one with inverted poses."""
    lies, told = look(put(unnamed, of_a_frame_at_the_table)), of_a_frame_at_the_table(images[1])
    with raises("which-mount", mount="eye-in-hand"):
        believe(lies)
    with raises("which-mount"):
        believe(lies, Given("euler-ZYX-deg-mm"))
    assert believe(lies, Given("kuka-abc")).dataset.mount == "eye-in-hand"  # always the tool in the base
    straight = believe(lies, Given(mount="eye-in-hand"))
    np.testing.assert_allclose([row.base_from_flange for row in straight.rows], told, atol=1e-6)
    turned = np.array([row.base_from_flange for row in believe(lies, Given(mount="eye-to-hand")).rows])
    np.testing.assert_allclose(turned, np.linalg.inv(told), atol=1e-6)


@pytest.mark.parametrize("change", [lambda T: T, np.linalg.inv])
def test_distances_of_camera_and_board_contradict_but_do_not_tell_the_mounting_alone(
    change: Callable[[np.ndarray], np.ndarray], put: Callable[..., Path], images: tuple[Path, np.ndarray]
) -> None:
    """A frame at the table or a camera near the base would deceive them."""
    folder = put(unnamed, change)
    assert look(folder, Path("poses.txt")).told and not look(folder, Path("others")).told
    with raises("which-mount"):
        believe(look(folder))
    found = believe(look(folder), Given(mount="eye-in-hand"))
    np.testing.assert_allclose([row.base_from_flange for row in found.rows], images[1], atol=1e-6)
    with raises("which-mount"):
        believe(look(folder), Given(mount="eye-to-hand"))
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
    with raises("no-reading"):
        believe(look(put(kuka, lambda T: camera_from_board)))


def test_what_was_believed_needs_no_flags_again(put: Callable[..., Path], tmp_path: Path) -> None:
    folder, out = put(unnamed, of_a_frame_at_the_table), tmp_path / "mine.mcap"
    assert call(main, "import", folder, "-o", out).returncode == 1
    told = call(main, "import", folder, "-o", out, "--mount", "eye-in-hand", "--json")
    assert told.returncode == 0, told.stderr
    assert json.loads(told.stdout)["found"]["mount"][0] == "eye-in-hand"
    first = open_recording(out)
    out.unlink()
    assert call(main, "import", folder, "-o", out).returncode == 0
    assert open_recording(out).views() == first.views()
    assert first.info.mount == "eye-in-hand"
    assert first.info.robot.model not in MODELS
    out.unlink()
    other = shutil.copytree(folder, tmp_path / "other")
    assert call(main, "import", other, "-o", out).returncode == 1, "what is believed of one holds of no other"
    assert call(main, "import", folder, "-o", out, "--mount", "eye-to-hand").returncode == 0
    assert open_recording(out).info.mount == "eye-to-hand"  # what is said now counts, and from now on
    out.unlink()
    assert call(main, "import", folder, "-o", out).returncode == 0
    assert open_recording(out).info.mount == "eye-to-hand"


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
    (tmp_path / "packed/data.zip").touch()
    with raises("no-pairs") as refused:
        believe(look(tmp_path / "packed"))
    assert "data.zip" in refused.value.values["images"]
    (pointer := tmp_path / "1.png").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n")
    with raises("bad-image", image="1.png"):
        board.see_board(look(pointer), None, [pointer], lambda *_: None)


def named_parts(T: np.ndarray) -> list[dict[str, dict[str, float]]]:
    return [
        {
            "translation": dict(zip("xyz", row[:3], strict=True)),
            "rotation": dict(zip("xyzw", row[3:], strict=True)),
        }
        for row in quaternions(T).tolist()
    ]


def easy_handeyes(folder: Path, robot: np.ndarray, board: np.ndarray) -> None:
    tables = (("hand_world_samples", robot), ("camera_marker_samples", board))
    samples = {name: {"transforms": named_parts(T)} for name, T in tables}
    (folder / "samples.yaml").write_text(json.dumps(samples))


def easy_handeye2s(folder: Path, robot: np.ndarray, board: np.ndarray) -> None:
    pairs = zip(named_parts(robot), named_parts(board), strict=True)
    rows = [{"robot": F, "tracking": C} for F, C in pairs]
    (folder / "cell.samples").write_text(json.dumps({"parameters": {"name": ""}, "samples": rows}))


def in_two_tables(folder: Path, robot: np.ndarray, board: np.ndarray) -> None:
    """Another convention and unit each."""
    np.savetxt(folder / "robot.txt", euler("ZYX", 1e3, True)(robot), delimiter=",")
    rotvec = Rotation.from_matrix(board[:, :3, :3]).as_rotvec()
    np.savetxt(folder / "marker.csv", np.column_stack([board[:, :3, 3], rotvec]), delimiter=",")


def moveits(folder: Path, robot: np.ndarray, board: np.ndarray) -> None:
    rows = [
        {"effector_wrt_world": F.ravel().tolist(), "object_wrt_sensor": C.ravel().tolist()}
        for F, C in zip(robot, board, strict=True)
    ]
    (folder / "poses.yaml").write_text(json.dumps(rows))


def in_one_csv(folder: Path, robot: np.ndarray, board: np.ndarray) -> None:
    names = [f"{of}_{n}" for of in ("flange", "board") for n in ("x", "y", "z", "qx", "qy", "qz", "qw")]
    rows = np.column_stack([quaternions(robot), quaternions(board)])
    np.savetxt(folder / "pairs.csv", rows, delimiter=",", header=",".join(names), comments="")


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


def test_circles_that_nobody_described_are_found(tmp_path: Path) -> None:
    circles = BoardSpec(BoardKind.ASYMMETRIC_CIRCLES, 4, 7, 0.012)
    recording = open_recording(write_session(tmp_path / "s.mcap", Scene(circles, views=8)))
    for view, image in recording.images():
        pixels = image.pixels.copy()
        for n in range(view.index % 3):  # screws of the table, as large
            cv2.circle(pixels, (20 + 45 * n, 20), 6, 0, cv2.FILLED)
        cv2.imwrite(str(tmp_path / f"{view.index}.png"), pixels)
    seen = board.see_board(look(tmp_path), None, sorted(tmp_path.glob("*.png")), lambda *_: None)
    assert seen is not None
    assert (seen.board.kind, seen.board.columns, seen.board.rows) == (circles.kind, 4, 7)


MOVEIT = Path(__file__).parents[3] / "shared/datasets/pose-pairs/moveit50.csv"


@pytest.mark.parametrize("write", [easy_handeyes, easy_handeye2s, in_two_tables, moveits, in_one_csv])
def test_pairs_of_poses_are_a_recording_without_pictures(
    write: Callable[[Path, np.ndarray, np.ndarray], None], tmp_path: Path
) -> None:
    """Solved; what needs pictures is judged by no gate, and a lens is not invented."""
    robot, board = TURNED.flange_poses()[0], TURNED.camera_from_board()
    write(tmp_path, robot, board)
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
    robot, board = TURNED.flange_poses()[0].copy(), np.array(TURNED.camera_from_board())
    np.savetxt(tmp_path / "b.txt", quaternions(board))
    for noise_m in (0.0, 0.03):
        robot[:, :3, 3] += noise_m * rng.standard_normal((len(robot), 3))
        rotation_vectors(tmp_path, robot)
        (tmp_path / "tcp_pose.txt").rename(tmp_path / "a.txt")
        with raises("no-pairs"):
            believe(look(tmp_path))
        lies = look(tmp_path, Path("a.txt"))
        if noise_m:
            with raises("no-reading", nearest="a.txt: eye-in-hand, rotvec"):
                believe(lies, Given(mount="eye-in-hand"))
        found = believe(lies, Given("ur-rotvec", "eye-in-hand"))
        np.testing.assert_allclose([row.base_from_flange for row in found.rows], robot, atol=1e-6)
        with raises("no-reading" if noise_m else "other-convention"):
            believe(lies, Given("euler-ZYX", "eye-in-hand"))


@pytest.mark.skipif(not MOVEIT.is_file(), reason="the pose pairs of MoveIt's own test are not here")
def test_moveits_own_pairs_give_what_its_test_expects(tmp_path: Path) -> None:
    rec = tmp_path / "pairs.mcap"
    assert call(main, "import", MOVEIT, "-o", rec, "--mount", "eye-to-hand").returncode == 0
    at = solve_recording(rec).solution.matrix[:3, 3]
    np.testing.assert_allclose(at, [0.659, -0.249, 0.830], rtol=0.01)
