"""`calibrate watch`: a folder that grows, an alarm, doubt, and going on after a restart."""

from __future__ import annotations

import fcntl
import json
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from benchmarks.watch import Cell, Happening, simulate
from calibrate.boards.model import board_points
from calibrate.cli import main
from calibrate.cli.watch import next_steps
from calibrate.files.install import install, set_validity
from calibrate.files.lines import read_lines
from calibrate.files.loader import load_installed
from calibrate.files.validity import ValidityReason, ValidityState
from calibrate.geometry import Array, inverse, perturb, pose, quaternion_from_matrix, rotation_exp
from calibrate.projection import project_at
from calibrate.quality.movement import log as movement_log
from calibrate.quality.movement import monitor
from calibrate.quality.movement.evidence import Moved
from calibrate.quality.movement.log import FILE, MonitorLog, WatchedTag, WatchEntry
from calibrate.quality.movement.monitor import MovementMonitor
from calibrate.quality.movement.pictures import Picture
from recordings.schema.messages import BoardKind, BoardSpec
from tests.calibrate.sessions import looking
from tests.command_line import call

TAG = BoardSpec(BoardKind.APRIL_TAG, square_m=0.05)
TAG_PLACE = pose(rotation_exp([np.pi, 0.1, 0.2]), [0.6, 0.0, 0.05])


class Production:
    """A folder of pictures of one tag that a program adds to; the camera may move."""

    def __init__(self, folder: Path, root: Path) -> None:
        found = load_installed(root)
        self.folder, self.lens, self.X = folder, found.intrinsics.model, found.transform.matrix
        self.rng = np.random.default_rng(7)
        self.count = 0
        seen = [looking(TAG, self.rng, roll_rad=2.0) for _ in range(6)]
        self.flanges = [TAG_PLACE @ inverse(C) @ inverse(self.X) for C in seen]
        folder.mkdir()
        stated = {
            "mount": "eye-in-hand",
            "board": {"kind": "april-tag", "square_m": 0.05, "id": 0},
            "camera": {"width": self.lens.width, "height": self.lens.height},
        }
        (folder / "dataset.yaml").write_text(yaml.safe_dump(stated))
        (folder / "poses.csv").write_text("image,x,y,z,qx,qy,qz,qw\n")

    def take(self, pictures: int, tag: bool = True) -> None:
        for _ in range(pictures):
            F = self.flanges[self.count % len(self.flanges)]
            true = perturb(F, self.rng.normal(size=6) * np.repeat([2e-5, 2e-5], 3))
            name = f"{self.count:04}.png"
            cv2.imwrite(str(self.folder / name), self._drawn(inverse(true @ self.X) @ TAG_PLACE, tag))
            numbers = [*F[:3, 3], *quaternion_from_matrix(F[:3, :3])]
            with (self.folder / "poses.csv").open("a") as file:
                file.write(",".join([name, *(repr(float(x)) for x in numbers)]) + "\n")
            self.count += 1

    def _drawn(self, C: Array, tag: bool) -> Any:
        cell_px = 20
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
        marker = cv2.aruco.generateImageMarker(dictionary, 0, 8 * cell_px)
        sheet = np.full((10 * cell_px, 10 * cell_px), 230, np.uint8)
        if tag:
            sheet[cell_px:-cell_px, cell_px:-cell_px] = marker
        near, far = cell_px - 0.5, 9 * cell_px - 0.5
        corners = np.array([[near, near], [far, near], [near, far], [far, far]], np.float32)
        H = cv2.getPerspectiveTransform(
            corners, project_at(self.lens, C, board_points(TAG)).astype(np.float32)
        )
        size = (2 * self.lens.width, 2 * self.lens.height)
        finer = np.array([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1]])
        drawn = cv2.warpPerspective(sheet, finer @ H, size, flags=cv2.INTER_LINEAR, borderValue=230)
        small = cv2.resize(drawn, (self.lens.width, self.lens.height), interpolation=cv2.INTER_AREA)
        return np.clip(small + self.rng.normal(size=small.shape) * 2, 0, 255).astype(np.uint8)


