"""What the arm's position at a corner becomes: an offset with the right sign, and how sure it is."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from calibrate.arms.kinematics import MODELS, forward
from calibrate.boards.model import board_points
from calibrate.check.board_now import locate_board, offset_covariance
from calibrate.files.calibration import write_calibration
from calibrate.files.versions import note_in_file
from recordings.geometry import Array, inverse, perturb, pose, rotation_exp, rotation_log, transform_points
from recordings.schema.messages import CameraIdentity, RobotIdentity
from station.cell.config import PointerConfig, matrix4
from station.cell.status import CameraStatus, RobotStatus, StationStatus
from station.operate.tip_offsets import SeenBoard, read_touch, see_board
from station.protocol.verbs import Observation, Observe
from station.simulation.cells import cell_config, make_cell
from tests.codes import raises
from tests.recordings.small_recording import make_state
from tests.station.calibrated_cell import POINTER, ROBOT_M, ROBOT_RAD, calibration_of, seen_from

ROBOT, CAMERA = RobotIdentity(model="UR10", serial="1"), CameraIdentity(serial="2")
TIP, PENDANT = (0.01, -0.02, 0.15), (0.0, 0.0, 0.2, 0.0, 0.0, 0.0)
CORNER = 7


class Daemon:
    """Shows the board where it truly lies."""

    root, camera = None, "main"

    def __init__(self, mount: str = "eye-in-hand", **changes: object) -> None:
        self.truth = make_cell("paper", 1, "low", mount)
        self.calibration = calibration_of(self.truth, ROBOT, CAMERA)
        self.board = np.array(self.truth.board_place)
        flange = forward(MODELS["UR10"], self.truth.start_joints_rad)
        if mount == "eye-to-hand":  # taken off the flange, and laid down
            self.board = flange @ self.board
            flange = flange @ pose(np.eye(3), [0.0, 0.2, -0.3])
        view = seen_from(self.truth, flange, self.board)
        self.observation = Observation(
            base_from_flange=matrix4(flange),
            corners=tuple(range(len(view.corners))),
            pixels=tuple((float(u), float(v)) for u, v in view.corners.pixels),
        )
        self.observation = msgspec.structs.replace(self.observation, **changes)
        self.robot, self.photographer = msgspec.structs.replace(ROBOT, tcp_offset=PENDANT), CAMERA
        self.config = msgspec.structs.replace(
            cell_config(self.truth), pointer=PointerConfig(TIP), board=self.truth.board
        )

    async def call(self, verb: Any, *, timeout_s: float = 0.0) -> Any:
        assert isinstance(verb, Observe)
        return self.observation

    async def seen(self) -> SeenBoard:
        robot, camera = RobotStatus(self.robot), CameraStatus(self.photographer)
        status = StationStatus(source="simulated", mount=self.truth.mount, robot=robot, camera=camera)
        return await see_board(self, status, self.calibration)

    def touching(self, place_m: Array, tip_m: tuple[float, ...] = TIP, still: bool = True) -> StationStatus:
        """The arm with the tip there in `board`, however the flange is turned."""
        R = rotation_exp([0.4, 2.8, -0.1])
        flange = pose(R, (self.board @ [*place_m, 1.0])[:3] - R @ tip_m)
        tcp_pose = (*flange[:3, 3].tolist(), *rotation_log(flange[:3, :3]).tolist())  # no pendant offset
        state = msgspec.structs.replace(make_state(0), tcp_pose=tcp_pose)
        return StationStatus(robot=RobotStatus(RobotIdentity(), state, still=still))


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
async def test_the_tip_on_the_true_corner_tells_the_offset_the_other_way_round(
    mount: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And whoever holds it: a name that is no UTF-8 goes into the file, too."""
    monkeypatch.setenv("LOGNAME", os.fsdecode(b"anna\xff"))
    daemon = Daemon(mount)
    board = await daemon.seen()
    corner = board_points(daemon.truth.board)[CORNER]
    touch = read_touch(board, CORNER, daemon.touching(corner + np.array([2e-4, -1e-4, 1e-3])))
    assert touch.offset_mm == pytest.approx((-0.2, 0.1), abs=0.02)
    assert touch.corner_mm == pytest.approx(1000 * corner[:2])
    assert (touch.corner, touch.found) == (CORNER, "read from the arm")
    assert 0.01 < min(touch.sigma_mm) <= max(touch.sigma_mm) < 1
    write_calibration(daemon.calibration, tmp_path / "c.yaml")
    assert note_in_file(tmp_path / "c.yaml", [touch]).verification == [touch]


