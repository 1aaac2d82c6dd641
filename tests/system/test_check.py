"""`station check` with the real daemon."""

from __future__ import annotations

import asyncio
import sys

import pytest

from station.cell.status import StationState as S
from tests.conftest import asked
from tests.system.conftest import SystemRig, status_when

pytestmark = pytest.mark.process


async def test_nothing_moves_where_no_calibration_is_installed(rig: SystemRig) -> None:
    daemon = await rig.daemon()
    async with await daemon.client() as client:
        await status_when(client, lambda s: s.state is S.IDLE and s.camera.connected)
    command = [sys.executable, "-m", "station.cli", "check", "--headless", "--socket", str(daemon.socket)]
    check = await asyncio.create_subprocess_exec(*command, stderr=asyncio.subprocess.PIPE)
    await asyncio.wait_for(check.communicate(), 60)
    assert check.returncode == 1
    assert asked(rig.admin, "upload") == 0
