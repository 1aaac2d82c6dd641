"""Numbers that are not finite, from the controller: no news, never a place where the arm stands."""

from __future__ import annotations

import math

import msgspec
import pytest

from station.cell.errors import StaleStateError
from station.cell.stillness import fastest_rad_s
from station.devices.ur import UrRobot
from station.devices.ur.moves import MoveWatch
from station.devices.ur.stream import Payload
from station.devices.ur.tool import check_payload
from station.session.motion import require_start
from tests.codes import raises
from tests.faults.conftest import MakeCell
from tests.patience import until
from tests.recordings.small_recording import PLAYING

pytestmark = pytest.mark.process

OUTPUTS = ["timestamp", "actual_q", "actual_qd", "target_q", "actual_TCP_pose", "speed_scaling"]


def told(robot: UrRobot) -> str:
    """Name what is wrong with the arm's news; empty: nothing."""
    try:
        robot.link.state()
    except StaleStateError as error:
        return error.code
    return ""


@pytest.mark.parametrize("output", OUTPUTS)
async def test_in_mid_move_they_stop_the_arm_and_are_named(cell: MakeCell, output: str) -> None:
    c = await cell()
    error = await c.strike({"cmd": "spoil", "outputs": [output]})
    assert error.code == "state-not-finite"
    assert told(c.robot) == "state-not-finite"
    await c.ask("spoil", outputs=[])
    await until(lambda: not told(c.robot))
    assert math.isfinite(fastest_rad_s(c.robot.link.state()))


async def test_at_rest_they_are_no_news_and_end_as_they_began(cell: MakeCell) -> None:
    c = await cell(control=False)
    before = c.robot.link.state().joints_rad
    seen: list[float] = []
    c.robot.link.subscribe(lambda state: seen.extend(state.joints_rad))
    await c.ask("spoil", outputs=["actual_q"])
    await until(lambda: told(c.robot) == "state-not-finite")
    await c.ask("spoil", outputs=[])
    await until(lambda: not told(c.robot))
    assert c.robot.link.state().joints_rad == pytest.approx(before)
    assert all(map(math.isfinite, seen))


async def test_an_arm_that_tells_nothing_finite_from_the_begin_is_not_connected(cell: MakeCell) -> None:
    c = await cell(control=False)
    await c.robot.link.close()
    await c.ask("spoil", outputs=["actual_TCP_pose"])
    with raises("state-not-finite"):
        await c.robot.link.connect()
    await c.ask("spoil", outputs=[])
    await c.robot.link.connect()


NAN_JOINTS = [(*(0.0,) * at, math.nan, *(0.0,) * (5 - at)) for at in range(6)]


@pytest.mark.parametrize("joints", NAN_JOINTS)
def test_what_guards_motion_fails_closed(joints: tuple[float, ...]) -> None:
    """Even where such a state had come so far."""
    zeros = (0.0,) * 6
    with raises("arm-moved"):
        require_start(joints, zeros, "since the approval was asked for")
    with raises("arm-moved"):
        require_start(zeros, joints, "since the approval was asked for")
    watch = MoveWatch(zeros, (0.5,) * 6, 0, begun_s=0.0)
    with raises("off-path"):
        watch.step(msgspec.structs.replace(PLAYING, joints_rad=joints), 0, 0.1)
    with raises("payload-changed"):
        check_payload(Payload(math.nan), Payload(0.0))
    assert fastest_rad_s(msgspec.structs.replace(PLAYING, joint_speeds_rad_s=joints)) == math.inf
