"""Layouts of other people's folders: what goes together is read right, or asked about, and never mixed up."""

from __future__ import annotations

import hashlib
import json
import pickle
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from calibrate.imported import Given, believe, board
from calibrate.imported.described import described
from recordings.cli import main
from recordings.errors import SeveralReadingsError
from recordings.geometry import pose, quaternion_from_matrix, rotation_exp
from recordings.importers import reader
from recordings.importers.tables import look
from recordings.reader import open_recording
from recordings.schema.messages import BoardKind
from tests.calibrate.pose_files import euler, quaternions
from tests.calibrate.sessions import PAPER_BOARD, X_TRUE, Scene, write_session
from tests.codes import raises
from tests.command_line import call

VIEWS = 8


class Beside(Scene):
    """What another camera on the same arm sees at the same poses."""

    def flange_poses(self) -> tuple[np.ndarray, np.ndarray]:
        return SCENES["one"].flange_poses()


SCENES = {
    "one": Scene(views=VIEWS, seed=1),
    "two": Scene(views=VIEWS, seed=2),
    "beside": Beside(views=VIEWS, seed=1, X=X_TRUE @ pose(rotation_exp([0, 0.02, 0]), [0.02, 0.0, 0.0])),
}
"""Two sessions of a camera, and another camera in the first one."""
GIVEN = Given(mount="eye-in-hand", board=PAPER_BOARD)
OTHER_BOARD = msgspec.structs.replace(PAPER_BOARD, columns=12, rows=11)
FAILING = Path(__file__).parents[4] / "shared/failing"


@dataclass(frozen=True)
class Shots:
    """Pictures by scene, encoded as they are asked for, and the robot's poses at each."""

    pixels: dict[str, list[np.ndarray]]
    flanges: dict[str, np.ndarray]
    shown_by: dict[str, tuple[str, int]]
    """Hash of a file → scene and view."""

    def save(self, path: Path, scene: str, view: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), self.pixels[scene][view])
        self.shown_by[_hash(path)] = scene, view


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Shots:
    pixels: dict[str, list[np.ndarray]] = {}
    flanges: dict[str, np.ndarray] = {}
    for name, scene in SCENES.items():
        recording = open_recording(write_session(tmp_path_factory.mktemp(name) / "s.mcap", scene))
        pixels[name] = [image.pixels for _, image in recording.images()]
        flanges[name] = np.array([view.base_from_flange for view in recording.views()])
    return Shots(pixels, flanges, {})


@pytest.fixture(autouse=True)
def _seen_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The board is looked for once in the same pictures, whatever their files are called."""

    def seen(held: Any, given: Any, paths: list[Path], progress: Any) -> board.Seen | board.SeldomSeen | None:
        keys = [_hash(path) for path in paths]
        facts = "" if given else repr(held.facts)
        key = given, len(held.cameras), facts, *keys
        if key not in _SEEN:
            found = board.see_board(held, given, paths, progress)
            _SEEN[key] = found, dict(zip(paths, keys, strict=True))
        found, hashes = _SEEN[key]
        if not isinstance(found, board.Seen):
            return found
        renamed = dict(zip(keys, paths, strict=True))
        views = {renamed[hashes[path]]: view for path, view in found.views.items()}
        candidates = {renamed[hashes[path]]: each for path, each in found.candidates.items()}
        return replace(found, views=views, candidates=candidates)

    monkeypatch.setattr("calibrate.imported.folder.see_board", seen)


_SEEN: dict[object, tuple[board.Seen | board.SeldomSeen | None, dict[Path, str]]] = {}


def require_right(
    shots: Shots, folder: Path, given: Given = GIVEN, poses: Path | None = None, most: int = VIEWS
) -> set[str]:
    """Every image has the pose at which it was taken; returns the scenes that were taken."""
    believed = believe(look(folder, poses), given)
    assert len(believed.rows) == most
    shown = [shots.shown_by[_hash(folder / row.image)] for row in believed.rows]
    true = np.array([shots.flanges[scene][view] for scene, view in shown])
    np.testing.assert_allclose([row.base_from_flange for row in believed.rows], true, atol=1e-4)
    return {scene for scene, _ in shown}


# ---- one set: names, nesting, formats, encodings

NAMES = (
    "img_{n:02d}.jpg",
    "images/{n}.png",
    "data/rgb/IMG-{n:04d}.bmp",
    "frame {n}.png",
    "cam_2/left_{n}_of_8.tiff",
    "pose_{n:02d}/image.png",
    "run/{n}/rgb.png",
    "run 1/position{n}/camera/shot_1.jpg",
    "calib/2024-05-0{n}_10-11-12/colour.png",
)


def save_images(shots: Shots, folder: Path, name: str, scene: str = "one") -> list[Path]:
    paths = [folder / name.format(n=n + 1) for n in range(VIEWS)]
    for view, path in enumerate(paths):
        shots.save(path, scene, view)
    return paths


def lines(table: np.ndarray, between: str = ",") -> list[str]:
    return [between.join(f"{number:.7f}" for number in row) for row in table]


def text_rows(folder: Path, T: np.ndarray, paths: list[Path]) -> None:
    (folder / "robot_poses.txt").write_text("\n".join(lines(quaternions(T), " ")))


def one_json_beside(folder: Path, T: np.ndarray, paths: list[Path]) -> None:
    for path, each in zip(paths, T, strict=True):
        own_folder = path.with_name("data.json")
        beside = path.with_name(f"{path.stem}_pose.json")
        own = own_folder if len({p.parent for p in paths}) == len(paths) else beside
        own.write_text(json.dumps({"O_T_EE": each.ravel("F").tolist()}))


@pytest.mark.parametrize("write", [text_rows, one_json_beside])
@pytest.mark.parametrize("name", NAMES)
def test_names_and_nesting_do_not_matter(
    name: str, write: Callable[[Path, np.ndarray, list[Path]], None], shots: Shots, tmp_path: Path
) -> None:
    paths = save_images(shots, tmp_path, name)
    write(tmp_path, shots.flanges["one"], paths)
    require_right(shots, tmp_path)


ORDER = np.random.default_rng(7).permutation(VIEWS)
"""Rows that are not in the images' order."""