@pytest.fixture
def root(make_file: Callable[..., Path], tmp_path: Path) -> Path:
    install(make_file(), tmp_path / "s")
    return tmp_path / "s"


def watch(root: Path, *arguments: object) -> tuple[int, list[dict[str, Any]]]:
    done = call(main, "watch", *arguments, "--root", root, "--json")
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()]


def test_a_camera_that_moves_between_two_runs_is_noticed_named_and_put_in_doubt(
    root: Path, tmp_path: Path
) -> None:
    production = Production(tmp_path / "pictures", root)
    production.take(75)
    code, lines = watch(root, production.folder)
    assert code == 0 and [line["event"] for line in lines] == ["learned", "testing", "summary"]
    assert lines[-1]["values"]["state"] == "watching"
    assert load_installed(root).validity.state is ValidityState.VALID

    production.X = perturb(production.X, np.array([0.002, -0.001, 0, 0, 0, 0.002]))
    production.take(20)
    code, lines = watch(root, production.folder)
    assert code == 4 and [line["event"] for line in lines] == ["alarm", "summary"]
    assert lines[0]["validity"]["state"] == "in-doubt" and lines[0]["pictures"] <= 75 + 10
    doubted = load_installed(root, require_valid=False).validity
    assert (doubted.state, doubted.reason.code) == (ValidityState.IN_DOUBT, "watch")

    production.take(25)
    code, lines = watch(root, production.folder)
    assert code == 4 and lines[0]["event"] == "named" and lines[0]["moved"] == Moved.CAMERA
    assert lines[0]["values"]["moved_mm"] == pytest.approx(2.24, abs=0.4)
    assert lines[0]["next"] == next_steps(Moved.CAMERA, str(root / "calibrations" / "current"))

    set_validity(root, ValidityState.VALID, ValidityReason("drift-check"))
    code, lines = watch(root, production.folder)  # a proof since: it learns anew, and no picture counts twice
    assert code == 0 and lines[-1]["values"]["state"] == "learning" and lines[-1]["pictures"] < 30


