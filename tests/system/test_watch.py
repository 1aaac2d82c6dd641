"""`station watch` on the real daemon: a camera that is knocked while another program moves the arm."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from calibrate.boards.model import board_points
from calibrate.files.calibration import write_calibration
from calibrate.files.install import install
from calibrate.files.loader import load_installed
from calibrate.files.validity import ValidityState
from calibrate.geometry import inverse
from calibrate.projection import project_at
from recordings.schema.messages import CameraIdentity, RobotIdentity
from station.cell.status import StationState as S
from station.daemon import Daemon
from station.devices.cell import Cell
from station.devices.ur import UrRobot
from station.protocol.client import Client
from station.protocol.verbs import Observe
from station.simulation.camera import RenderedCamera
from station.simulation.cells import cell_config
from tests.conftest import asked
from tests.station.calibrated_cell import calibration_of
from tests.system.conftest import TRUTH, SystemRig, status_when

pytestmark = pytest.mark.process


async def test_the_corners_belong_to_the_pose_that_is_told_with_them(rig: SystemRig) -> None:
    daemon = await rig.daemon()
    async with await daemon.client() as client:
        await status_when(client, lambda s: s.state is S.IDLE and s.camera.connected)
        await status_when(client, lambda s: s.robot.still)
        seen = await client.call(Observe(TRUTH.board))
        mount, place = np.array(TRUTH.camera_mount), np.array(TRUTH.board_place)
        camera_from_board = inverse(np.array(seen.base_from_flange) @ mount) @ place
        expected = project_at(TRUTH.camera, camera_from_board, board_points(TRUTH.board)[list(seen.corners)])
        assert len(seen.corners) == len(board_points(TRUTH.board))
        assert np.abs(np.array(seen.pixels) - expected).max() < 1.0  # the arm misses by 0.05 mm
    assert asked(rig.admin, "upload") == asked(rig.admin, "move") == 0


async def watch(socket: Path, pictures: int) -> tuple[int, list[dict[str, object]]]:
    command = [sys.executable, "-m", "station.cli", "watch", "--socket", str(socket), "--json"]
    command += ["--every", "0.2", "--images", str(pictures)]
    done = await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)
    assert done.stdout is not None
    lines = [json.loads(line) async for line in done.stdout]
    return await done.wait(), lines


@pytest.mark.soak
@pytest.mark.timeout(900)
async def test_a_camera_knocked_by_3_mm_between_jobs_is_noticed(rig: SystemRig, tmp_path: Path) -> None:
    root, socket = tmp_path / "root", rig.folder / "s"
    write_calibration(calibration_of(TRUTH, RobotIdentity("UR10"), CameraIdentity()), tmp_path / "c.yaml")
    install(tmp_path / "c.yaml", root, cell="simulated")
    config = cell_config(TRUTH, rig.controller.host)
    camera = RenderedCamera(TRUTH, rig.controller.host, config.camera)
    daemon = Daemon(Cell(config, UrRobot(config.robot, root), camera, "simulated"), root, socket)
    ready = asyncio.Event()
    served = asyncio.create_task(daemon.run(ready.set))
    await ready.wait()
    async with Client(socket) as client:
        await status_when(client, lambda s: s.state is S.IDLE and s.camera.connected)
    produced = asyncio.create_task(produce(rig))
    code, lines = await watch(socket, 90)
    assert code == 0 and [line["event"] for line in lines] == ["learned", "testing", "summary"]
    await camera.inject("knock", [0.003, 0.0, 0.0])
    code, lines = await watch(socket, 60)
    print(*lines, sep="\n")
    produced.cancel()
    daemon.end()
    await served
    assert code == 4 and [line["event"] for line in lines] == ["alarm", "named", "summary"]
    assert (
        load_installed(root, allow_simulated=True, require_valid=False).validity.state
        is ValidityState.IN_DOUBT
    )
    assert asked(rig.admin, "upload") == asked(rig.admin, "move") == 0
    assert not list(root.rglob("*.mcap*"))


async def produce(rig: SystemRig) -> None:
    """Somebody else's program: from posture to posture, resting at each."""
    rng = np.random.default_rng(3)
    postures = np.array(TRUTH.start_joints_rad) + rng.normal(size=(6, 6)) * 0.06
    while True:
        for joints in postures:
            await asyncio.to_thread(rig.admin.ask, "hand_move", path=[joints.tolist()], speed_rad_s=0.5)
            await asyncio.sleep(1.0)