def csv_with_a_header(folder: Path, T: np.ndarray, names: list[str], head: str = "image") -> None:
    rows = [f"{names[k]},{line}" for k, line in enumerate(lines(quaternions(T)))]
    text = "\n".join([f"{head},x,y,z,qx,qy,qz,qw", *(rows[k] for k in ORDER)])
    (folder / "robot_poses.csv").write_text(text)


def csv_names_last(folder: Path, T: np.ndarray, names: list[str]) -> None:
    rows = [f'{line},"{names[k]}"' for k, line in enumerate(lines(quaternions(T)))]
    text = "\n".join(["x,y,z,qx,qy,qz,qw,filename", *(rows[k] for k in ORDER)])
    (folder / "robot_poses.csv").write_text(text)


def json_by_name(folder: Path, T: np.ndarray, names: list[str]) -> None:
    told = {names[k]: {"tcp_pose": T[k].tolist()} for k in ORDER}
    (folder / "robot.json").write_text(json.dumps(told))


def json_by_name_directly(folder: Path, T: np.ndarray, names: list[str]) -> None:
    (folder / "robot.json").write_text(json.dumps({names[k]: T[k].tolist() for k in ORDER}))


def json_list(folder: Path, T: np.ndarray, names: list[str]) -> None:
    rows = [{"file": names[k], "flange": quaternions(T)[k].tolist()} for k in ORDER]
    (folder / "robot.json").write_text(json.dumps({"samples": rows}))


def text_with_names(folder: Path, T: np.ndarray, names: list[str]) -> None:
    rows = [f"{names[k]} {line}" for k, line in enumerate(lines(quaternions(T), " "))]
    (folder / "robot.txt").write_text("\n".join(rows[k] for k in ORDER))


@pytest.mark.parametrize("told", ["{name}", "images\\{name}", "/home/me/data/images/{name}", "{stem}"])
@pytest.mark.parametrize(
    "write",
    [csv_with_a_header, csv_names_last, json_by_name, json_by_name_directly, json_list, text_with_names],
)
def test_rows_go_by_the_names_that_they_tell(
    write: Callable[[Path, np.ndarray, list[str]], None], told: str, shots: Shots, tmp_path: Path
) -> None:
    if told == "{stem}" and write not in (csv_with_a_header, json_list):
        pytest.skip("without an ending only a column or key that says so names an image")
    paths = save_images(shots, tmp_path, "images/img_{n}.png")
    write(tmp_path, shots.flanges["one"], [told.format(name=path.name, stem=path.stem) for path in paths])
    require_right(shots, tmp_path)


@pytest.mark.parametrize("head", ["id", "index", "frame"])
def test_rows_go_by_the_numbers_of_a_column(head: str, shots: Shots, tmp_path: Path) -> None:
    save_images(shots, tmp_path, "img_{n}.png")
    csv_with_a_header(tmp_path, shots.flanges["one"], [str(n + 1) for n in range(VIEWS)], head)
    require_right(shots, tmp_path)


@pytest.mark.parametrize(
    ("head", "told"),
    [("frame_id", "{n}"), ("Nr", "{n}"), ("pose", "pose_{n}"), ("Bild", "img_{n}"), ("stamp", "{n:03d}")],
)
def test_rows_go_by_any_column_that_names_the_images(
    head: str, told: str, shots: Shots, tmp_path: Path
) -> None:
    save_images(shots, tmp_path, "img_{n}.png")
    csv_with_a_header(tmp_path, shots.flanges["one"], [told.format(n=n + 1) for n in range(VIEWS)], head)
    require_right(shots, tmp_path)


def test_rows_go_by_a_first_number_in_any_order(shots: Shots, tmp_path: Path) -> None:
    save_images(shots, tmp_path, "img_{n}.png")
    rows = [f"{n + 1} {line}" for n, line in enumerate(lines(quaternions(shots.flanges["one"]), " "))]
    (tmp_path / "robot.txt").write_text("\n".join(rows[k] for k in ORDER))
    require_right(shots, tmp_path)


@pytest.mark.parametrize("key", ["img_{n}", "pose{n:02d}", "{n}"])
def test_rows_go_by_the_numbers_of_their_keys(key: str, shots: Shots, tmp_path: Path) -> None:
    save_images(shots, tmp_path, "img_{n}.png")
    told = {key.format(n=k + 1): {"tcp": shots.flanges["one"][k].tolist()} for k in ORDER}
    (tmp_path / "robot.json").write_text(json.dumps(told))
    require_right(shots, tmp_path)


def _behind(stamp: str) -> Callable[[np.ndarray], str]:
    return lambda T: "\n".join(
        f"p({line})   {stamp.format(n=n)}" for n, line in enumerate(lines(_rotvec(T), ", "))
    )


def _before(stamp: str) -> Callable[[np.ndarray], str]:
    return lambda T: "\n".join(f"{stamp.format(n=n)};{line}" for n, line in enumerate(lines(_rotvec(T), ";")))


def _rotvec(T: np.ndarray) -> np.ndarray:
    return np.column_stack([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_rotvec()])


def _with_commas(between: str, header: str = "") -> Callable[[np.ndarray], str]:
    def text(T: np.ndarray) -> str:
        rows = lines(euler("ZYX", 1e3, True)(T), between)
        return "\n".join([*([header] if header else []), *(row.replace(".", ",") for row in rows)])

    return text


TEXTS = {
    "date and time behind": _behind("2020-03-0{n} 10:10:59.119318"),
    "iso date behind": _behind("2020-03-0{n}T10:10:59Z"),
    "german date behind": _behind("{n}.3.2020 10:10"),
    "time behind": _behind("10:1{n}:59"),
    "seconds since 1970 behind": lambda T: "\n".join(
        f"{line}, {1.6e9 + n:.3f}" for n, line in enumerate(lines(_rotvec(T), ", "))
    ),
    "date before": _before("2020/03/0{n} 10:10:59"),
    "commas and semicolons": _with_commas(";"),
    "commas and semicolons, header": _with_commas(";", "X;Y;Z;A;B;C"),
    "commas and tabs": _with_commas("\t"),
    "commas and spaces": _with_commas("  "),
}


