"""Where the arm was when a picture was taken: between two samples, and at the ends of what is kept."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from recordings.schema.messages import RobotState, Stamps
from station.cell.clock_fit import ClockFit
from station.devices.history import state_at
from tests.codes import raises
from tests.recordings.small_recording import PLAYING

HOST_S, WALL_S = 500.0, 9_000.0
"""What the host's two clocks showed when the controller's showed 0."""
CLOCK = ClockFit(10.0, HOST_S * 1e9, 0.0)
AXIS = np.array([0.6, 0.0, 0.8])


def sample(at_s: float) -> RobotState:
    """Joint 1 turns by 0.5 rad/s; the tool goes along y by 0.1 m/s and turns about AXIS by 0.2 rad/s."""
    turn = (0.2 * at_s * AXIS).tolist()
    return msgspec.structs.replace(
        PLAYING,
        stamps=Stamps(round((at_s + HOST_S) * 1e9), round((at_s + WALL_S) * 1e9), at_s),
        joints_rad=(0.5 * at_s, 1.0, 0.0, 0.0, 0.0, 0.0),
        joint_speeds_rad_s=(0.5 * at_s, 0.0, 0.0, 0.0, 0.0, 0.0),
        target_joints_rad=(0.5 * at_s + 0.01, 1.0, 0.0, 0.0, 0.0, 0.0),
        tcp_pose=(0.3, 0.1 * at_s, 0.2, *turn),
        runtime_state=round(at_s * 100),
    )


HISTORY = [sample(10.0 + 0.008 * k) for k in range(5)]


def host_ns(controller_s: float) -> int:
    return round((controller_s + HOST_S) * 1e9)


@pytest.mark.parametrize("at_s", [10.0, 10.001, 10.0065, 10.008, 10.02, 10.032])
def test_everything_that_moves_is_interpolated_to_the_asked_moment(at_s: float) -> None:
    found = state_at(HISTORY, CLOCK, host_ns(at_s))
    assert found.stamps.controller_s == pytest.approx(at_s)
    assert found.stamps.host_monotonic_ns == host_ns(at_s)
    assert found.stamps.host_wall_ns == pytest.approx((at_s + WALL_S) * 1e9, abs=1e3)
    assert found.joints_rad == pytest.approx((0.5 * at_s, 1.0, 0.0, 0.0, 0.0, 0.0), abs=1e-8)
    assert found.joint_speeds_rad_s[0] == pytest.approx(0.5 * at_s, abs=1e-8)
    assert found.target_joints_rad[0] == pytest.approx(0.5 * at_s + 0.01, abs=1e-8)
    assert found.tcp_pose[:3] == pytest.approx((0.3, 0.1 * at_s, 0.2), abs=1e-8)
    assert found.tcp_pose[3:] == pytest.approx(0.2 * at_s * AXIS, abs=1e-8)


def test_modes_are_those_of_the_sample_before() -> None:
    assert state_at(HISTORY, CLOCK, host_ns(10.0079)).runtime_state == HISTORY[0].runtime_state


def test_an_arm_at_rest_keeps_its_pose_to_the_bit() -> None:
    rest = [msgspec.structs.replace(s, tcp_pose=HISTORY[0].tcp_pose) for s in HISTORY]
    assert state_at(rest, CLOCK, host_ns(10.013)).tcp_pose == HISTORY[0].tcp_pose


def test_what_lies_outside_of_the_samples_is_not_guessed() -> None:
    with raises("not-yet"):
        state_at(HISTORY, CLOCK, host_ns(10.042))
    with raises("no-history"):
        state_at(HISTORY, CLOCK, host_ns(9.99))
    with raises("no-history"):
        state_at(HISTORY, None, host_ns(10.0))
    with raises("no-history"):
        state_at(HISTORY[:1], CLOCK, host_ns(10.0))
