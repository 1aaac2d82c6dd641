"""The whole daemon before a camera that does not share Aravis with it, at a simulated controller."""

from __future__ import annotations

import asyncio
import getpass
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, asynccontextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from recordings.reader import open_recording
from station.cell.config import ApprovalConfig, StationConfig
from station.cell.pose_plan import Plan
from station.cell.status import MotionPreview, StationState, StationStatus
from station.cli.daemon import own_daemon
from station.operate.motion import prepared_motion, until_rest, wait_until_idle
from station.plan.planner import make_plan
from station.protocol.client import Client
from station.protocol.verbs import Check, Doctor, LoadPlan, Prepare, Stop
from station.simulation.camera_process import CameraProcess
from station.simulation.cells import cell_config, make_cell
from station.simulation.launch import SimulatedController, start_controller
from station.simulation.truth import write_truth
from tests.foreign.test_gige_vision import loss
from tests.gige_vision.camera import EmulatedCamera, Picture
from tests.system.conftest import SystemRig, status_when

pytestmark = [pytest.mark.gige, pytest.mark.process]
TRUTH = make_cell(seed=5)
GOOD_S = 40.0


@pytest.fixture
def arm(lonely_network: None, tmp_path: Path) -> Iterator[SimulatedController]:
    write_truth(TRUTH, tmp_path / "truth.json")
    with start_controller("UR10", truth=tmp_path / "truth.json", time_scale=3.0) as running:
        yield running


def configuration(arm: SimulatedController) -> StationConfig:
    """As of a real cell; how near busy cores read the emulator's clock is not the station's affair."""
    config = cell_config(TRUTH, arm.host)
    return msgspec.structs.replace(
        config,
        camera=msgspec.structs.replace(config.camera, driver="aravis", device="127.0.0.1"),
        robot=msgspec.structs.replace(config.robot, control="script"),
        capture=msgspec.structs.replace(config.capture, free_space_bytes=1, time_bound_s=1.0),
        approval=ApprovalConfig(services=(getpass.getuser(),)),
    )


@asynccontextmanager
async def served(config: StationConfig, folder: Path) -> AsyncIterator[Client]:
    """`station serve --config`, and a client that has control."""
    (folder / "station.yaml").write_bytes(msgspec.yaml.encode(config))
    arguments = ["--config", str(folder / "station.yaml"), "--root", str(folder)]
    with own_daemon(arguments, folder / "daemon.log") as socket:
        async with Client(socket) as client:
            await wait_until_idle(client)
            yield client


async def checked(client: Client) -> dict[str, Check]:
    return {check.name: check for check in await client.call(Doctor())}


async def good(client: Client, name: str) -> None:
    """Until doctor says so of it."""
    async with asyncio.timeout(GOOD_S):
        while (await checked(client))[name].state != "ok":
            await asyncio.sleep(0.2)


async def yes(preview: MotionPreview) -> bool:
    return True


async def captured(client: Client, plan: Plan) -> StationStatus:
    await client.call(LoadPlan(plan))
    assert await prepared_motion(client, Prepare(), yes)
    return await until_rest(client, lambda status: None)


def planned(config: StationConfig, poses: int) -> Plan:
    return make_plan(config, start_joints_rad=TRUTH.start_joints_rad, seed=5, count=poses)


@pytest.fixture
def seen(arm: SimulatedController) -> Iterator[Picture]:
    """What a camera on that arm sees now."""
    renders = CameraProcess(TRUTH, arm.host)
    renders.warm_up()

    def picture(number: int, width: int, height: int) -> NDArray[np.uint8]:
        return np.ascontiguousarray(renders.picture(time.monotonic_ns(), TRUTH.camera)[:height, :width])

    yield picture
    if renders._admin is not None:
        renders._admin.close()


async def test_a_session_with_the_emulated_camera(
    arm: SimulatedController, seen: Picture, tmp_path: Path
) -> None:
    config = configuration(arm)
    plan = planned(config, 3)
    with ExitStack() as power:
        camera = power.enter_context(EmulatedCamera(picture=seen))
        camera.mtu = 1500
        async with served(config, tmp_path) as client:
            await good(client, "camera")
            camera.mangle = loss(0.002)
            ended = await captured(client, plan)
            assert ended.session.captured == 3, ended.reason
            assert camera.resent > 0
            views = open_recording(Path(ended.session.recording)).views()
            assert all(view.time_bound_s is not None for view in views)
            power.close()
            assert (await checked(client))["camera"].state == "failed"
            power.enter_context(EmulatedCamera(picture=seen))
            await good(client, "camera")
            await client.call(LoadPlan(plan))
            assert await prepared_motion(client, Prepare(), yes)
            rig = SystemRig(arm, tmp_path, tmp_path)
            await rig.moving()
            await client.call(Stop())
            await rig.stops()
            rig.end()
            stopped = await status_when(client, lambda status: status.state is StationState.STOPPED)
            assert stopped.camera.connected