@pytest.mark.parametrize("what", TEXTS)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_dates_commas_and_encodings(what: str, encoding: str, shots: Shots, tmp_path: Path) -> None:
    save_images(shots, tmp_path, "images/{n}.png")
    (tmp_path / "robot.txt").write_text(TEXTS[what](shots.flanges["one"]), encoding=encoding)
    require_right(shots, tmp_path)


ENCODINGS = ("utf-8-sig", *(f"utf-{size}{order}" for size in (16, 32) for order in ("", "-le", "-be")))


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("suffix", ["json", "yaml"])
def test_other_encodings_of_trees(suffix: str, encoding: str, shots: Shots, tmp_path: Path) -> None:
    save_images(shots, tmp_path, "images/{n}.png")
    text = json.dumps([{"tcp": each.tolist()} for each in shots.flanges["one"]])
    (tmp_path / f"robot.{suffix}").write_text(text, encoding=encoding)
    require_right(shots, tmp_path)


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("between", ["; ", ", ", ",  ", "quoted"])
def test_decimal_commas_are_told_from_those_between(between: str, encoding: str, tmp_path: Path) -> None:
    numbers = np.random.default_rng(1).normal(size=(6, 6)) * 100
    cells = [[f"{number:.4f}".replace(".", ",") for number in row] for row in numbers]
    quoted = ['"' + '","'.join(row) + '"' for row in cells]
    rows = quoted if between == "quoted" else [between.join(row) for row in cells]
    (tmp_path / "robot.txt").write_text("\n".join(rows), encoding=encoding)
    (table,) = look(tmp_path).tables
    np.testing.assert_allclose(table.numbers, numbers, atol=1e-4)


@pytest.mark.parametrize("count", [6, 7])
def test_commas_that_part_numbers_and_decimals_are_named(count: int, tmp_path: Path) -> None:
    numbers = np.random.default_rng(1).normal(size=(8, count)) * 100
    rows = [",".join(f"{number:.3f}".replace(".", ",") for number in row) for row in numbers]
    (tmp_path / "robot.csv").write_text("\n".join(rows))
    held = look(tmp_path)
    assert not held.tables
    assert "robot.csv" in held.unread
    with raises("no-pairs") as refused:
        believe(held)
    assert "robot.csv" in str(refused.value.values["images"])


def test_matrices_stacked_along_the_last_axis_are_poses(shots: Shots, tmp_path: Path) -> None:
    save_images(shots, tmp_path, "images/{n}.png")
    savemat(tmp_path / "poses.mat", {"robotPoses": np.moveaxis(shots.flanges["one"], 0, 2)})
    require_right(shots, tmp_path)


def test_a_typographic_minus_is_a_sign(shots: Shots, tmp_path: Path) -> None:
    save_images(shots, tmp_path, "images/{n}.png")
    text = "\n".join(lines(quaternions(shots.flanges["one"]), " "))
    (tmp_path / "robot.txt").write_text(text.replace("-", "\N{MINUS SIGN}"))
    require_right(shots, tmp_path)


def test_a_unit_that_nobody_named_is_asked_about(shots: Shots, tmp_path: Path) -> None:
    """Decimetres are among none of those that are known, and look like inches of a small arm."""
    save_images(shots, tmp_path, "images/{n}.png")
    T = shots.flanges["one"].copy()
    T[:, :3, 3] *= 10
    np.savetxt(tmp_path / "robot.txt", quaternions(T))
    with raises("several-readings", SeveralReadingsError):
        believe(look(tmp_path), Given(mount="eye-in-hand"))


@pytest.mark.parametrize(
    "plain", ["0.1, 0.2, 0.3, 1, 2, 3", "1,2,3,4,5,6", "0, 0, 100, 1, 2, 3", "1;2;3;4;5;6"]
)
def test_points_stay_where_commas_separate(plain: str, tmp_path: Path) -> None:
    rows = [plain.replace("3", str(n)) for n in range(3, 9)]
    (tmp_path / "robot.txt").write_text("\n".join(rows))
    (table,) = look(tmp_path).tables
    expected = [[float(cell) for cell in row.replace(";", ",").split(",")] for row in rows]
    np.testing.assert_allclose(table.numbers, expected)


# ---- several sets: asked, and the answer is taken


def two_sessions(name: str, table: str) -> Callable[[Shots, Path], Iterator[tuple[str, str, str]]]:
    def write(shots: Shots, folder: Path) -> Iterator[tuple[str, str, str]]:
        for session, scene in (("1", "one"), ("2", "two")):
            images = save_images(shots, folder, name.replace("SESSION", session), scene)
            path = folder / table.replace("SESSION", session)
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savetxt(path, quaternions(shots.flanges[scene]))
            yield scene, str(images[0].parent), str(path)

    return write


def choices_of(asked: BaseException) -> list[str]:
    """What the one option of each choice takes."""
    assert isinstance(asked, SeveralReadingsError)
    return [value for reading in asked.readings for value in reading.options.values()]


SESSIONS = {
    "folders": two_sessions("sSESSION/img_{n}.png", "sSESSION/robot.txt"),
    "folders below": two_sessions("data/run_SESSION/images/img_{n}.png", "data/run_SESSION/robot.txt"),
    "dates": two_sessions("2024-05-0SESSION/img_{n}.png", "2024-05-0SESSION/calib_records.txt"),
    "names of folders": two_sessions("images_SESSION/img_{n}.png", "robot_SESSION.txt"),
    "poses elsewhere": two_sessions("images/session SESSION/{n}.png", "poses/session SESSION/robot.txt"),
}


@pytest.mark.parametrize("what", SESSIONS)
def test_sessions_are_never_mixed(what: str, shots: Shots, tmp_path: Path) -> None:
    sessions = list(SESSIONS[what](shots, tmp_path))
    with raises("several-sets", SeveralReadingsError) as asked:
        believe(look(tmp_path), GIVEN)
    choices = choices_of(asked.value)
    assert {frozenset(require_right(shots, tmp_path, replace(GIVEN, images=each))) for each in choices} == {
        frozenset({"one"}),
        frozenset({"two"}),
    }
    for scene, images, poses in sessions:
        assert require_right(shots, tmp_path, replace(GIVEN, images=images)) == {scene}
        assert require_right(shots, tmp_path, GIVEN, Path(poses)) == {scene}
        assert require_right(shots, tmp_path, GIVEN, Path(poses).relative_to(tmp_path)) == {scene}


