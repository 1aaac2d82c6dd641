"""The verification hover with the real driver: where the tip truly stands, how fast it came, and STOP."""

from __future__ import annotations

import asyncio
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibrate.boards.model import board_points
from calibrate.files.calibration import read_calibration, write_calibration
from calibrate.files.touch import Touch, agrees
from calibrate.files.versions import note_in_file
from calibrate.geometry import Array, inverse, pose
from calibrate.kinematics import MODELS, forward
from recordings.schema.messages import CameraIdentity, Matrix4, RobotIdentity
from station.cell.limits import point_speed_m_s
from station.cell.status import HoverOffer, StationStatus
from station.cell.status import StationState as S
from station.operate.touch_test import read_offset_mm, tip_on_board_m
from station.plan.hover import SPEED_M_S, hover_geometry
from station.protocol.client import Client
from station.simulation.cell import CellTruth, write_truth
from station.simulation.placement import board_centre
from station.simulation.scenes import cell_config
from tests.station.hover_cell import POINTER, SIGMA_M, SIGMA_RAD, board_from_tip, calibration_of
from tests.system.conftest import TRUTH, SystemRig, status_when

pytestmark = pytest.mark.process
BOARD = np.array(TRUTH.board_place)
ERROR = np.array([SIGMA_M, -SIGMA_M, 0.5 * SIGMA_M, SIGMA_RAD, 0.5 * SIGMA_RAD, -SIGMA_RAD])


def matrix4(matrix: Array) -> Matrix4:
    return tuple(tuple(float(v) for v in row) for row in matrix)


def camera_beside() -> tuple[CellTruth, CellTruth]:
    """A camera beside the cell that sees the board where it lies, off the flange: as told, and as rendered.

    The simulation hangs every board of such a cell on the flange. So a long arm on the flange carries the
    camera that is rendered: in the one picture that is taken, at the start, both are at the same place.
    """
    middle = BOARD[:3, :3] @ board_centre(TRUTH.board) + BOARD[:3, 3]
    outward = np.append(middle[:2] / np.linalg.norm(middle[:2]), 0.0)
    eye = middle - 0.7 * BOARD[:3, 2] + 0.5 * outward
    z = (middle - eye) / np.linalg.norm(middle - eye)
    x = BOARD[:3, 0] - (BOARD[:3, 0] @ z) * z
    x /= np.linalg.norm(x)
    camera = pose(np.stack([x, np.cross(z, x), z], axis=1), eye)
    start = forward(MODELS["UR10"], np.array(TRUTH.start_joints_rad))
    told = msgspec.structs.replace(
        TRUTH,
        mount="eye-to-hand",
        camera_mount=matrix4(camera),
        board_place=matrix4(pose(np.eye(3), [0, 0, 0.1])),
    )
    return told, msgspec.structs.replace(TRUTH, camera_mount=matrix4(inverse(start) @ camera))


async def ready(client: Client) -> StationStatus:
    status = await status_when(client, lambda s: s.state is S.IDLE and s.camera.connected)
    await client.request("lease", action="take")
    return status


def write_file(folder: Path, status: StationStatus, error: Array, truth: CellTruth = TRUTH) -> Path:
    robot = RobotIdentity(model=status.robot.model, serial=status.robot.serial)
    camera = CameraIdentity(model=status.camera.model, serial=status.camera.serial, driver="rendered")
    path = folder / "cell.yaml"
    write_calibration(calibration_of(truth, robot, camera, error), path)
    return path


async def offered(client: Client, path: Path, corner: int, new_picture: bool = True) -> HoverOffer:
    answer = await client.request(
        "hover",
        calibration=str(path),
        corner=corner,
        pointer_m=POINTER.tip_m[2],
        new_picture=new_picture,
        timeout_s=60.0,
    )
    return msgspec.convert(answer, HoverOffer)


