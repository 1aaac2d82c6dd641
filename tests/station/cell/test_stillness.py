"""At rest is measured: by speed, by the flange's scatter and by the picture, never by waiting."""

from __future__ import annotations

import asyncio
import math

import msgspec
import pytest

from calibrate.arms.kinematics import MODELS, forward
from recordings.geometry import vector_from_pose
from recordings.schema.messages import RobotState, Stamps
from station.cell.config import StillnessConfig, vector6
from station.cell.errors import StaleStateError
from station.cell.stillness import NotStillError, StillnessMonitor
from tests.codes import raises
from tests.recordings.small_recording import PLAYING

HOME = (0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0)


def state(at_s: float, joint_rad: float = 0.0, speed_rad_s: float = 0.0) -> RobotState:
    """Joint 2 displaced and moving."""
    joints = (HOME[0], HOME[1] + joint_rad, *HOME[2:])
    return msgspec.structs.replace(
        PLAYING,
        stamps=Stamps(controller_s=at_s),
        joints_rad=joints,
        tcp_pose=vector6(vector_from_pose(forward(MODELS["UR10"], joints))),
        joint_speeds_rad_s=(0.0, speed_rad_s, 0.0, 0.0, 0.0, 0.0),
    )


def monitor(**limits: float) -> StillnessMonitor:
    return StillnessMonitor(StillnessConfig(**limits))


def shaken(amplitude_rad: float, seconds: float = 0.5, **limits: float) -> StillnessMonitor:
    """It has seen joint 2 shake eight times a second for so long."""
    found, rad_s = monitor(**limits), 2 * math.pi * 8.0
    for i in range(int(seconds * 125)):
        phase = rad_s * i * 0.008
        found.add(state(i * 0.008, amplitude_rad * math.sin(phase), amplitude_rad * rad_s * math.cos(phase)))
    return found


def test_a_resting_arm_is_still() -> None:
    m = shaken(0.0)
    found = m.measure()
    assert found is not None and m.unrest(found) == ""
    assert m.at_rest
    assert found.window_s == pytest.approx(0.3, abs=0.01)
    assert found.position_scatter_m < 1e-12 and found.max_joint_speed_rad_s == 0.0
    assert m.rest(msgspec.structs.replace(found, position_scatter_m=0.0, rotation_scatter_rad=0.0)) == 1.0


def test_a_shaking_arm_is_measured() -> None:
    m = shaken(0.001)
    found = m.measure()
    assert found.max_joint_speed_rad_s == pytest.approx(0.001 * 2 * math.pi * 8, rel=0.02)
    radius_m = math.hypot(0.5723 + 0.1157, 0.612)  # of the flange about the shoulder, roughly
    assert found.position_scatter_m == pytest.approx(0.001 * radius_m, rel=0.5)
    assert m.unrest(found).startswith("joint shoulder moves at 2.8") and "scatters by" in m.unrest(found)
    assert not m.at_rest
    m.add(state(1.0))
    assert not m.at_rest  # it rests now, but not for long enough


@pytest.mark.parametrize(
    ("joint", "moves"), [(1, "the flange scatters by"), (5, "the flange turns by 0.017")]
)
def test_a_slow_creep_is_no_rest_although_no_speed_is_reported(joint: int, moves: str) -> None:
    """The last joint turns the flange on the spot."""
    m = monitor()
    for i in range(60):
        joints = (*HOME[:joint], HOME[joint] + 0.001 * i * 0.008, *HOME[joint + 1 :])
        pose = vector6(vector_from_pose(forward(MODELS["UR10"], joints)))
        m.add(msgspec.structs.replace(state(i * 0.008), joints_rad=joints, tcp_pose=pose))
    found = m.measure()
    assert found is not None and m.unrest(found).startswith(moves)
    assert found.rotation_scatter_rad == pytest.approx(0.001 * found.window_s)
    assert not m.at_rest


@pytest.mark.parametrize(
    ("measured", "said"),
    [
        ({"position_scatter_m": 0.00025}, "the flange scatters by 0.250 mm (limit 0.050)"),
        ({"image_motion_px": 1.5}, "the image moves by 1.50 px (limit 0.30)"),
    ],
)
def test_flange_and_picture_have_a_say(measured: dict[str, float], said: str) -> None:
    m = shaken(0.0)
    found = m.measure()
    assert m.unrest(msgspec.structs.replace(found, **measured)) == said


def test_a_short_look_a_hole_in_the_stream_and_a_restart_of_the_controller_are_no_measurement() -> None:
    found = [shaken(0.0, seconds) for seconds in (0.0, 0.1, 0.25, 0.5, 0.33)]
    found[3].add(state(0.008))
    for i in range(56, 60):
        found[4].add(state(i * 0.008))
    assert [m.measure() for m in found] == [None] * 5


async def test_settling_returns_as_soon_as_the_arm_rests() -> None:
    m = shaken(0.01, timeout_s=5.0)
    polls = 0

    def alive() -> bool:
        nonlocal polls
        polls += 1
        for i in range(10):  # 80 ms of rest between two looks
            m.add(state(0.5 + polls * 0.08 + i * 0.008))
        return True

    settling = asyncio.ensure_future(m.settle(alive))
    await asyncio.sleep(0)
    assert not settling.done()  # heartbeat and STOP go on meanwhile
    assert (await settling).max_joint_speed_rad_s == 0.0
    assert 3 <= polls <= 7


@pytest.mark.parametrize(
    ("shaken_rad", "alive", "looked", "code"),
    [(0.01, True, math.nan, "not-settled"), (0.0, None, math.nan, "no-news"), (0.0, True, None, "no-images")],
)
async def test_an_arm_that_never_rests_is_given_up_with_the_reason(
    shaken_rad: float, alive: bool | None, looked: float | None, code: str
) -> None:
    """A camera that shows nothing is not called a shake."""
    m = shaken(shaken_rad, timeout_s=5.0)
    clock = iter([0.0, 1.0, 5.1])
    with raises(code, NotStillError, limit_s=5.0) as told:
        await m.settle(lambda: alive, lambda since_ns: looked, now_s=lambda: next(clock))
    if shaken_rad:
        assert "shoulder" in told.value.text
        assert float(told.value.values["max_joint_speed_rad_s"]) > 0.1


async def test_old_news_of_an_arm_at_rest_are_no_rest() -> None:
    m = shaken(0.0, timeout_s=5.0)
    news = iter([None, None, True])
    asked: list[bool | None] = []

    def alive() -> bool | None:
        asked.append(next(news))
        return asked[-1]

    await m.settle(alive)
    assert asked == [None, None, True]


async def test_a_lost_robot_ends_the_waiting() -> None:
    def dead() -> None:
        raise StaleStateError()

    with pytest.raises(StaleStateError):
        await monitor().settle(dead)
