"""A recorded session, replayed through the socket for poses: the same stops give the same calibration."""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path

import msgspec
import numpy as np

import recordings
from calibrate.cli import main as calibrate
from calibrate.geometry import quaternion_from_matrix
from recordings.reader import open_recording
from recordings.schema.messages import Image
from station.cell.config import RobotConfig, StationConfig
from station.cell.status import StationState
from station.devices.cell import Cell
from station.devices.posted import PostedArm
from station.session import Session
from tests.command_line import call
from tests.patience import until
from tests.station.devices.test_posted import Poster, now
from tests.station.session_rig import CameraInMemory, WorkerInThisProcess, memory_config

SAMPLE = Path(recordings.__file__).parent / "samples" / "paper-640.mcap"


class RecordedCamera(CameraInMemory):
    """The recorded image of the stop at hand; none for the stillness of images."""

    stop: Image

    async def capture(self, timeout_s: float = 5.0) -> Image:
        now = await super().capture(timeout_s)
        return msgspec.structs.replace(self.stop, stamps=now.stamps, time=now.time)


async def test_the_same_stops_give_the_same_calibration(tmp_path: Path) -> None:
    recorded = open_recording(SAMPLE)
    info, views = recorded.info, recorded.views()
    config: StationConfig = msgspec.structs.replace(
        memory_config(),
        robot=RobotConfig(driver="posted", model=info.robot.model, serial="posted"),
        board=info.board,
        mount=info.mount,
        camera=msgspec.structs.replace(memory_config().camera, model=info.camera),
    )
    arm, camera = PostedArm(config, "playback", tmp_path / "control.sock"), RecordedCamera()
    session = Session(Cell(config, arm, camera, "playback"), tmp_path / "root")
    camera.blind, session.context.workers = True, WorkerInThisProcess()  # type: ignore[assignment]
    session.freedrive.run = asyncio.Event().wait  # type: ignore[method-assign,assignment]
    store = session.store
    await session.start()
    await until(lambda: arm.path.exists())
    poster = await Poster.at(arm, {"source": "playback"})
    stop = views[0]

    async def stand() -> None:
        while True:
            flange = np.array(stop.base_from_flange)
            pose = [*flange[:3, 3], *quaternion_from_matrix(flange[:3, :3])]
            t = time.monotonic() - begun_s
            poster.say({"base_from_flange": pose, "joints_rad": stop.joints_rad, "t": t})
            await asyncio.sleep(0.01)

    begun_s, standing = time.monotonic(), asyncio.create_task(stand())
    await until(lambda: store.state is StationState.IDLE)
    session.take_lease(1, "anna")
    await session.switch_free_drive(1, True)
    for stop in views:
        begun_s, camera.stop = time.monotonic(), recorded.image(stop)  # a clock of its own for each stop
        place = np.array(stop.base_from_flange)[:3, 3]
        taken = False
        while not taken:  # on a busy computer the posts have gaps, and an image is taken once more
            await until(
                lambda place=place: (
                    now(arm, lambda s: np.allclose(s.tcp_pose[:3], place, atol=1e-9))  # type: ignore[misc]
                    and session.context.stillness.at_rest
                    and arm.clock() is not None
                )
            )
            index = await session.record(1)
            taken = index in session.context.seen
    await session.finish(1)
    standing.cancel()
    path = store.status.session.recording
    await session.close()
    poster.writer.transport.abort()
    again = open_recording(Path(path))
    assert again.info.source == "playback" and len(again.views()) == len(views)
    replayed, original = (solved(recording, tmp_path) for recording in (Path(path), SAMPLE))
    assert np.abs(replayed - original).max() < 1e-9


def solved(recording: Path, folder: Path) -> np.ndarray:
    answer = call(calibrate, "solve", recording, "-o", folder / "X.yaml", "--json").stdout
    return np.array(json.loads(answer)["result"]["matrix"])