def test_a_session_without_poses_takes_none_of_another(shots: Shots, tmp_path: Path) -> None:
    for scene, session in (("one", "s1"), ("two", "s2")):
        save_images(shots, tmp_path, f"{session}/img_{{n}}.png", scene)
    np.savetxt(tmp_path / "s2/robot.txt", quaternions(shots.flanges["two"]))
    assert require_right(shots, tmp_path) == {"two"}
    with raises("no-pairs"):
        believe(look(tmp_path), replace(GIVEN, images="s1"))


def one_pose_file_each(shots: Shots, folder: Path, session: str, scene: str) -> None:
    for n, path in enumerate(save_images(shots, folder, f"{session}/img_{{n:02d}}.png", scene)):
        told = quaternions(shots.flanges[scene])[n]
        path.with_name(f"pose_{n + 1:02d}.txt").write_text(" ".join(map(str, told)))


def test_sessions_of_one_pose_a_file(shots: Shots, tmp_path: Path) -> None:
    for session, scene in (("s1", "one"), ("s2", "two")):
        one_pose_file_each(shots, tmp_path, session, scene)
    with raises("several-sets"):
        believe(look(tmp_path), GIVEN)
    assert require_right(shots, tmp_path / "s1") == {"one"}
    assert require_right(shots, tmp_path, GIVEN, Path("s2")) == {"two"}


def test_one_table_that_names_the_images_of_two_sessions(shots: Shots, tmp_path: Path) -> None:
    rows = []
    for session, scene in (("s1", "one"), ("s2", "two")):
        paths = save_images(shots, tmp_path, f"{session}/img_{{n}}.png", scene)
        flanges = quaternions(shots.flanges[scene])
        rows += [
            f"{session}/{path.name} {line}" for path, line in zip(paths, lines(flanges, " "), strict=True)
        ]
    (tmp_path / "robot.txt").write_text("\n".join(rows))
    with raises("several-sets"):
        believe(look(tmp_path), GIVEN)
    assert require_right(shots, tmp_path, replace(GIVEN, images="s1")) == {"one"}
    assert require_right(shots, tmp_path, replace(GIVEN, images="s2/img_#.png")) == {"two"}


CAMERAS = (
    ("ir_{n:02d}.jpg", "rgb_{n:02d}.jpg"),
    ("left_{n}.png", "right_{n}.png"),
    ("left/img_{n}.png", "right/img_{n}.png"),
    ("cam0/{n}.png", "cam1/{n}.png"),
    ("pose_{n}/left.png", "pose_{n}/right.png"),
    ("pose_{n}/rgb.png", "pose_{n}/ir.png"),
    ("pose_{n}/color.png", "pose_{n}/IR.png"),
    ("{n}_a.png", "{n}_b.png"),
    ("im_{n}_0.png", "im_{n}_1.png"),
    ("cam_0_img_{n}.png", "cam_1_img_{n}.png"),
    ("run 1/camera0_{n:02d}.png", "run 1/camera1_{n:02d}.png"),
)


@pytest.mark.parametrize(("first", "second"), CAMERAS)
def test_two_cameras_are_asked_about(first: str, second: str, shots: Shots, tmp_path: Path) -> None:
    save_images(shots, tmp_path, first, "one")
    save_images(shots, tmp_path, second, "beside")
    np.savetxt(tmp_path / "robot.txt", quaternions(shots.flanges["one"]))
    with raises("several-sets", SeveralReadingsError) as asked:
        believe(look(tmp_path), GIVEN)
    choices = choices_of(asked.value)
    taken = [require_right(shots, tmp_path, replace(GIVEN, images=each)) for each in choices]
    assert sorted(map(sorted, taken)) == [["beside"], ["one"]]


def test_copies_of_the_same_pictures_are_no_second_set(shots: Shots, tmp_path: Path) -> None:
    for folder in ("images", "backup"):
        save_images(shots, tmp_path, f"{folder}/{{n}}.png")
    np.savetxt(tmp_path / "robot.txt", quaternions(shots.flanges["one"]))
    assert require_right(shots, tmp_path) == {"one"}


# ---- what the user says


def two_tables(shots: Shots, folder: Path) -> None:
    save_images(shots, folder, "images/{n}.png")
    np.savetxt(folder / "test.txt", quaternions(shots.flanges["one"]))
    np.savetxt(folder / "40_poses_test.txt", quaternions(shots.flanges["two"]))


def test_an_existing_file_is_meant_before_a_name_that_ends_so(shots: Shots, tmp_path: Path) -> None:
    two_tables(shots, tmp_path)
    assert [table.name for table in look(tmp_path, Path("test.txt")).told or []] == ["test.txt"]
    assert require_right(shots, tmp_path, GIVEN, Path("test.txt")) == {"one"}
    (tmp_path / "below").mkdir()
    (tmp_path / "test.txt").rename(tmp_path / "below/test.txt")
    assert require_right(shots, tmp_path, GIVEN, Path("test.txt")) == {"one"}, "a whole name goes first"


def test_what_is_told_and_not_there_is_an_error(shots: Shots, tmp_path: Path) -> None:
    two_tables(shots, tmp_path)
    with raises("told-not-there", option="--poses", told="others.txt"):
        believe(look(tmp_path, Path("others.txt")), GIVEN)
    with raises("told-not-there", option="--images", told="others"):
        believe(look(tmp_path), replace(GIVEN, images="others"))
    (tmp_path / "empty.txt").write_text("nothing here")
    with raises("told-not-there", option="--poses"):
        believe(look(tmp_path, Path("empty.txt")), GIVEN)
    with raises("told-board-unseen"):
        believe(look(tmp_path, Path("test.txt")), replace(GIVEN, board=OTHER_BOARD))
    np.savetxt(tmp_path / "short.txt", quaternions(shots.flanges["one"])[:6])
    with raises("told-poses-unpaired"):
        believe(look(tmp_path, Path("short.txt")), GIVEN)


