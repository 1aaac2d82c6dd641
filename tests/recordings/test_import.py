"""`recordings import`: a good folder becomes a recording, a bad one an error with file, row and remedy."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from recordings.cli import main
from recordings.exporters.export import export_recording
from recordings.images import encode_png
from recordings.importers.conventions import NAMED
from recordings.importers.folder import import_folder
from recordings.importers.tables import look
from recordings.reader import open_recording
from recordings.schema.messages import BoardKind
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
    (folder / "kinematics.yaml").write_bytes(b"kinematics: {}\n")
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
    assert set(recording.attachments()) == {"dataset.yaml", "poses.csv", "kinematics.yaml"}
    assert done.images == 3
    told = open_recording(import_folder(folder, tmp_path / "told.mcap", arm_class="servo").path).info.robot
    assert (told.model, told.arm_class, info.robot.arm_class) == ("UR10", "servo", "")
    again = import_folder(folder, tmp_path / "again.mcap").path
    assert open_recording(again).sha256 == recording.sha256, "no new views for a drift check"
    (folder / "images/0.png").unlink()  # of a folder that grows, old pictures may be gone
    newest = open_recording(import_folder(folder, tmp_path / "newest.mcap", newest=2).path)
    assert [v.source_file for v in newest.views()] == ["images/1.png", "images/2.png"]


def test_a_folder_of_images_may_be_a_link(folder: Path, tmp_path: Path) -> None:
    (folder / "images").rename(tmp_path / "elsewhere")
    (folder / "images").symlink_to(tmp_path / "elsewhere")
    assert import_folder(folder, tmp_path / "out.mcap").images == 3
    held = look(folder)
    assert not held.images  # which images are meant is not told, and a link may lead anywhere
    assert list(held.unread) == ["images"]
    (folder / "images").unlink()
    (tmp_path / "elsewhere").rename(folder / "here")
    (folder / "images").symlink_to("here")
    assert sum(map(len, look(folder).images.values())) == 3


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
    names = ",".join(f"j{joint + 1}" for joint in range(texts[0].count(",") + 1))
    lines = [f"{header},{names}", *(f"{row},{text}" for row, text in zip(rows, texts, strict=True))]
    (folder / "poses.csv").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("count", [5, 6, 7])
def test_joints_behind_the_pose_reach_the_view(count: int, folder: Path, tmp_path: Path) -> None:
    joints = (0.1, -1.5, 1.5, -1.0, -1.57, 3.2, 0.7)[:count]
    with_joints(folder, ",".join(map(str, joints)), "," * (count - 1))
    views = open_recording(import_folder(folder, tmp_path / "r.mcap").path).views()
    assert views[0].joints_rad == joints
    assert views[1].joints_rad is None, "empty cells: not known for that picture"
    out = export_recording(open_recording(tmp_path / "r.mcap"), tmp_path / "out", "folder")
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


def replaced(make: Callable[[Path], object]) -> Change:
    def change(folder: Path) -> None:
        (folder / "images/1.png").unlink()
        make(folder / "images/1.png")

    return change


Bad = tuple[Change, str, dict[str, object]]
"""What is done to the folder, the code of the error, and values of it."""


def pose(old: str, new: str, line: int = 3, code: str = "pose-row") -> Bad:
    return edit("poses.csv", old, new), code, {"line": line}


def poses(content: str | bytes, code: str, **values: object) -> Bad:
    raw = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / "poses.csv").write_bytes(raw), code, values


def joints(values: str, code: str = "pose-row") -> Bad:
    return lambda folder: with_joints(folder, values), code, {"line": 2}


def image(change: Change, code: str = "unreadable", line: int = 3) -> Bad:
    return change, code, {"line": line}


def content(data: bytes) -> Bad:
    return image(lambda folder: (folder / "images/1.png").write_bytes(data), "bad-image")


def key(old: str, new: str, key: str) -> Bad:
    return edit("dataset.yaml", old, new), "dataset", {"key": key}


def dataset(text: str, code: str = "dataset", **values: object) -> Bad:
    return lambda folder: (folder / "dataset.yaml").write_text(text), code, values


HEADER = "image,x,y,z,qx,qy,qz,qw\n"
HALF = "0.7071067811865476,0.7071067811865476"
SINGULAR = "height: 24, matrix: [[0,0,0],[0,0,0],[0,0,1]]"
SHEARED = "height: 24, matrix: [[900,0,16],[1,900,12],[0,0,1]]"
BAD: dict[str, Bad] = {
    "no dataset": (lambda f: (f / "dataset.yaml").unlink(), "missing-file", {}),
    "no poses": (lambda f: (f / "poses.csv").unlink(), "missing-file", {}),
    "wrong header": pose("qx,qy,qz,qw", "qw,qx,qy,qz", 1, "header"),
    "no header": pose(HEADER, "", 1, "header"),
    "only a header": poses(HEADER, "no-poses", line=1),
    "empty": poses("", "header", line=1),
    "binary poses": poses(b"\xff\xfe\x00", "poses"),
    "column missing": pose("0.1,0.2,0.3,0,", "0.1,0.2,0.3,"),
    "not a number": pose("0.1,0.2", "0.1,abc"),
    "decimal comma": pose("0.1,0.2", '"0,1",0.2'),
    "nan": pose("0.1,0.2", "nan,0.2"),
    "infinite": pose("0.1,0.2", "inf,0.2"),
    "zero quaternion": pose(HALF, "0,0", 2, "no-unit-quaternion"),
    "rotation vector": pose(HALF, "1.57,0", 2, "no-unit-quaternion"),
    "millimetres": pose("0.1,0.2", "612.3,0.2", code="not-metres"),
    "twice": pose("images/2.png", "images/0.png", 4, "image-twice"),
    "no image name": pose("images/1.png", ""),
    "zero in the image name": pose("images/1.png", "images/\0.png"),
    "picture's name too long": pose("images/1.png", "ü" * 3000, code="unreadable"),
    "outside": pose("images/1.png", "../../secret.png", code="outside"),
    "joints in degrees": joints("10,-90,90,-60,-90,180", "not-radians"),
    "a joint missing": joints("0.1,,1.5,-1,-1.57,3.2"),
    "four joints": (lambda folder: with_joints(folder, "0.1,0.1,1.5,-1"), "header", {"line": 1}),
    "picture missing": image(lambda f: (f / "images/1.png").unlink()),
    "picture is a folder": image(replaced(Path.mkdir)),
    "picture is a pipe": image(replaced(os.mkfifo)),
    "picture is its own link": image(replaced(lambda p: p.symlink_to(p.name))),
    "picture is a link to outside": image(replaced(lambda p: p.symlink_to("/etc/passwd")), "outside"),
    "picture unreadable": content(b"no"),
    "picture cut": content(encode_png(make_image(1))[:-40]),
    "mixed sizes": image(
        lambda f: cv2.imwrite(str(f / "images/2.png"), make_image(2, 40, 30)), "image-size", 4
    ),
    "unknown mount": key("eye-in-hand", "on-hand", "mount"),
    "unknown key": key("note:", "nota:", "nota"),
    "unknown camera key": key("height: 24", "height: 24, distorsion: [0.1]", "camera.distorsion"),
    "board kind": key("kind: chessboard", "kind: chess", "board.kind"),
    "board size": key("columns: 7", "columns: 0", "board.columns"),
    "rows forgotten": key("rows: 6, ", "", "board.columns"),
    "size forgotten": key(", square_m: 0.025", "", "board.square_m"),
    "tolerance in percent": key("0.025", "0.025, square_tolerance: 0.3", "board.square_tolerance"),
    "flatness in mm": key("0.025", "0.025, flatness_m: 0.2", "board.flatness_m"),
    "a tag of no dictionary": key("chessboard, columns: 7, rows: 6", "aruco, id: 3", "board.dictionary"),
    "a tag with columns": key("chessboard", "april-tag", "board.columns"),
    "square in mm": key("0.025", "25", "board.square_m"),
    "no number": key("0.025", "25 mm", "board.square_m"),
    "singular camera": key("height: 24", SINGULAR, "camera.matrix"),
    "sheared camera": key("height: 24", SHEARED, "camera.matrix"),
    "distortion alone": key("height: 24", "height: 24, distortion: [0.1]", "camera.matrix"),
    "charuco without markers": key("chessboard", "charuco", "board.marker_m"),
    "not yaml": dataset("mount: : :", line=1),
    "huge": dataset("#" * 300_000, "file-too-large"),
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
    size_bytes = output.stat().st_size
    told = {"recording": str(output), "views": 3, "bytes": size_bytes, "with_joints": False}
    assert json.loads(result.stdout) == told
    assert json.loads(call(main, "info", output, "--json").stdout)["robot_states"] is None


def test_a_source_that_is_none_is_named_before_what_it_lacks(small: Path) -> None:
    (part := small.with_name("a.mcap.part")).write_bytes(small.read_bytes()[:-9000])
    missing = small.with_name("none.mcap")
    for source, code in ((part, "unfinished-recording"), (small, "a-recording"), (missing, "no-file")):
        told = call(main, "import", source, "-o", small.with_name("out.mcap"), "--json")
        error = json.loads(told.stdout)["error"]
        assert error["code"] == code and error["values"].get("rescue", "").startswith(
            "recordings recover" * (source == part)
        )


DOCUMENT = Path(__file__).parent.parent.parent / "docs/integrator/import.md"


def test_the_document_names_every_convention() -> None:
    rows = [line.split("|")[1] for line in DOCUMENT.read_text().splitlines() if line.startswith("| `")]
    assert set(NAMED) <= {name for row in rows for name in re.findall(r"`([\w-]+)`", row)}