def test_pictures_without_the_tag_are_said(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(monitor, "MISSED_AFTER", 3)
    production = Production(tmp_path / "pictures", root)
    production.take(4, tag=False)
    code, lines = watch(root, production.folder)
    assert code == 0 and [line["event"] for line in lines] == ["tag-unseen", "summary"]
    assert lines[-1]["values"]["state"] == "learning" and lines[-1]["pictures"] == 0


def test_what_is_wrong_with_a_source_is_said_with_a_code(root: Path, tmp_path: Path) -> None:
    production = Production(tmp_path / "pictures", root)
    production.take(1)
    (production.folder / "0000.png").unlink()
    code, lines = watch(root, production.folder)
    assert code == 1 and lines[-1]["error"]["code"] == "watch-source"
    stated = yaml.safe_load((production.folder / "dataset.yaml").read_text()) | {"mount": "eye-to-hand"}
    (production.folder / "dataset.yaml").write_text(yaml.safe_dump(stated))
    code, lines = watch(root, production.folder)
    assert code == 1 and lines[-1]["error"]["code"] == "watch-source"


def test_a_station_is_watched_by_its_own_command(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # Unix sockets have short names
    with socket.socket(socket.AF_UNIX) as station:
        station.bind("here")
        code, lines = watch(root, Path("here"))
    assert code == 1 and lines[-1]["error"]["code"] == "watch-source"
    assert "station watch --socket" in lines[-1]["error"]["remedy"]


def test_a_recording_does_not_grow(root: Path, session_file: Path) -> None:
    done = call(main, "watch", session_file, "--follow", "--root", root, "--json")
    assert done.returncode in (1, 2)


# --- the log ---
WATCHED = WatchedTag(1, TAG)


def entry(picture: Picture) -> WatchEntry:
    return WatchEntry(
        None,
        picture.name,
        picture.name,
        0.0,
        tuple(map(tuple, picture.base_from_flange.tolist())),
        tuple(np.asarray(picture.joints_rad).tolist()),
        picture.corners,
        tuple(map(tuple, picture.pixels.tolist())),
    )


def test_a_restart_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, pictures = simulate(Cell(9, "eye-to-hand", True), 660, Happening("camera", 1.0))
    pictures = pictures[430:]
    monkeypatch.setattr("os.fsync", lambda descriptor: None)
    path = tmp_path / FILE
    told = []
    for start in range(0, len(pictures), 75):
        log = MonitorLog(path, WATCHED, model)  # as after a crash: nothing was closed
        assert all(log.knows(picture.name) for picture in pictures[:start])
        for picture in pictures[start : start + 75]:
            told += log.add(entry(picture))
        with path.open("ab") as file:
            file.write(b'{"key": "cut')
    assert told == list(MovementMonitor(model).add(pictures)) and told[-1].moved is not None


def test_a_long_log_is_shortened_and_still_notices(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(movement_log, "_MOST", 250)
    monkeypatch.setattr(movement_log, "_LATEST", 90)
    monkeypatch.setattr("os.fsync", lambda descriptor: None)
    model, pictures = simulate(Cell(9, "eye-to-hand", True), 660, Happening("camera", 1.0))
    path = tmp_path / FILE
    log = MonitorLog(path, WATCHED, model)
    for picture in pictures[330:600]:
        log.add(entry(picture))
    assert len(read_lines(path, WatchEntry)) <= 252
    again = MonitorLog(path, WATCHED, model)
    assert not again.monitor.alarmed
    assert any(again.add(entry(picture)) for picture in pictures[600:]) and again.monitor.alarmed


@pytest.mark.parametrize("repeated", [True, False])
def test_a_shortened_log_remembers_what_was_learned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, repeated: bool
) -> None:
    monkeypatch.setattr(movement_log, "_MOST", 800)
    monkeypatch.setattr(movement_log, "_LATEST", 500)
    monkeypatch.setattr(monitor, "SHIFT_M", 0.25e-3)
    monkeypatch.setattr("os.fsync", lambda descriptor: None)
    model, pictures = simulate(Cell(11, "eye-in-hand", repeated, creep_mm=0.2), 3000, None)
    wanted = next(e for e in MovementMonitor(model).add(pictures) if e.kind is monitor.EventKind.ALARM)
    path = tmp_path / FILE
    log = MonitorLog(path, WATCHED, model)
    for picture in pictures[:1100]:
        log.add(entry(picture))
    assert sum(line.gap for line in read_lines(path, WatchEntry)) == 1
    again = MonitorLog(path, WATCHED, model)
    assert not again.monitor.alarmed
    near = int(wanted.picture) + 100
    told = [event for picture in pictures[1100:near] for event in again.add(entry(picture))]
    assert told[0].values["crept"] is True
    assert int(told[0].picture) > int(wanted.picture) - 100


def test_another_version_or_tag_begins_anew(tmp_path: Path) -> None:
    model, pictures = simulate(Cell(9, "eye-to-hand", True), 3, None)
    log = MonitorLog(tmp_path / FILE, WATCHED, model)
    log.add(entry(pictures[0]))
    assert MonitorLog(tmp_path / FILE, WATCHED, model).knows(pictures[0].name)
    assert not MonitorLog(tmp_path / FILE, WatchedTag(2, TAG), model).knows(pictures[0].name)


def test_two_watches_of_a_camera_do_not_mix(root: Path, tmp_path: Path) -> None:
    production = Production(tmp_path / "pictures", root)
    production.take(1)
    assert watch(root, production.folder)[0] == 0
    kept = (root / "calibrations" / FILE).read_bytes()
    production.take(1)
    with (root / "calibrations" / "watch.lock").open() as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        code, lines = watch(root, production.folder)
        assert code == 1 and lines[-1]["error"]["code"] == "watched-already"
        assert (root / "calibrations" / FILE).read_bytes() == kept
    assert watch(root, production.folder)[1][-1]["pictures"] == 2