@pytest.mark.parametrize(("configured", "tip"), [(True, TIP), (False, PENDANT[:3])])
async def test_the_pointer_is_the_configured_one_else_the_pendants(
    configured: bool, tip: tuple[float, ...]
) -> None:
    daemon = Daemon()
    if not configured:
        daemon.config = msgspec.structs.replace(daemon.config, pointer=None)
    board = await daemon.seen()
    corner = board_points(daemon.truth.board)[CORNER]
    touch = read_touch(board, CORNER, daemon.touching(corner, tip))
    assert touch.offset_mm == pytest.approx((0.0, 0.0), abs=0.02)


@pytest.mark.parametrize(
    ("beside", "code"),
    [
        ((0.0, 0.0, 0.011), "not-touching"),
        ((0.0, 0.0, -0.011), "not-touching"),
        ((0.06, 0.0, 0.0), "other-corner"),
    ],
)
async def test_a_tip_off_the_board_or_at_another_corner_is_no_touch(
    beside: tuple[float, ...], code: str
) -> None:
    daemon = Daemon()
    board = await daemon.seen()
    there = daemon.touching(board_points(daemon.truth.board)[CORNER] + beside)
    with raises(code) as refused:
        read_touch(board, CORNER, there)
    assert refused.value.values["distance_m"] == pytest.approx(max(map(abs, beside)), abs=1e-4)


async def test_what_is_not_known_and_another_cell_are_refused() -> None:
    daemon = Daemon()
    board = await daemon.seen()
    for status in (None, StationStatus()):
        with raises("no-robot-state"):
            read_touch(board, CORNER, status)
    with raises("arm-moves"):
        read_touch(board, CORNER, daemon.touching(board_points(daemon.truth.board)[CORNER], still=False))
    bare, blind, elsewhere = Daemon(), Daemon(corners=(), pixels=()), Daemon()
    bare.robot, bare.config = ROBOT, msgspec.structs.replace(bare.config, pointer=None)
    elsewhere.photographer = CameraIdentity(serial="3")
    unknown = Daemon()
    unknown.robot = None
    for other, code in (
        (bare, "no-pointer"),
        (blind, "no-board"),
        (elsewhere, "views-of-another-cell"),
        (unknown, "no-robot-state"),
    ):
        with raises(code):
            await other.seen()


def test_the_predicted_offset_is_what_repetitions_show() -> None:
    """The installed X, the picture and the robot err; the tip misses the corner by as much as was said."""
    truth, rng = make_cell(seed=5), np.random.default_rng(3)
    E, board = forward(MODELS["UR10"], truth.start_joints_rad), np.array(truth.board_place)
    corner = board_points(truth.board)[0]
    nominal = calibration_of(truth, ROBOT, CAMERA)
    root = np.linalg.cholesky(np.array(nominal.covariance))
    misses, distances = [], []
    for _ in range(200):
        calibration = calibration_of(truth, ROBOT, CAMERA, root @ rng.normal(size=6))

        def robot_error() -> Array:
            return np.r_[rng.normal(0, ROBOT_M, 3), rng.normal(0, ROBOT_RAD, 3)]

        view = seen_from(truth, E, board, rng, told=perturb(E, robot_error()))
        now = locate_board(calibration, view)
        covariance = offset_covariance(calibration, now, corner, POINTER.tip_m)
        # The arm is sent where the tip would touch the corner, and misses by its own error.
        target = transform_points(now.base_from_board, corner)
        tip = np.array(POINTER.tip_m)
        flange = pose(E[:3, :3], target - E[:3, :3] @ tip)
        miss = transform_points(inverse(board) @ perturb(flange, robot_error()), tip) - corner
        misses.append(miss)
        distances.append(float(miss[:2] @ np.linalg.inv(covariance[:2, :2]) @ miss[:2]))
    assert np.sqrt(np.mean(np.square(misses), axis=0))[:2] == pytest.approx(
        np.sqrt(np.diag(covariance))[:2], rel=0.15
    )
    assert np.mean(np.array(distances) < 5.99) == pytest.approx(0.95, abs=0.04)


def test_a_board_still_on_the_flange_is_noticed() -> None:
    truth = make_cell(mount="eye-to-hand")
    E = forward(MODELS["UR10"], truth.start_joints_rad)
    view = seen_from(truth, E, E @ np.array(truth.board_place))
    with raises("board-on-flange"):
        locate_board(calibration_of(truth, ROBOT, CAMERA), view)


def test_a_moved_board_is_found_where_it_is() -> None:
    truth = make_cell()
    E, moved = forward(MODELS["UR10"], truth.start_joints_rad), np.array(truth.board_place)
    moved[:3, 3] += [0.03, -0.02, 0.01]
    now = locate_board(calibration_of(truth, ROBOT, CAMERA), seen_from(truth, E, moved))
    assert now.base_from_board == pytest.approx(moved, abs=1e-6)