def test_a_board_is_not_told_for_nothing(shots: Shots, tmp_path: Path) -> None:
    """Beside pictures the pictures are meant; without them nothing would use it."""
    seen = np.array(SCENES["one"].camera_from_board())
    for n, path in enumerate(save_images(shots, tmp_path, "pose_{n}/image.png")):
        told = {"O_T_EE": shots.flanges["one"][n].tolist(), "T_cam_target": seen[n].tolist()}
        path.with_name("data.json").write_text(json.dumps(told))
    assert require_right(shots, tmp_path) == {"one"}
    with raises("told-board-unseen"):
        believe(look(tmp_path), replace(GIVEN, board=OTHER_BOARD))
    for path in tmp_path.glob("*/image.png"):
        path.unlink()
    assert len(believe(look(tmp_path), Given(mount="eye-in-hand")).rows) == VIEWS
    with raises("told-not-used", option="--board"):
        believe(look(tmp_path), GIVEN)


def test_the_question_is_for_programs_too(shots: Shots, tmp_path: Path) -> None:
    for name, scene in (("a/{n}.png", "one"), ("b/{n}.png", "beside")):
        save_images(shots, tmp_path, name, scene)
    np.savetxt(tmp_path / "robot.txt", quaternions(shots.flanges["one"]))
    told = ("import", tmp_path, "--dry-run", "--json", "--board", "7x6 25", "--mount", "eye-in-hand")
    asked = call(main, *told)
    assert asked.returncode == 2
    error = json.loads(asked.stdout)["error"]
    assert error["code"] == "several-sets"
    options = [shlex.split(each) for each in error["values"]["options"]]
    assert options == [["--images", "a/#.png"], ["--images", "b/#.png"]]
    answered = call(main, *told, *options[1])
    assert answered.returncode == 0, answered.stderr
    assert any("a/#.png" in line for line in json.loads(answered.stdout)["not_used"])
    assert not json.loads(answered.stdout)["with_joints"]


# ---- pairs without images


@pytest.mark.parametrize("name", ["s{n}/{of}.txt", "{of}_run{n}.csv", "day {n}/data/{of}.txt"])
def test_sessions_of_pairs_are_never_mixed(name: str, tmp_path: Path) -> None:
    scenes = {n: Scene(views=12, seed=n) for n in (1, 2)}
    for n, scene in scenes.items():
        for of, poses in (("robot", scene.flange_poses()[0]), ("marker", scene.camera_from_board())):
            path = tmp_path / name.format(n=n, of=of)
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savetxt(path, quaternions(np.array(poses)))
    given = Given(mount="eye-in-hand")
    with raises("several-sets", SeveralReadingsError) as asked:
        believe(look(tmp_path), given)
    choices = choices_of(asked.value)
    for choice, scene in zip(choices, scenes.values(), strict=True):
        rows = believe(look(tmp_path), replace(given, images=choice)).rows
        np.testing.assert_allclose([row.base_from_flange for row in rows], scene.flange_poses()[0], atol=1e-6)
        np.testing.assert_allclose(
            [row.camera_from_board for row in rows], scene.camera_from_board(), atol=1e-6
        )


def test_images_without_a_board_beside_pairs_are_named(tmp_path: Path) -> None:
    scene = Scene(views=12)
    for of, poses in (("robot", scene.flange_poses()[0]), ("target_in_cam", scene.camera_from_board())):
        np.savetxt(tmp_path / f"{of}.txt", quaternions(np.array(poses)))
    for n in range(12):
        cv2.imwrite(str(tmp_path / f"shot{n}.png"), np.full((384, 480), 10 * n, np.uint8))
    with raises("several-readings", SeveralReadingsError) as asked:
        believe(look(tmp_path))
    assert "shot#.png" in str(asked.value.values["decides"])
    believed = believe(look(tmp_path), Given(mount="eye-in-hand"))
    assert len(believed.rows) == 12
    assert "shot#.png" in believed.facts["images"][0]


def camodocals(folder: Path, robot: np.ndarray, seen: np.ndarray, name: str = "T{of}_{n}") -> None:
    rows = {}
    for n in range(len(robot)):
        rows[name.format(of=1, n=n)] = robot[n].tolist()
        rows[name.format(of=2, n=n)] = seen[n].tolist()
    (folder / "TransformPairs.yaml").write_text(json.dumps(rows))


@pytest.mark.parametrize("name", ["T{of}_{n}", "pose{of}-{n:02d}", "H{n}_{of}"])
def test_a_number_that_tells_two_things_apart_is_not_folded(name: str, tmp_path: Path) -> None:
    scene = Scene(views=12)
    robot, seen = scene.flange_poses()[0], scene.camera_from_board()
    camodocals(tmp_path, robot, seen, name)
    with raises("which-poses", SeveralReadingsError) as asked:
        believe(look(tmp_path))
    choices = choices_of(asked.value)
    rows = believe(look(tmp_path, Path(choices[0])), Given("moveit", "eye-in-hand")).rows
    np.testing.assert_allclose([row.base_from_flange for row in rows], robot, atol=1e-6)
    np.testing.assert_allclose([row.camera_from_board for row in rows], seen, atol=1e-6)


def test_a_grid_of_places_is_one_table(shots: Shots, tmp_path: Path) -> None:
    for n in range(VIEWS):
        shots.save(tmp_path / f"img_{n // 4}_{n % 4}.png", "one", n)
        told = " ".join(map(str, quaternions(shots.flanges["one"])[n]))
        (tmp_path / f"tcp_{n // 4}_{n % 4}.txt").write_text(told)
    assert require_right(shots, tmp_path) == {"one"}


FIXED = Scene(views=VIEWS, seed=3, mount="eye-to-hand")
FINGER = pose(rotation_exp([0, 0, 0.3]), [0.01, 0.02, 0.08])


def write_hand_and_finger(folder: Path, flange: np.ndarray) -> None:
    rows = [{"arm_hand": T.tolist(), "arm_finger": (T @ FINGER).tolist()} for T in flange]
    (folder / "poses.json").write_text(json.dumps(rows))


