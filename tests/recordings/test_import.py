"""`recordings import`: a good folder becomes a recording, a bad one an error with file, row and remedy."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from recordings.cli import main
from recordings.exporters.folder import Target, export_recording
from recordings.importers.dataset import read_poses
from recordings.importers.folder import import_folder
from recordings.reader import open_recording
from recordings.schema.messages import BoardKind, matrix_from_quaternion
from tests.command_line import call
from tests.recordings.small_recording import BOARD, HEIGHT, WIDTH, make_image, refused

Change = Callable[[Path], object]


def edit(name: str, old: str, new: str) -> Change:
    def change(folder: Path) -> None:
        path = folder / name
        text = path.read_text()
        assert old in text, f"the test itself is wrong: no '{old}'"
        path.write_text(text.replace(old, new, 1))

    return change


def test_a_good_folder_becomes_a_recording(folder: Path, tmp_path: Path) -> None:
    done = import_folder(folder, tmp_path / "out.mcap")
    recording = open_recording(done.path)
    info = recording.info
    assert (info.name, info.mount, info.source, info.board) == ("pictures", "eye-in-hand", "imported", BOARD)
    assert (info.robot.model, info.note) == ("UR10", "made for a test")
    assert [v.source_file for v in recording.views()] == [f"images/{i}.png" for i in range(3)]
    turned = recording.views()[1].base_from_flange
    np.testing.assert_allclose(
        turned, [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]], atol=1e-12
    )
    for view, picture in recording.images():
        np.testing.assert_array_equal(picture.pixels, make_image(view.index))
    stored = recording.segments[0].stored_image(0)
    assert stored == ("png", (folder / "images/0.png").read_bytes())
    assert set(recording.attachments()) == {"dataset.yaml", "poses.csv"}
    assert done.images == 3


def test_other_formats_and_colour_are_stored_without_loss(folder: Path, tmp_path: Path) -> None:
    colour = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    deep = np.random.default_rng(1).integers(0, 65536, (HEIGHT, WIDTH)).astype(np.uint16)
    cv2.imwrite(str(folder / "images/0.bmp"), colour)
    cv2.imwrite(str(folder / "images/1.pgm"), make_image(1))
    cv2.imwrite(str(folder / "images/2.png"), deep)
    text = (folder / "poses.csv").read_text()
    (folder / "poses.csv").write_text(text.replace("0.png", "0.bmp").replace("1.png", "1.pgm"))
    recording = open_recording(import_folder(folder, tmp_path / "out.mcap").path)
    for (_, picture), expected in zip(recording.images(), [colour, make_image(1), deep], strict=True):
        np.testing.assert_array_equal(picture.pixels, expected)
        assert picture.pixels.dtype == expected.dtype
    assert [picture.pixel_format for _, picture in recording.images()] == ["BGR8", "Mono8", "Mono16"]


def test_a_byte_order_mark_spaces_and_crlf_are_fine(folder: Path, tmp_path: Path) -> None:
    text = (folder / "poses.csv").read_text().replace(",", ", ").replace("\n", "\r\n") + "\r\n"
    (folder / "poses.csv").write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert import_folder(folder, tmp_path / "out.mcap").images == 3


def with_joints(folder: Path, *joints: str) -> None:
    """Joints behind the poses, one text a row; the last one for all that follow."""
    header, *rows = (folder / "poses.csv").read_text().split()
    texts = [*joints, *[joints[-1]] * (len(rows) - len(joints))]
    lines = [f"{header},j1,j2,j3,j4,j5,j6", *(f"{row},{text}" for row, text in zip(rows, texts, strict=True))]
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")


def test_joints_behind_the_pose_reach_the_view(folder: Path, tmp_path: Path) -> None:
    with_joints(folder, "0.1,-1.5,1.5,-1,-1.57,3.2", ",,,,,")
    views = open_recording(import_folder(folder, tmp_path / "r.mcap").path).views()
    assert views[0].joints_rad == (0.1, -1.5, 1.5, -1.0, -1.57, 3.2)
    assert views[1].joints_rad is None, "empty cells: not known for that picture"
    out = export_recording(open_recording(tmp_path / "r.mcap"), tmp_path / "out", Target.FOLDER)
    again = open_recording(import_folder(out, tmp_path / "again.mcap").path).views()
    assert [view.joints_rad for view in again] == [view.joints_rad for view in views]


def test_a_tag_and_what_is_known_of_the_board_reach_the_recording(folder: Path, tmp_path: Path) -> None:
    text = (folder / "dataset.yaml").read_text()
    tag = "{kind: aruco, dictionary: DICT_4X4_50, id: 7, square_m: 0.1"
    tag += ", square_tolerance: 0.001, flatness_m: 2e-4}"
    changed = [f"board: {tag}" if line.startswith("board:") else line for line in text.split("\n")]
    (folder / "dataset.yaml").write_text("\n".join(changed))
    board = open_recording(import_folder(folder, tmp_path / "r.mcap").path).info.board
    assert (board.kind, board.tag_id, board.dictionary) == (BoardKind.ARUCO, 7, "DICT_4X4_50")
    assert (board.square_m, board.square_tolerance, board.flatness_m) == (0.1, 0.001, 0.0002)


def test_quaternions_of_three_digits_are_made_rotations(folder: Path, tmp_path: Path) -> None:
    text = (folder / "poses.csv").read_text().replace("0.7071067811865476", "0.707")
    (folder / "poses.csv").write_text(text)
    view = open_recording(import_folder(folder, tmp_path / "out.mcap").path).views()[1]
    expected = [[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    np.testing.assert_allclose(view.base_from_flange, expected, atol=1e-12)


def cut_picture(folder: Path) -> None:
    path = folder / "images/1.png"
    path.write_bytes(path.read_bytes()[:-40])


def cut_jpeg(folder: Path) -> None:
    data = cv2.imencode(".jpg", make_image(1))[1].tobytes()
    (folder / "images/1.png").write_bytes(data[:-20])


def flip_picture(folder: Path) -> None:
    data = bytearray((folder / "images/1.png").read_bytes())
    data[len(data) // 2] ^= 1
    (folder / "images/1.png").write_bytes(data)


def replaced(make: Callable[[Path], object]) -> Change:
    def change(folder: Path) -> None:
        (folder / "images/1.png").unlink()
        make(folder / "images/1.png")

    return change


def another_size(folder: Path) -> None:
    cv2.imwrite(str(folder / "images/2.png"), make_image(2, 40, 30))


def huge_header(folder: Path) -> None:
    data = bytearray((folder / "images/1.png").read_bytes())
    data[16:24] = (30000).to_bytes(4, "big") * 2
    (folder / "images/1.png").write_bytes(data)


BAD: dict[str, tuple[Change, str, dict[str, object]]] = {
    "no dataset": (lambda f: (f / "dataset.yaml").unlink(), "no-file", {}),
    "no poses": (lambda f: (f / "poses.csv").unlink(), "no-file", {}),
    "wrong header": (edit("poses.csv", "qx,qy,qz,qw", "qw,qx,qy,qz"), "header", {"line": 1}),
    "no header": (edit("poses.csv", "image,x,y,z,qx,qy,qz,qw\n", ""), "header", {"line": 1}),
    "only a header": (
        lambda f: (f / "poses.csv").write_text("image,x,y,z,qx,qy,qz,qw\n"),
        "no-poses",
        {"line": 1},
    ),
    "empty": (lambda f: (f / "poses.csv").write_text(""), "header", {"line": 1}),
    "column missing": (edit("poses.csv", "0.1,0.2,0.3,0,", "0.1,0.2,0.3,"), "pose-row", {"line": 3}),
    "not a number": (edit("poses.csv", "0.1,0.2", "0.1,abc"), "pose-row", {"line": 3}),
    "decimal comma": (edit("poses.csv", "0.1,0.2", '"0,1",0.2'), "pose-row", {"line": 3}),
    "nan": (edit("poses.csv", "0.1,0.2", "nan,0.2"), "pose-row", {"line": 3}),
    "infinite": (edit("poses.csv", "0.1,0.2", "inf,0.2"), "pose-row", {"line": 3}),
    "zero quaternion": (
        edit("poses.csv", "0.7071067811865476,0.7071067811865476", "0,0"),
        "no-unit-quaternion",
        {"line": 2},
    ),
    "rotation vector": (
        edit("poses.csv", "0.7071067811865476,0.7071067811865476", "1.57,0"),
        "no-unit-quaternion",
        {"line": 2},
    ),
    "millimetres": (edit("poses.csv", "0.1,0.2", "612.3,0.2"), "not-metres", {"line": 3}),
    "twice": (edit("poses.csv", "images/2.png", "images/0.png"), "image-twice", {"line": 4}),
    "joints in degrees": (lambda f: with_joints(f, "10,-90,90,-60,-90,180"), "not-radians", {"line": 2}),
    "a joint missing": (lambda f: with_joints(f, "0.1,,1.5,-1,-1.57,3.2"), "pose-row", {"line": 2}),
    "five joints": (lambda f: with_joints(f, "0.1,0.1,1.5,-1,-1.57"), "pose-row", {"line": 2}),
    "no image name": (edit("poses.csv", "images/1.png", ""), "pose-row", {"line": 3}),
    "zero in the image name": (edit("poses.csv", "images/1.png", "images/\0.png"), "pose-row", {"line": 3}),
    "binary poses": (lambda f: (f / "poses.csv").write_bytes(b"\xff\xfe\x00"), "poses", {}),
    "picture missing": (lambda f: (f / "images/1.png").unlink(), "unreadable", {"line": 3}),
    "picture is a folder": (replaced(Path.mkdir), "unreadable", {"line": 3}),
    "picture is a pipe": (replaced(os.mkfifo), "unreadable", {"line": 3}),
    "picture is its own link": (replaced(lambda p: p.symlink_to(p.name)), "unreadable", {"line": 3}),
    "picture is a link to outside": (replaced(lambda p: p.symlink_to("/etc/passwd")), "outside", {"line": 3}),
    "picture's name too long": (edit("poses.csv", "images/1.png", "ü" * 3000), "unreadable", {"line": 3}),
    "picture unreadable": (lambda f: (f / "images/1.png").write_text("no"), "bad-image", {"line": 3}),
    "picture empty": (lambda f: (f / "images/1.png").write_bytes(b""), "bad-image", {"line": 3}),
    "picture cut": (cut_picture, "bad-image", {"line": 3}),
    "jpeg cut": (cut_jpeg, "bad-image", {"line": 3}),
    "picture damaged": (flip_picture, "bad-image", {"line": 3}),
    "header of 30000×30000": (huge_header, "bad-image", {"line": 3}),
    "mixed sizes": (another_size, "image-size", {"line": 4}),
    "outside": (edit("poses.csv", "images/1.png", "../../secret.png"), "outside", {"line": 3}),
    "unknown mount": (edit("dataset.yaml", "eye-in-hand", "on-hand"), "dataset", {"key": "mount"}),
    "unknown key": (edit("dataset.yaml", "note:", "nota:"), "dataset", {"key": "nota"}),
    "unknown camera key": (
        edit("dataset.yaml", "height: 24", "height: 24, distorsion: [0.1]"),
        "dataset",
        {"key": "camera.distorsion"},
    ),
    "board kind": (edit("dataset.yaml", "kind: chessboard", "kind: chess"), "dataset", {"key": "board.kind"}),
    "board size": (edit("dataset.yaml", "columns: 7", "columns: 0"), "dataset", {"key": "board.columns"}),
    "rows forgotten": (edit("dataset.yaml", "rows: 6, ", ""), "dataset", {"key": "board.columns"}),
    "size forgotten": (edit("dataset.yaml", ", square_m: 0.025", ""), "dataset", {"key": "board.square_m"}),
    "tolerance in percent": (
        edit("dataset.yaml", "0.025", "0.025, square_tolerance: 0.3"),
        "dataset",
        {"key": "board.square_tolerance"},
    ),
    "flatness in mm": (
        edit("dataset.yaml", "0.025", "0.025, flatness_m: 0.2"),
        "dataset",
        {"key": "board.flatness_m"},
    ),
    "a tag of no dictionary": (
        edit("dataset.yaml", "kind: chessboard, columns: 7, rows: 6", "kind: aruco, id: 3"),
        "dataset",
        {"key": "board.dictionary"},
    ),
    "a tag with columns": (
        edit("dataset.yaml", "chessboard", "april-tag"),
        "dataset",
        {"key": "board.columns"},
    ),
    "square in mm": (edit("dataset.yaml", "0.025", "25"), "dataset", {"key": "board.square_m"}),
    "no number": (edit("dataset.yaml", "0.025", "25 mm"), "dataset", {"key": "board.square_m"}),
    "key twice": (edit("dataset.yaml", "note:", "mount: eye-in-hand\nnote:"), "dataset", {"key": "mount"}),
    "alias": (edit("dataset.yaml", "made", "&a made\nx: *a #"), "dataset", {"line": 5}),
    "tag": (edit("dataset.yaml", "made", "!!python/object:os.system made"), "dataset", {"line": 5}),
    "brackets": (lambda f: (f / "dataset.yaml").write_text("[" * 100_000), "dataset", {"line": 1}),
    "not yaml": (edit("dataset.yaml", "mount:", "mount: : :"), "dataset", {"line": 1}),
    "a list": (lambda f: (f / "dataset.yaml").write_text("- 1\n"), "dataset", {"line": 1}),
    "huge": (lambda f: (f / "dataset.yaml").write_text("#" * 300_000), "file-too-large", {}),
    "singular camera": (
        edit("dataset.yaml", "height: 24", "height: 24, matrix: [[0,0,0],[0,0,0],[0,0,1]]"),
        "dataset",
        {"key": "camera.matrix"},
    ),
    "distortion alone": (
        edit("dataset.yaml", "height: 24", "height: 24, distortion: [0.1]"),
        "dataset",
        {"key": "camera.matrix"},
    ),
    "charuco without markers": (
        edit("dataset.yaml", "chessboard", "charuco"),
        "dataset",
        {"key": "board.marker_m"},
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_folder_says_what_where_and_what_to_do(folder: Path, tmp_path: Path, name: str) -> None:
    change, code, values = BAD[name]
    change(folder)
    with refused(code, **values):
        import_folder(folder, tmp_path / "out.mcap")
    assert [p.name for p in tmp_path.iterdir()] == ["pictures"], "something half-written was left behind"


def test_the_command_line_prints_one_json_object(folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    result = call(main, "import", folder, "-o", output, "--json")
    assert result.returncode == 0
    assert json.loads(result.stdout) == {"recording": str(output), "views": 3, "bytes": output.stat().st_size}


def test_an_existing_output_is_not_touched(folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "out.mcap"
    output.write_text("precious")
    with refused("exists"):
        import_folder(folder, output)
    assert output.read_text() == "precious"


def test_quaternions_turn_as_scipy_says() -> None:
    from scipy.spatial.transform import Rotation

    for q in Rotation.random(20, random_state=1).as_quat():
        matrix = np.array(matrix_from_quaternion([1.0, 2.0, 3.0], q.tolist()))
        np.testing.assert_allclose(matrix[:3, :3], Rotation.from_quat(q).as_matrix(), atol=1e-12)
        assert matrix[:3, 3].tolist() == [1, 2, 3]


def test_every_real_dataset_imports(datasets: Path, tmp_path: Path) -> None:
    folders = sorted(path.parent for path in datasets.glob("*/dataset.yaml"))
    assert folders
    for source in folders:
        done = import_folder(source, tmp_path / f"{source.name}.mcap")
        recording = open_recording(done.path)
        camera = recording.info.camera
        assert len(recording.views()) == done.images == len((source / "poses.csv").read_text().split()) - 1
        assert recording.image(recording.views()[0]).pixels.shape[:2] == (camera.height, camera.width)


DOCUMENT = Path(__file__).parent.parent.parent / "docs/integrator/import.md"


def test_the_recipes_for_poses_of_other_tools_give_the_pose(tmp_path: Path) -> None:
    """As they stand in the document, for one flange pose told in each convention."""
    from scipy.spatial.transform import Rotation

    text = DOCUMENT.read_text()
    recipe: dict[str, Any] = {}
    exec(text.partition("```python\n")[2].partition("```")[0], recipe)
    true, offset = Rotation.from_rotvec([0.4, -1.9, 0.7]), Rotation.from_rotvec([0.3, 0.1, -0.2])
    t, o = np.array([0.31, -0.42, 0.55]), np.array([0.01, -0.02, 0.15, 0.3, 0.1, -0.2])
    wanted = recipe["matrix"](t, true)
    tcp = [*(t + true.apply(o[:3])), *(true * offset).as_rotvec()]
    a, b, c = true.as_euler("ZYX", degrees=True)
    told: dict[str, dict[str, Any]] = {
        "UR pendant": {"p": np.array(tcp), "o": o},
        "ROS": {"t": t, "q": true.as_quat()},
        "w first": {"t": t, "q": np.roll(true.as_quat(), 1)},
        "OpenCV": {"t": t[:, None], "R": true.as_matrix()},
        "HALCON": {"p": [*t, *true.as_euler("XYZ", degrees=True), 0]},
        "roll, pitch, yaw": {"t": t, "rpy": true.as_euler("xyz")},
        "KUKA": {"x": 310, "y": -420, "z": 550, "A": a, "B": b, "C": c},
    }
    for tool, names in told.items():
        row = next(line for line in text.splitlines() if line.startswith(f"| {tool}"))
        formula = re.findall(r"`(matrix\(.*?)`", row.split(" | ")[-1])[0]
        np.testing.assert_allclose(eval(formula, recipe | names), wanted, atol=1e-12, err_msg=tool)
    (tmp_path / "poses").mkdir()
    recipe["write_poses"](tmp_path / "poses/poses.csv", {"a.png": wanted})
    (row_read,), _ = read_poses(tmp_path / "poses")
    np.testing.assert_allclose(row_read.base_from_flange, wanted, atol=1e-12)