async def fastest_m_s(rig: SystemRig, told: CellTruth, until_rest: asyncio.Event) -> float:
    """By the controller's own joint speeds, at any modelled point."""
    geometry = hover_geometry(cell_config(told), np.array(told.camera_mount), BOARD, 0.0, POINTER)
    fastest = 0.0
    while not until_rest.is_set():
        state = rig.admin.ask("state")
        fastest = max(fastest, point_speed_m_s(geometry, state["joints_rad"], state["joint_speeds_rad_s"]))
        await asyncio.sleep(0.01)
    return fastest


def true_tip(rig: SystemRig) -> Array:
    """With what the arm misses its own word by."""
    return board_from_tip(BOARD, np.array(rig.admin.ask("truth")["base_from_flange"]), POINTER)


@pytest.mark.parametrize("mount", ["eye-in-hand", pytest.param("eye-to-hand", marks=pytest.mark.soak)])
async def test_the_tip_truly_stands_over_the_corner_slowly_and_the_offset_is_kept(
    rig: SystemRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mount: str
) -> None:
    told = TRUTH
    if mount == "eye-to-hand":
        told, rendered = camera_beside()
        write_truth(rendered, rig.folder / "truth.json")
        write_truth(told, rig.folder / "told.json")
        monkeypatch.setenv("CELL_TOLD", str(rig.folder / "told.json"))
    daemon = await rig.daemon()
    async with await daemon.client() as anna:
        status = await ready(anna)
        path = write_file(tmp_path, status, ERROR, told)
        for first, corner in ((True, 0), (False, 41)):
            offer = await offered(anna, path, corner, first)
            arrived = asyncio.Event()
            watch = asyncio.create_task(fastest_m_s(rig, told, arrived))
            await anna.request("go", token=offer.go.token)
            done = await status_when(anna, lambda s: s.state in (S.IDLE, S.FAULT, S.STOPPED))
            arrived.set()
            assert 0.02 < await watch <= SPEED_M_S
            assert done.state is S.IDLE, done.reason
            tip, place = true_tip(rig), board_points(TRUTH.board)[corner]
            miss = (tip - place)[:2]
            assert (np.abs(miss) <= 3 * np.array(offer.sigma_m)).all()
            assert np.linalg.norm(miss) > 1e-5, "the calibration is a little wrong: so is the tip"
            assert 0.079 < -tip[2] < 0.081
        # The operator's hand brings the tip onto the true corner; the arm tells the same offset.
        flange = forward(MODELS["UR10"], rig.admin.ask("state")["joints_rad"])
        flange[:3, 3] += BOARD[:3, :3] @ (place - tip)
        touching = tip_on_board_m(offer, flange)
        offset_mm = read_offset_mm(offer, touching)
        assert offset_mm == pytest.approx(1000 * miss, abs=0.15)
        sigma = 1000 * offer.sigma_m[0], 1000 * offer.sigma_m[1]
        x, y = (float(v) for v in offset_mm)
        wall = "2026-11-21T12:00:00+00:00"
        touch = Touch(41, (150.0, 125.0), (x, y), sigma, "read from the arm", "anna", wall)
        assert agrees(touch)
        note_in_file(path, [touch])
        assert read_calibration(path).verification == [touch]


async def test_stop_and_a_killed_operator_halt_the_hover(rig: SystemRig, tmp_path: Path) -> None:
    daemon = await rig.daemon()
    anna = await daemon.client()
    async with await daemon.client() as bert:
        path = write_file(tmp_path, await ready(anna), np.zeros(6))
        offer = await offered(anna, path, 0)
        await anna.request("go", token=offer.go.token)
        await rig.until(lambda: rig.speed_rad_s() > 0.005)
        await bert.request("stop")
        assert await rig.at_rest() < 1.0
        stopped = await status_when(bert, lambda s: s.state is S.STOPPED)
        assert stopped.cause == "stop"
        await rig.stays_at_rest()
        await bert.request("acknowledge")
        offer = await offered(anna, path, 0)
        await anna.request("go", token=offer.go.token)
        await rig.until(lambda: rig.speed_rad_s() > 0.005)
        anna._writer.transport.abort()  # what the kernel does to a killed screen
        assert await rig.at_rest() < 1.0
        await status_when(bert, lambda s: s.state is S.IDLE and s.cause == "control-lost")
        await rig.stays_at_rest()
    await anna.close()