def test_poses_of_several_parts_of_an_arm_give_a_fixed_camera_one_x(tmp_path: Path) -> None:
    """Hand and finger carry the same board."""
    recording = open_recording(write_session(tmp_path / "s.mcap", FIXED))
    for view, image in recording.images():
        cv2.imwrite(str(tmp_path / f"{view.index}.png"), image.pixels)
    (tmp_path / "s.mcap").unlink()
    write_hand_and_finger(tmp_path, np.array([view.base_from_flange for view in recording.views()]))
    found = believe(look(tmp_path), Given(mount="eye-to-hand", board=PAPER_BOARD))
    assert "the same X" in found.facts["poses"][1]


def test_which_part_of_an_arm_carries_a_camera_is_asked(shots: Shots, tmp_path: Path) -> None:
    save_images(shots, tmp_path, "{n}.png")
    write_hand_and_finger(tmp_path, shots.flanges["one"])
    with raises("several-readings", SeveralReadingsError) as asked:
        believe(look(tmp_path), GIVEN)
    assert isinstance(asked.value, SeveralReadingsError)
    tables = {reading.options["poses"] for reading in asked.value.readings}
    assert tables == {"poses.json arm_hand", "poses.json arm_finger"}


# ---- too few, and what are no poses


def as_rows(folder: Path, T: np.ndarray, C: np.ndarray) -> None:
    np.savetxt(folder / "robot.txt", quaternions(T))
    np.savetxt(folder / "marker.txt", quaternions(C))


def as_unnamed_rows(folder: Path, T: np.ndarray, C: np.ndarray) -> None:
    np.savetxt(folder / "a.txt", quaternions(T))
    np.savetxt(folder / "b.txt", quaternions(C))


def as_a_list_of_pairs(folder: Path, T: np.ndarray, C: np.ndarray) -> None:
    pairs = [[F.tolist(), G.tolist()] for F, G in zip(T, C, strict=True)]
    (folder / "pairs.json").write_text(json.dumps(pairs))


def as_samples(folder: Path, T: np.ndarray, C: np.ndarray) -> None:
    rows = [{"tcp": F.tolist(), "target": G.tolist()} for F, G in zip(T, C, strict=True)]
    (folder / "samples.json").write_text(json.dumps({"samples": rows}))


def as_images(folder: Path, T: np.ndarray, C: np.ndarray) -> None:
    np.savetxt(folder / "robot.txt", quaternions(T))
    for n in range(len(T)):
        cv2.imwrite(str(folder / f"{n}.png"), np.full((384, 480), 10 * n, np.uint8))


def as_folders(folder: Path, T: np.ndarray, C: np.ndarray) -> None:
    for n, each in enumerate(T):
        (folder / f"pose_{n}").mkdir()
        (folder / f"pose_{n}/data.json").write_text(json.dumps({"O_T_EE": each.tolist()}))
        cv2.imwrite(str(folder / f"pose_{n}/image.png"), np.full((384, 480), 10 * n, np.uint8))


@pytest.mark.parametrize("count", [1, 2, 3, 4])
@pytest.mark.parametrize(
    "write", [as_rows, as_unnamed_rows, as_a_list_of_pairs, as_samples, as_images, as_folders]
)
def test_fewer_than_needed_are_counted(
    write: Callable[[Path, np.ndarray, np.ndarray], None], count: int, tmp_path: Path
) -> None:
    scene = Scene(views=12)
    robot = np.array(scene.flange_poses()[0])[:count]
    write(tmp_path, robot, np.array(scene.camera_from_board())[:count])
    if write is as_a_list_of_pairs and count == 1:
        pytest.skip("two poses in a list may be anything")
    with raises("too-few-pairs", pairs=count, needed=5):
        believe(look(tmp_path))
    with raises("too-few-pairs", pairs=count, needed=5):
        believe(reader.look(tmp_path))


def test_fewer_than_needed_are_counted_where_the_robots_are_told(tmp_path: Path) -> None:
    scene = Scene(views=12)
    for count in (1, 2, 4):
        as_rows(
            tmp_path, np.array(scene.flange_poses()[0])[:count], np.array(scene.camera_from_board())[:count]
        )
        with raises("too-few-pairs", pairs=count, needed=5):
            believe(look(tmp_path, Path("robot.txt")))


@pytest.mark.parametrize("name", ["robot.csv", "joints.csv", "poses.csv"])
def test_joints_are_not_called_poses(name: str, tmp_path: Path) -> None:
    """Of seven axes: as many numbers as of a pose with a quaternion."""
    joints = np.random.default_rng(0).uniform(-2, 2, (12, 7))
    np.savetxt(tmp_path / name, joints, delimiter=",")
    np.savetxt(tmp_path / "marker.txt", quaternions(np.array(Scene(views=12).camera_from_board())))
    cause = "joints" if "joint" in name else "quaternion"
    with raises("not-poses", table=name, cause=cause):
        believe(look(tmp_path))


# ---- files that are not used


def test_two_sizes_are_said(shots: Shots, tmp_path: Path) -> None:
    paths = save_images(shots, tmp_path, "images/{n}.png")
    np.savetxt(tmp_path / "robot.txt", quaternions(shots.flanges["one"]))
    cv2.imwrite(str(paths[3]), cv2.resize(shots.pixels["one"][3], None, fx=2, fy=2))
    with raises("image-sizes") as refused:
        believe(look(tmp_path), GIVEN)
    sizes = str(refused.value.values["sizes"])
    assert "480×384" in sizes and "960×768" in sizes and paths[3].name in sizes


def test_maps_of_depths_beside_the_pictures_are_no_pictures(shots: Shots, tmp_path: Path) -> None:
    for n, path in enumerate(save_images(shots, tmp_path, "pos{n}.png")):
        cv2.imwrite(str(path.with_name(f"cloud{n}.tiff")), np.zeros((384, 480), np.float32))
    np.savetxt(tmp_path / "robot.txt", quaternions(shots.flanges["one"]))
    assert require_right(shots, tmp_path) == {"one"}


def test_maps_of_depths_alone_are_told(shots: Shots, tmp_path: Path) -> None:
    for n in range(VIEWS):
        cv2.imwrite(str(tmp_path / f"cloud{n}.tiff"), np.zeros((384, 480), np.float32))
    np.savetxt(tmp_path / "robot.txt", quaternions(shots.flanges["one"]))
    with raises("bad-image"):
        believe(look(tmp_path), GIVEN)


