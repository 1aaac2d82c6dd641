"""`station watch`: the daemon's pictures, one after the other, held against what is installed below it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from benchmarks.watch import Cell, Happening, simulate
from calibrate.files.calibration import FramePose, write_calibration
from calibrate.files.install import install
from calibrate.files.lines import read_lines
from calibrate.files.loader import load_installed
from calibrate.files.validity import ValidityState
from calibrate.geometry import Transform
from calibrate.quality.movement.log import FILE, WatchEntry
from calibrate.quality.movement.pictures import CellModel, Picture
from recordings.files import MAIN_CAMERA
from recordings.schema.messages import BoardKind, BoardSpec, CameraIdentity, RobotIdentity
from station.cell.errors import RefusedError
from station.cli import main
from station.cli import watch as station_watch
from station.protocol.verbs import Observation, Observe, Verb
from tests.command_line import call
from tests.station.calibrated_cell import calibration_of
from tests.station.session_rig import TRUTH

TAG = BoardSpec(BoardKind.APRIL_TAG, square_m=0.05)
MOVED_AT = 600


def production() -> tuple[CellModel, list[Picture]]:
    return simulate(Cell(9, "eye-in-hand", True), MOVED_AT + 60, Happening("camera", 3.0))


class FakeDaemon:
    """Answers with pictures of a simulated cell; refuses some of the first."""

    def __init__(self, first: int, **changes: object) -> None:
        self.pictures = production()[1][first:]
        self.refusals = [RefusedError("arm-moves"), RefusedError("wrong-state")]
        self.changes = changes

    def __call__(self, path: Path, verb: Verb[Any]) -> Observation:
        assert verb == Observe(TAG)
        if len(self.pictures) % 10 == 3 and self.refusals:
            raise self.refusals.pop()
        picture = self.pictures.pop(0)
        told: dict[str, Any] = {
            "mount": "eye-in-hand",
            "source": "real",
            "robot_serial": "",
            "camera_serial": "",
            "wall_ns": 1_000_000_000 * (MOVED_AT + 70 - len(self.pictures)),
            "rested_s": 0.5,
            "base_from_flange": tuple(map(tuple, picture.base_from_flange.tolist())),
            "joints_rad": tuple(np.asarray(picture.joints_rad).tolist()),
            "width": 1600,
            "height": 1200,
            "corners": picture.corners,
            "pixels": tuple(map(tuple, picture.pixels.tolist())),
        }
        return Observation(**(told | self.changes))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """The cell of `FakeDaemon`, calibrated."""
    model, _ = production()
    told = calibration_of(TRUTH, RobotIdentity("UR10"), CameraIdentity())
    lens = msgspec.structs.replace(
        told.intrinsics,
        width=1600,
        height=1200,
        matrix=model.camera.matrix,
        distortion=model.camera.distortion,
        distortion_model=model.camera.distortion_model,
    )
    result = FramePose.of(Transform("flange", "camera", model.X))
    calibration = msgspec.structs.replace(told, source="real", result=result, intrinsics=lens)
    write_calibration(calibration, tmp_path / "c.yaml")
    install(tmp_path / "c.yaml", tmp_path / "root")
    return tmp_path / "root"


def watch(
    daemon: FakeDaemon, root: Path, monkeypatch: pytest.MonkeyPatch, *options: object
) -> tuple[int, list[dict[str, Any]]]:
    async def cell(path: Path) -> tuple[Path, str, BoardSpec]:
        return root, MAIN_CAMERA, TAG

    monkeypatch.setattr(station_watch, "_cell", cell)
    monkeypatch.setattr(station_watch, "ask", daemon)
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    monkeypatch.setattr("os.fsync", lambda descriptor: None)
    done = call(main, "watch", "--json", *options)
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()]


def test_a_camera_that_moves_is_noticed_in_the_stations_own_pictures(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon = FakeDaemon(MOVED_AT - 200)
    code, lines = watch(daemon, root, monkeypatch, "--images", 190)
    assert code == 0 and lines[-1]["values"]["state"] == "watching" and lines[-1]["pictures"] == 190
    code, lines = watch(daemon, root, monkeypatch)
    assert code == 4 and [line["event"] for line in lines] == ["alarm", "named", "summary"]
    assert lines[0]["pictures"] <= 200 + 10 and lines[1]["moved"] == "camera-or-joint-6"
    assert load_installed(root, require_valid=False).validity.state is ValidityState.IN_DOUBT
    assert not daemon.refusals


@pytest.mark.parametrize(
    ("changes", "error"),
    [({"source": "simulated"}, "views-of-another-cell"), ({"width": 800, "height": 600}, "watch-source")],
)
def test_pictures_of_another_cell_are_no_pictures(
    root: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, object], error: str
) -> None:
    code, lines = watch(FakeDaemon(0, **changes), root, monkeypatch)
    assert code != 0 and lines[-1]["error"]["code"] == error


def test_a_stop_of_the_arm_counts_once(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code, lines = watch(FakeDaemon(0, rested_s=2.5), root, monkeypatch, "--images", 10)
    assert code == 0 and lines[-1]["pictures"] == 10
    kept = [entry for entry in read_lines(root / "calibrations" / FILE, WatchEntry) if entry.key]
    assert np.diff([entry.wall_s for entry in kept]).tolist() == [3.0] * 9


def test_a_station_that_gives_no_first_picture_ends_it(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def daemon(path: Path, verb: object) -> Observation:
        raise RefusedError("camera-gone")

    code, lines = watch(daemon, root, monkeypatch)  # type: ignore[arg-type]
    assert code == 1 and lines[-1]["error"]["code"] == "camera-gone"
