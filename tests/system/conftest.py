"""A daemon as a process, an operator as a client, and the arm as the controller itself reports it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import signal
import socket
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from calibrate.cli import main as calibrate
from calibrate.files.versions import installed_versions
from recordings.geometry import Array, difference
from station.cell.child import start_child
from station.cell.errors import RefusedError
from station.cell.pose_plan import Plan
from station.cell.status import StationState, StationStatus
from station.devices.news import Delay
from station.protocol.client import Client
from station.simulation.cells import cell_config, make_cell
from station.simulation.launch import AdminClient, SimulatedController
from station.simulation.truth import read_truth, write_truth
from tests.command_line import call
from tests.conftest import AT_REST_RAD_S, CONTROL_PATHS, rests_short_of_its_goal
from tests.patience import PATIENCE_S, until
from tests.station.quick_plan import quick_plan

TRUTH = make_cell("paper-binned", seed=5)
both_paths = pytest.mark.parametrize("rig", CONTROL_PATHS, indirect=True)
PROGRAM = (sys.executable, "-m", "tests.system.cell_daemon")


@pytest.fixture(scope="session")
def short_plan() -> Plan:
    """Three poses, driven slowly enough to be caught in mid-move."""
    plan = quick_plan(cell_config(TRUTH), TRUTH, seed=5, count=3)
    return msgspec.structs.replace(plan, joint_speed_rad_s=0.25)


class Notified:
    """A socket in systemd's place, with what it would hear."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "notify"
        self._link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._link.bind(str(self.path))
        self._link.setblocking(False)

    def heard(self) -> list[str]:
        lines: list[str] = []
        with contextlib.suppress(BlockingIOError):
            while True:
                lines += self._link.recv(4096).decode().splitlines()
        return lines

    def close(self) -> None:
        self._link.close()


class DaemonProcess:
    """One life of the daemon. The controller outlives it."""

    def __init__(
        self, controller: SimulatedController, folder: Path, root: Path, number: int, control: str = ""
    ) -> None:
        self.socket = folder / f"{number}.sock"
        self.notified = Notified(folder) if number == 1 else None
        command = ["env", *([f"CELL_CONTROL={control}"] if control else [])]
        if self.notified is not None:
            command.append(f"NOTIFY_SOCKET={self.notified.path}")
        command += [*PROGRAM, controller.host, str(folder / "truth.json"), str(root), str(self.socket)]
        self._child = start_child("daemon", command, PATIENCE_S, root / f"daemon-{number}.log")
        self.process = self._child.process

    async def client(self) -> Client:
        return await Client(self.socket).open()

    def end(self) -> None:
        self.process.send_signal(signal.SIGCONT)
        self._child.stop(PATIENCE_S)
        if self.notified is not None:
            self.notified.close()


class SystemRig:
    """A controller, the daemons that came and went before it, and a look at the arm."""

    def __init__(self, controller: SimulatedController, folder: Path, root: Path, control: str = "") -> None:
        self.controller, self.folder, self.root = controller, folder, root
        self.control = control
        """Control path that drives the arm; empty: the installed one."""
        self.admin: AdminClient = controller.admin()
        self.daemons: list[DaemonProcess] = []

    async def daemon(self) -> DaemonProcess:
        number = len(self.daemons) + 1
        where = self.controller, self.folder, self.root
        made = await asyncio.to_thread(DaemonProcess, *where, number, self.control)
        self.daemons.append(made)
        return made

    def speed_rad_s(self) -> float:
        return float(max(map(abs, self.admin.ask("state")["joint_speeds_rad_s"])))

    async def moving(self) -> None:
        await until(lambda: self.speed_rad_s() > 0.1)

    async def rests(self) -> None:
        await until(lambda: self.speed_rad_s() < AT_REST_RAD_S)

    async def stops(self) -> None:
        """Before it has arrived."""
        await self.rests()
        rests_short_of_its_goal(self.admin)

    async def stays_at_rest(self, seconds: float = 0.5) -> None:
        before = self.admin.ask("state")["joints_rad"]
        await asyncio.sleep(seconds)
        after = self.admin.ask("state")["joints_rad"]
        assert max(abs(a - b) for a, b in zip(before, after, strict=True)) < 1e-3

    def end(self) -> None:
        for daemon in self.daemons:
            daemon.end()
        self.admin.close()


async def status_when(client: Client, condition: Callable[[StationStatus], bool]) -> StationStatus:
    """The first status for which it holds. A stop by news that came late costs a person one key."""
    async with asyncio.timeout(PATIENCE_S):
        async for status in client.statuses():
            if condition(status):
                return status
            if status.state is StationState.FAULT and status.cause in set(Delay):
                await client.request("acknowledge")
                await go(client, None, "resume")
    raise AssertionError("the daemon ended first")


async def go(client: Client, plan: Plan | None, purpose: str = "run") -> None:
    """Take control, load the plan and approve its motion, like an operator; again where news came late."""
    rest = (StationState.IDLE, StationState.PAUSED)
    async with asyncio.timeout(PATIENCE_S):
        while True:
            await status_when(client, lambda s: s.state in rest and s.camera.connected)
            if plan is not None:
                await client.request("load_plan", plan=msgspec.to_builtins(plan))
            try:
                summary = await client.request("prepare", purpose=purpose)
                await client.request("go", token=summary["token"])
                return
            except RefusedError as refused:
                if refused.code not in set(Delay):
                    raise


def solved(recording: Path | str, result: Path, truth: Path, *options: object) -> tuple[Any, Array]:
    """The answer of `calibrate solve` with its error (6,), which is within what it claims."""
    answer = json.loads(call(calibrate, "solve", recording, "-o", result, *options, "--json").stdout)
    off = difference(np.array(answer["result"]["matrix"]), np.array(read_truth(truth).camera_mount))
    # 22.5: the 99.9 % quantile of chi-square with 6 degrees of freedom.
    assert off @ np.linalg.solve(np.array(answer["covariance"]), off) < 22.5
    return answer, off


def installs_where_it_is_from(result: Path, root: Path, real: Path) -> None:
    """In the simulated cell's folder, and not in the real one's."""
    assert call(calibrate, "install", result, "--root", real).returncode == 1 and not installed_versions(real)
    assert call(calibrate, "install", result, "--cell", "simulated", "--root", root).returncode == 0


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """Unix sockets have short names."""
    folder = Path(tempfile.mkdtemp(prefix="st-"))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def time_scale() -> float:
    """How many times faster the rig's arm moves than it says."""
    return 1.0


@pytest.fixture
async def rig(
    controller: Callable[..., SimulatedController],
    short_folder: Path,
    tmp_path: Path,
    time_scale: float,
    request: pytest.FixtureRequest,
) -> AsyncIterator[SystemRig]:
    """`@both_paths` runs a test with each way of driving the arm."""
    truth = short_folder / "truth.json"
    write_truth(TRUTH, truth)
    running = await asyncio.to_thread(controller, "UR10", truth=truth, time_scale=time_scale)
    made = SystemRig(running, short_folder, tmp_path, getattr(request, "param", ""))
    yield made
    await asyncio.to_thread(made.end)