def test_maps_of_depths_are_not_why_pictures_show_no_board(tmp_path: Path) -> None:
    for n in range(VIEWS):
        cv2.imwrite(str(tmp_path / f"cloud{n}.tiff"), np.zeros((384, 480), np.float32))
        cv2.imwrite(str(tmp_path / f"pos{n}.png"), np.full((384, 480), 20 * n, np.uint8))
    np.savetxt(tmp_path / "robot.txt", quaternions(np.array(Scene(views=VIEWS).flange_poses()[0])))
    with raises("no-board-found", images="pos#.png"):
        believe(look(tmp_path))


@pytest.mark.parametrize("given", [GIVEN, Given(mount="eye-in-hand")])
@pytest.mark.parametrize("seen", [2, 4])
def test_a_board_in_a_few_of_many_images_is_counted(
    seen: int, given: Given, shots: Shots, tmp_path: Path
) -> None:
    paths = save_images(shots, tmp_path, "{n}.png")
    np.savetxt(tmp_path / "robot.txt", quaternions(shots.flanges["one"]))
    for n, path in enumerate(paths[seen:]):
        cv2.imwrite(str(path), np.full((384, 480), 20 * n, np.uint8))
    with raises("board-seldom-seen", seen=seen, looked=VIEWS, images="#.png"):
        believe(look(tmp_path), given)


OPENCV = """%YAML:1.0
---
translation: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ 1., 2., 3. ]
"""
RESULTS: dict[str, Callable[[Path], object]] = {
    "points.mod": lambda path: path.write_text("CONST robtarget p1:=[[1,2,3],[1,0,0,0]];"),
    "points.src": lambda path: path.write_text("PTP {X 1}"),
    "points.dat": lambda path: path.write_text("DEFDAT P\nDECL E6POS XP1={X 1,Y 2,Z 3,A 4,B 5,C 6}\nENDDAT"),
    "MAIN.LS": lambda path: path.write_text("/PROG MAIN"),
    "poses.pkl": lambda path: path.write_bytes(pickle.dumps([1])),
    "calibration.yaml": lambda path: path.write_text("format: handeye-calibration/2\nboard: {columns: 3}\n"),
    "easy.yaml": lambda path: path.write_text(
        "parameters: {eye_on_hand: false}\ntransformation: {x: 1, y: 2, z: 3, qx: 0, qy: 0, qz: 0, qw: 1}\n"
    ),
    "a_result.yml": lambda path: path.write_text(OPENCV),
    "notes.md": lambda path: path.write_text("eye to hand"),
}


@pytest.mark.parametrize("name", RESULTS)
def test_what_is_seen_and_not_used_is_named(name: str, shots: Shots, tmp_path: Path) -> None:
    save_images(shots, tmp_path, "images/{n}.png")
    np.savetxt(tmp_path / "robot.txt", quaternions(shots.flanges["one"]))
    RESULTS[name](tmp_path / name)
    believed = believe(look(tmp_path), GIVEN)
    assert len(believed.rows) == VIEWS
    (line,) = believed.unused
    assert name in line or Path(name).suffix in line
    held = look(tmp_path)
    assert not {"rows", "cols", "columns"} & held.facts.keys()


def test_many_files_of_a_kind_are_one_line(shots: Shots, tmp_path: Path) -> None:
    save_images(shots, tmp_path, "images/{n}.png")
    np.savetxt(tmp_path / "robot.txt", quaternions(shots.flanges["one"]))
    for n in range(20):
        (tmp_path / f"step{n}.ls").write_text("/PROG")
        (tmp_path / f"draw{n}.py").write_text("pass")
    lines_told = believe(look(tmp_path), GIVEN).unused
    assert len(lines_told) == 2
    assert all("20" in line for line in lines_told)


def test_another_table_beside_the_one_that_is_used_is_named(shots: Shots, tmp_path: Path) -> None:
    save_images(shots, tmp_path, "images/{n}.png")
    for n, scene in ((1, "one"), (2, "two")):
        np.savetxt(tmp_path / f"robot_{n}.csv", quaternions(shots.flanges[scene]))
    assert require_right(shots, tmp_path) == {"one"}
    assert len(believe(look(tmp_path), GIVEN).unused) == 1


# ---- how others describe a board

DESCRIBED = {
    "board.yml": "%YAML:1.0\n---\nsquareSize: 25.0\nboardWidth: 7\nboardHeight: 6\n",
    "settings.xml": "<?xml version='1.0'?><opencv_storage><Settings><BoardSize_Width>7</BoardSize_Width>"
    "<BoardSize_Height>6</BoardSize_Height><Square_Size>25</Square_Size></Settings></opencv_storage>",
    "board.json": '{"image": {"width": 48, "height": 38}, '
    '"nCornersX": 7, "nCornersY": 6, "squareSizeMm": 25}',
    "board_w.yaml": "board_w: 7\nboard_h: 6\nsquare_size: 0.025\n",
    "pattern.yaml": "pattern_cols: 7\npattern_rows: 6\nsquare_length: 0.025\n",
    "corners.yaml": "corners_per_row: 7\ncorners_per_col: 6\nsquare_length_mm: 25\n",
    "num.yaml": "numCornersHorizontal: 7\nnumCornersVertical: 6\nsquareMm: 25\n",
    "squares.json": '{"squaresX": 8, "squaresY": 7, "squareLength": 0.025}',
    "checker.yaml": "checkerboardRows: 6\ncheckerboardColumns: 7\ncheckerboardSquareSize: 0.025\n",
    "nested.json": '{"chessboard": {"cols": 7, "rows": 6, "size": 0.025}}',
    "nested.yaml": "target:\n  board:\n    width: 7\n    height: 6\n    length: 25\n",
    "unit.yaml": "pattern: {columns: 7, rows: 6, square_size: 2.5, unit: cm}\n",
    "list.yaml": "checkerboard: {pattern_size: [7, 6], side: 0.025}\n",
    "words.txt": "board: 7x6\nsquare 25 mm\n",
    "words.yaml": "board: 7 x 6 inner corners, squares of 25 mm\n",
    "equal.txt": "board = 7 × 6\nsquare = 2.5 cm\n",
    "sentence.txt": "The chessboard has 7x6 corners and 25 mm squares.\n",
    "comment.txt": "# board 7x6, 25mm\n",
    "as_typed.yaml": "board: 7x6 25\n",
}


