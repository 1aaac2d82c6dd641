"""An arm that a person moves: from a program's posts to an installed calibration, beside a real daemon."""

from __future__ import annotations

import asyncio
import contextlib
import json
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibrate.files.install import installed_calibration
from recordings.geometry import interpolate, quaternion_from_matrix
from station.cell.config import CameraConfig, CaptureConfig, RobotConfig
from station.cell.errors import RefusedError
from station.cell.pose_plan import PlannedPose
from station.cell.status import StationState, StationStatus
from station.cli.daemon import own_daemon
from station.protocol.client import Client
from station.protocol.verbs import Finish, Freedrive, Record
from station.simulation.cells import cell_config, make_cell
from tests.station.quick_plan import quick_plan
from tests.system.conftest import installs_where_it_is_from, solved, status_when

pytestmark = pytest.mark.process
TRUTH = make_cell("paper-binned", seed=3)
POSES = 16
PERIOD_S = 0.02
WAY_S = 0.6


class Person:
    """Moves an arm from pose to pose; `station post` hands on where it is, fifty times a second."""

    def __init__(self, control: Path) -> None:
        self.place: PlannedPose | None = None
        """Where the arm is to be; it goes there in `WAY_S`."""
        self._program = subprocess.Popen(
            [sys.executable, "-m", "station.cli", "post", "--socket", str(control)], stdin=subprocess.PIPE
        )

    async def post(self) -> None:
        self._program.stdin.write(b'{"source": "simulated", "robot": "arm of a friend"}\n')
        last, left_s = self.place, time.monotonic()
        start = flange = np.eye(4)
        while True:
            if self.place is not None:
                goal = np.array(self.place.base_from_flange)
                if last is not self.place:
                    start = goal if last is None else flange
                    last, left_s = self.place, time.monotonic()
                gone = min(1.0, (time.monotonic() - left_s) / WAY_S)
                flange = interpolate(start, goal, gone)
                pose = [*flange[:3, 3], *quaternion_from_matrix(flange[:3, :3])]
                told = {"t": time.monotonic(), "base_from_flange": pose, "joints_rad": self.place.joints_rad}
                self._program.stdin.write(json.dumps(told).encode() + b"\n")
                self._program.stdin.flush()
            await asyncio.sleep(PERIOD_S)

    def end(self) -> None:
        self._program.kill()
        with contextlib.suppress(BrokenPipeError):
            self._program.communicate()


@asynccontextmanager
async def person(control: Path) -> AsyncIterator[Person]:
    moved = Person(control)
    posting = asyncio.create_task(moved.post())
    try:
        yield moved
    finally:
        posting.cancel()
        moved.end()


def still_at(place: PlannedPose, status: StationStatus) -> bool:
    state = status.robot.state
    away = None if state is None else np.subtract(state.tcp_pose[:3], np.array(place.base_from_flange)[:3, 3])
    return away is not None and float(np.abs(away).max()) < 1e-9 and status.robot.still


async def test_views_by_hand_become_an_installed_calibration_that_knows_the_arm(tmp_path: Path) -> None:
    config = cell_config(TRUTH)
    camera = CameraConfig(driver="webcam", model=config.camera.model, model_is_rough=True)
    plan = quick_plan(config, TRUTH, seed=3, count=POSES)
    written = msgspec.structs.replace(
        config,
        camera=camera,
        robot=RobotConfig(driver="posted", model="arm of a friend", serial="F1"),
        capture=CaptureConfig(free_space_bytes=1),
    )
    file, result = tmp_path / "station.yaml", tmp_path / "calibration.yaml"
    file.write_bytes(msgspec.yaml.encode(written))
    what = ["--config", str(file), "--rehearse", "--root", str(tmp_path)]
    with own_daemon(what, tmp_path / "daemon.log") as control:
        async with Client(control) as client, person(control) as hand:
            await status_when(client, lambda s: s.cause == "post-nobody")
            hand.place = plan.poses[0]
            status = await status_when(client, lambda s: s.state is StationState.IDLE)
            assert status.source == "simulated"
            assert status.robot.by_hand and status.robot.model == "arm of a friend"
            await client.call(Freedrive(on=True), timeout_s=60.0)
            for number, place in enumerate(plan.poses):
                hand.place = place
                if number < 2:  # the station takes a new view by itself
                    await status_when(client, lambda s, number=number: s.session.captured > number)
                    status = await status_when(client, lambda s: s.state is StationState.FREE_DRIVE)
                while status.session.captured <= number:
                    await status_when(client, lambda s, place=place: still_at(place, s))
                    with contextlib.suppress(RefusedError):  # it is being taken by itself
                        await client.call(Record(), timeout_s=60.0)
                    status = await status_when(client, lambda s: s.state is StationState.FREE_DRIVE)
            await client.call(Finish(), timeout_s=60.0)
            status = await status_when(client, lambda s: bool(s.session.recording))
    assert status.session.captured >= POSES
    root = tmp_path / "rehearsal"
    answer, _ = solved(status.session.recording, result, root / "simulation" / "truth.json")
    assert answer["verdict"] == "pass"
    assert len(answer["arm"]["table"]) > 30  # its links and flexing were learned from the joints
    installs_where_it_is_from(result, root, tmp_path / "real")
    assert installed_calibration(root).robot.model == "arm of a friend"
