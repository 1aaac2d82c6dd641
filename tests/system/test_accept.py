"""The acceptance test with the real driver and daemon: its stops, its judge, what it keeps and refuses."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from station.cell.arm_acceptance import Acceptance, StopWay, read_acceptance
from station.cell.errors import RefusedError
from station.cell.status import StationState as S
from station.devices.ur import TraceRecorder
from station.protocol.client import Client
from station.protocol.verbs import Stop
from station.simulation.launch import SimulatedController
from station.simulation.truth import write_truth
from tests.codes import raises
from tests.station.cli.test_accept import Hands
from tests.system.conftest import AT_REST_RAD_S, TRUTH, SystemRig, both_paths, status_when

pytestmark = pytest.mark.process
SLOW_M_S = 0.05


async def begun(rig: SystemRig, *ways: StopWay) -> tuple[Client, Hands]:
    daemon = await rig.daemon()
    client = await daemon.client()
    await status_when(client, lambda s: s.state is S.IDLE)
    return client, Hands(client, TraceRecorder(rig.controller.host), SLOW_M_S, ways)


async def test_a_sound_arm_passes_and_every_move_was_approved_by_itself(rig: SystemRig) -> None:
    ways = (StopWay.CONTROL, StopWay.FROZEN)
    client, test = await begun(rig, *ways)
    found: Acceptance = await test.run()
    await client.close()
    assert [result.way for result in test.results] == list(ways)
    assert all(result.passed for result in test.results), test.results
    assert len({preview.token for preview in test.approved}) == len(test.approved) >= len(ways)
    assert all(preview.top_speed_m_s <= SLOW_M_S for preview in test.approved)
    assert not found.accepted, "some ways only were tested"
    assert found.speed_m_s == 0 and found.subject.source == "simulated"


async def test_a_stop_that_is_ignored_ends_the_test_and_the_arm_is_stopped_all_the_same(
    controller: Callable[..., SimulatedController], short_folder: Path, tmp_path: Path
) -> None:
    write_truth(TRUTH, short_folder / "truth.json")
    deaf = controller(
        "UR10",
        truth=short_folder / "truth.json",
        module="tests.weak_controller",
        options=("--weakness", "first-stop-ignored"),
    )
    rig = SystemRig(deaf, short_folder, tmp_path)
    try:
        client, test = await begun(rig, StopWay.CONTROL, StopWay.DASHBOARD)
        found = await test.run()
        await client.close()
        assert [result.way for result in test.results] == [StopWay.CONTROL]
        # On a busy computer the watchdog may end it as soon as an obeyed stop would.
        assert "reaction" in {f.name for f in test.results[0].failed}
        assert not found.accepted and found.speed_m_s == 0
        assert rig.speed_rad_s() < AT_REST_RAD_S, "the other way stopped it"
    finally:
        rig.end()


async def test_nothing_moves_without_emergency_stop_full_slider_and_acknowledged_stop(rig: SystemRig) -> None:
    client, test = await begun(rig, StopWay.CONTROL)
    test.holds = False
    with raises("no-emergency-stop", RefusedError):
        await test.run()
    test.holds = True
    rig.admin.ask("slider", fraction=0.5)
    await status_when(client, lambda s: s.robot.state and s.robot.state.target_speed_fraction < 0.6)
    with raises("slider-low", RefusedError):
        await test.run()
    rig.admin.ask("slider", fraction=1.0)
    await status_when(client, lambda s: s.robot.state and s.robot.state.target_speed_fraction > 0.99)
    await client.call(Stop())
    with raises("wrong-state", RefusedError):
        await test.run()
    assert not test.approved
    await client.close()


@pytest.mark.soak
@both_paths
async def test_the_command_accepts_a_sound_arm_and_keeps_it(rig: SystemRig) -> None:
    daemon = await rig.daemon()
    command = [sys.executable, "-m", "station.cli", "accept", "--socket", str(daemon.socket), "--json"]
    done = await asyncio.to_thread(subprocess.run, [*command, "--speed", "0.1"], capture_output=True)
    assert done.returncode == 0, done.stderr
    told, kept = msgspec.json.decode(done.stdout, type=Acceptance), read_acceptance(rig.root)
    assert kept == told and told.accepted and told.speed_m_s == 0.1
    assert [result.way for result in told.results] == list(StopWay)