@pytest.mark.parametrize("name", DESCRIBED)
def test_a_board_is_read_as_a_file_describes_it(name: str, shots: Shots, tmp_path: Path) -> None:
    save_images(shots, tmp_path, "images/{n}.png")
    np.savetxt(tmp_path / "robot.txt", quaternions(shots.flanges["one"]))
    (tmp_path / name).write_text(DESCRIBED[name])
    board_read = believe(look(tmp_path), Given(mount="eye-in-hand")).dataset.board
    assert (board_read.columns, board_read.rows, board_read.square_m) == (7, 6, 0.025)
    assert not board_read.square_guessed


def test_what_is_told_beside_the_poses_is_read_too(shots: Shots, tmp_path: Path) -> None:
    """Also as a comment above them."""
    save_images(shots, tmp_path, "images/{n}.png")
    rows = lines(quaternions(shots.flanges["one"]))
    for above in ("# board 7x6, squares of 25 mm", "board: 7x6\nsquare: 25 mm"):
        (tmp_path / "robot.csv").write_text("\n".join([above, *rows]))
        board_read = believe(look(tmp_path), Given(mount="eye-in-hand")).dataset.board
        assert (board_read.columns, board_read.rows, board_read.square_m) == (7, 6, 0.025)
        assert not board_read.square_guessed


@pytest.mark.parametrize("told", ["square_size: 0.025\n", "squareMm: 25\n"])
def test_a_square_is_used_though_nothing_tells_the_boards_size(
    told: str, shots: Shots, tmp_path: Path
) -> None:
    save_images(shots, tmp_path, "images/{n}.png")
    np.savetxt(tmp_path / "robot.txt", quaternions(shots.flanges["one"]))
    (tmp_path / "board.yaml").write_text(told)
    believed = believe(look(tmp_path), Given(mount="eye-in-hand"))
    board_read = believed.dataset.board
    assert ({board_read.columns, board_read.rows}, board_read.square_m) == ({7, 6}, 0.025)
    assert not board_read.square_guessed


def test_kalibrs_grid_of_tags_is_read() -> None:
    told = {"target_type": "aprilgrid", "tag_cols": 6, "tag_rows": 5, "tag_size": 0.088, "tag_spacing": 0.3}
    (board_read,) = described(told).boards
    assert (board_read.kind, board_read.columns, board_read.rows) == (BoardKind.APRIL_GRID, 6, 5)
    assert (board_read.square_m, board_read.marker_m) == (0.088, pytest.approx(0.0264))


@pytest.mark.parametrize(
    "value", [["a", "b"], [None, 3], {"x": 1}, [5], float("inf"), float("nan"), 1e300, "1e999"]
)
@pytest.mark.parametrize(
    "key", ["board_size", "dictionary", "tag_cols", "tag_spacing", "square_size", "rows"]
)
def test_what_is_no_board_is_passed_over(key: str, value: Any) -> None:
    """Other people's files hold anything under the keys of a board."""
    grid = {"tag_cols": 6, "tag_rows": 5, "tag_size": 0.088, "tag_spacing": 0.3}
    for told in (grid, {"columns": 8, "rows": 6, "square_size": 0.03}):
        found = described(told | {key: value})
        for each in found.boards:
            assert 0 < each.columns < 100 and 0 <= each.rows < 100
            assert np.isfinite(each.square_m)
        assert np.isfinite([found.square_m, found.tag_m]).all()


def test_a_charuco_board_is_looked_for_in_both_patterns() -> None:
    """OpenCV drew boards with an even number of rows otherwise before version 4.6."""
    told = {"rows": 8, "columns": 6, "square_size": 0.03, "marker_size": 0.022, "dictionary": "DICT_5X5_100"}
    boards = described(told).boards
    assert {board.kind for board in boards} == {BoardKind.CHARUCO}
    assert {board.legacy for board in boards} == {False, True}


# ---- what others left

RIGHT = ("csv-with-header-names-not-used", "date-behind-the-pose", "one-folder-a-pose")


@pytest.mark.skipif(not FAILING.is_dir(), reason="the inputs that once went wrong are not here")
@pytest.mark.parametrize("name", RIGHT)
def test_inputs_that_once_went_wrong_are_read(name: str) -> None:
    believed = believe(look(FAILING / name / "data"))
    assert believed.dataset.mount == "eye-in-hand"
    assert len(believed.rows) == 12
    assert believed.dataset.board.square_m == pytest.approx(0.025, rel=0.01)


@pytest.mark.skipif(not FAILING.is_dir(), reason="the inputs that once went wrong are not here")
def test_inputs_that_once_went_wrong_are_asked_about() -> None:
    for name, code in (
        ("two-cameras-in-one-folder", "several-sets"),
        ("two-sizes-said-no-board", "image-sizes"),
    ):
        with raises(code):
            believe(look(FAILING / name / "data"))


def left_handed(flange: np.ndarray) -> list[float]:
    """Position and quaternion in a frame whose y is turned over, as Unity and Unreal have it."""
    x, y, z = flange[:3, 3]
    qx, qy, qz, qw = quaternion_from_matrix(flange[:3, :3])
    return [x, -y, z, -qx, qy, -qz, qw]


def test_poses_of_a_left_handed_frame_are_refused_without_a_word_on_the_board(
    shots: Shots, tmp_path: Path
) -> None:
    """With the size of the board left open, and with fewer views than must agree against outliers."""
    for view in range(VIEWS):
        shots.save(tmp_path / f"images/img_{view:02}.jpg", "one", view)
    rows = [left_handed(flange) for flange in shots.flanges["one"]]
    np.savetxt(tmp_path / "poses.csv", rows, delimiter=",")
    with raises("no-reading"):
        believe(look(tmp_path))


@pytest.mark.skipif(not FAILING.is_dir(), reason="other people's folders are not here")
def test_few_views_that_fix_no_camera_pose_end_in_the_cause() -> None:
    """Of a left-handed frame, too: where the board's size is open, some views give one below zero."""
    folder = FAILING / "left-handed-poses-said-mirrored-images/data"
    with raises("no-reading"):
        believe(look(folder))
