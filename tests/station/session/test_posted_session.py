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
from station.cell.status import FEWEST_BY_HAND, StationState
from station.devices.cell import Cell
from station.devices.posted import PostedArm
from station.session import Session
from tests.command_line import call
from tests.patience import until
from tests.station.devices.test_posted import Poster
from tests.station.session_rig import CameraInMemory, memory_config

SAMPLE = Path(recordings.__file__).parent / "samples" / "paper-640.mcap"


class RecordedCamera(CameraInMemory):
    """The recorded image of the stop at hand."""

    stop: Image

    async def capture(self, timeout_s: float = 5.0) -> Image:
        now = await super().capture(timeout_s)
        return msgspec.structs.replace(self.stop, stamps=now.stamps, time=now.time)

    async def glimpse(self) -> Image:
        self.glimpses += 1
        return self.stop


async def test_what_the_station_takes_by_itself_gives_the_calibration_of_the_same_stops(
    tmp_path: Path,
) -> None:
    """Each stop is held until it is taken, or seen to be too much like others."""
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
    camera.stop = recorded.image(views[0])
    store, seen, freedrive = session.store, session.context.seen, session.freedrive
    await session.start()
    await until(lambda: arm.path.exists())
    poster = await Poster.at(arm, {"source": "playback"})
    stop = views[0]

    async def stand() -> None:
        t = 0.0
        while True:
            flange = np.array(stop.base_from_flange)
            pose = [*flange[:3, 3], *quaternion_from_matrix(flange[:3, :3])]
            now = time.monotonic() - begun_s
            t = max(t, now - 0.5) if t <= now else 0.0
            while t < now:  # every 10 ms by its own clock, however late this loop is
                t += 0.01
                poster.say({"base_from_flange": pose, "joints_rad": stop.joints_rad, "t": t})
            await asyncio.sleep(0.01)

    def rests_without_a_view() -> bool:
        assert freedrive.guide is not None
        return store.status.guidance.still == 1.0 and not freedrive.guide.take

    begun_s, standing = time.monotonic(), asyncio.create_task(stand())
    await until(lambda: store.state is StationState.IDLE)
    session.take_lease(1, "anna")
    await session.switch_free_drive(1, True)
    for stop in views[: FEWEST_BY_HAND + 4]:
        begun_s, camera.stop = time.monotonic(), recorded.image(stop)  # a clock of its own for each stop
        looks, taken = camera.glimpses, len(seen)
        await until(
            lambda looks=looks, taken=taken: (
                store.state is StationState.FREE_DRIVE
                and (len(seen) > taken or (camera.glimpses > looks + 3 and rests_without_a_view()))
            )
        )
    await session.finish(1)
    standing.cancel()
    path = store.status.session.recording
    await session.close()
    poster.writer.transport.abort()
    again = open_recording(Path(path))
    kept = [np.array(view.base_from_flange) for view in again.views()]
    assert again.info.source == "playback" and len(kept) >= FEWEST_BY_HAND
    left = [
        str(view.index + 1)
        for view in views
        if min(np.abs(flange - view.base_from_flange).max() for flange in kept) > 1e-9
    ]
    assert len(kept) + len(left) == len(views)
    replayed = solved(tmp_path, Path(path))
    original = solved(tmp_path, SAMPLE, "--without", ",".join(left))
    assert np.abs(replayed - original).max() < 1e-9


def solved(folder: Path, *words: object) -> np.ndarray:
    answer = call(calibrate, "solve", *words, "-o", folder / "X.yaml", "--json").stdout
    return np.array(json.loads(answer)["result"]["matrix"])
