"""The whole job as an operator does it: a real terminal, the real daemon, a simulated controller."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator

import msgspec
import pytest

from calibrate.files.install import installed_calibration
from recordings.reader import open_recording
from station.simulation.cells import cell_config
from tests.patience import until
from tests.station.quick_plan import quick_plan
from tests.system.conftest import TRUTH, SystemRig
from tests.tui.terminal import ScreenProcess

pytestmark = [pytest.mark.process, pytest.mark.timeout(600)]
POSES = 11
ENOUGH = 9
"""Views that the gates ask for, and one more."""


@pytest.fixture
def time_scale() -> float:
    return 3.0


@pytest.fixture
async def screen(rig: SystemRig) -> AsyncIterator[ScreenProcess]:
    daemon = await rig.daemon()
    made = ScreenProcess(daemon.socket)
    yield made
    await asyncio.to_thread(made.end)


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


async def test_run_stop_resume_finish_solve_install(rig: SystemRig, screen: ScreenProcess) -> None:
    plan = quick_plan(cell_config(TRUTH), TRUTH, seed=5, count=POSES)
    async with await rig.daemons[-1].client() as client:
        await client.request("load_plan", plan=msgspec.to_builtins(plan))
    await shows(screen, "● IDLE +SIMULATED")
    await go(screen)
    await captured_at_least(screen, 2)

    await rig.moving()
    screen.press("f12")
    await rig.rests()
    await shows(screen, "■ STOPPED")
    await rig.stays_at_rest()
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

    installed = installed_calibration(rig.root)
    assert installed.source == "simulated"
    recording = open_recording(next((rig.root / "sessions").glob("*/")))
    assert len(recording.views()) >= ENOUGH
