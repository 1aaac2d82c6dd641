"""The whole job as an operator does it: a real terminal, the real daemon, a simulated controller."""

from __future__ import annotations

import asyncio
import re
import signal
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import msgspec
import pytest

from calibrate.files.install import installed_calibration
from recordings.reader import open_recording
from station.cell.pose_plan import Plan
from station.simulation.cells import cell_config
from station.simulation.launch import SimulatedController
from station.simulation.truth import write_truth
from tests.patience import until
from tests.station.quick_plan import quick_plan
from tests.system.conftest import TRUTH, SystemRig, short_folder, short_plan
from tests.tui.terminal import ScreenProcess

__all__ = ["short_folder", "short_plan"]

pytestmark = [pytest.mark.process, pytest.mark.timeout(600)]
POSES = 11
ENOUGH = 9
"""Views that the gates ask for, and one more."""


class Desk:
    """The operator's place: a rig, and screens on whichever daemon serves now."""

    def __init__(self, rig: SystemRig) -> None:
        self.rig = rig
        self.socket = rig.folder / "screen.sock"
        self._screens: list[ScreenProcess] = []

    async def serve(self) -> None:
        daemon = await self.rig.daemon()
        self.socket.unlink(missing_ok=True)
        self.socket.symlink_to(daemon.socket)

    async def load(self, plan: Plan) -> None:
        client = await self.rig.daemons[-1].client()
        await client.request("load_plan", plan=msgspec.to_builtins(plan))
        await client.close()

    def screen(self) -> ScreenProcess:
        self._screens.append(ScreenProcess(self.socket))
        return self._screens[-1]

    def end(self) -> None:
        for screen in self._screens:
            screen.end()
        self.rig.end()


MakeDesk = Callable[[float], Awaitable[Desk]]


@pytest.fixture
async def desk_with(
    controller: Callable[..., SimulatedController], short_folder: Path, tmp_path: Path
) -> AsyncIterator[MakeDesk]:
    desks: list[Desk] = []

    async def make(time_scale: float) -> Desk:
        truth = short_folder / "truth.json"
        write_truth(TRUTH, truth)
        arm = await asyncio.to_thread(controller, "UR10", truth=truth, time_scale=time_scale)
        desks.append(Desk(SystemRig(arm, short_folder, tmp_path)))
        await desks[-1].serve()
        return desks[-1]

    yield make
    for desk in desks:
        await asyncio.to_thread(desk.end)


async def shows(screen: ScreenProcess, pattern: str) -> str:
    return await asyncio.to_thread(screen.wait_for, pattern)


async def go(screen: ScreenProcess) -> None:
    """F5, read what will move, yes."""
    await asyncio.to_thread(screen.press, "f5")
    await shows(screen, "The arm will move")
    await asyncio.to_thread(screen.press, "tab", "enter")
    # Until the screen has heard of it: a second F5 would be refused.
    await until(lambda: not re.search("‖ PAUSED|● IDLE", screen.glass.text))


def captured(text: str) -> int:
    found = re.search(r"Capture (\d+)/\d+", text)
    return int(found.group(1)) if found else 0


async def captured_at_least(screen: ScreenProcess, count: int) -> None:
    """On a busy machine poses may fail and the session pause: a person would give a new go."""
    async with asyncio.timeout(250):
        while captured(screen.glass.text) < count:
            if "‖ PAUSED" in screen.glass.text:
                await go(screen)
            await asyncio.sleep(0.05)


async def test_run_stop_resume_finish_solve_install(desk_with: MakeDesk) -> None:
    desk = await desk_with(3.0)
    await desk.load(quick_plan(cell_config(TRUTH), TRUTH, seed=5, count=POSES))
    screen = desk.screen()
    await shows(screen, "● IDLE +SIMULATED")
    await go(screen)
    await captured_at_least(screen, 2)

    await desk.rig.moving()
    screen.press("f12")
    await desk.rig.rests()
    await shows(screen, "■ STOPPED")
    await desk.rig.stays_at_rest()
    screen.press("f5")
    await shows(screen, "STOP is latched")

    screen.press("f8")
    await shows(screen, "‖ PAUSED")
    before = captured(screen.glass.text)
    await go(screen)
    await captured_at_least(screen, max(ENOUGH, before + 1))

    screen.press("f7")
    await shows(screen, "Finish this session")
    screen.press("tab", "enter")
    await shows(screen, "● IDLE")
    screen.press("f9")
    await shows(screen, "ready to install")
    screen.press("i")
    await shows(screen, "Install this calibration")
    screen.press("tab", "enter")
    await shows(screen, "Installed. b undoes it")

    installed = installed_calibration(desk.rig.root)
    assert installed.source == "simulated"
    recording = open_recording(next((desk.rig.root / "sessions").glob("*/")))
    assert len(recording.views()) >= ENOUGH


async def test_a_lost_screen_a_hung_and_a_killed_daemon_leave_the_session_whole(
    desk_with: MakeDesk, short_plan: Plan
) -> None:
    desk = await desk_with(1.0)
    await desk.load(short_plan)
    screen = desk.screen()
    await shows(screen, "● IDLE +SIMULATED")
    await go(screen)
    await captured_at_least(screen, 1)
    await desk.rig.moving()

    screen.process.kill()
    await desk.rig.stops()
    await desk.rig.stays_at_rest()
    second = desk.screen()
    await shows(second, "‖ PAUSED")
    await shows(second, "connection of(?s:.*)was lost")
    await shows(second, r"\d✓")
    assert captured(second.glass.text) >= 1

    await go(second)
    await desk.rig.moving()
    desk.rig.daemons[-1].process.send_signal(signal.SIGSTOP)
    await desk.rig.stops()
    await shows(second, "NO ANSWER for(?s:.*)EMERGENCY STOP")
    second.press("f12")
    await shows(second, "STOP was sent, but")
    desk.rig.daemons[-1].process.send_signal(signal.SIGCONT)
    await shows(second, "■ STOPPED|■ FAULT")
    await desk.rig.stays_at_rest()
    second.press("f8")
    await shows(second, "‖ PAUSED")

    await go(second)
    await desk.rig.moving()
    kept = captured(second.glass.text)
    desk.rig.daemons[-1].process.kill()
    await desk.rig.stops()
    await shows(second, "NO DAEMON")
    second.press("f12")
    await shows(second, "STOP reached nobody")
    await desk.serve()
    await shows(second, "■ STOPPED")
    await shows(second, "daemon ended")
    assert captured(second.glass.text) >= kept
    second.press("f8")
    await shows(second, "‖ PAUSED")
