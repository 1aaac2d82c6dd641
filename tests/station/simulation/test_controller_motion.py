"""How the simulated arm moves: its profile, and that every stop misses a little."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from calibrate.arms.kinematics import MODELS, forward
from recordings.geometry import difference
from station.simulation.controller.arm import SimulatedArm, Trapezoid
from station.simulation.controller.kinematics import TABLES, Vector

UR10 = TABLES["UR10"]
HOME = (0.0, -1.5, 1.5, -1.5, -1.5, 0.0)
DT = 0.008

positive = st.floats(0.01, 10.0)


def misses_until_rest(arm: SimulatedArm) -> list[float]:
    seen = [arm.miss[0]]
    while arm.moving:
        arm.step(DT, 1.0)
        seen.append(arm.miss[0])
    return seen


@given(length=positive, speed=positive, acceleration=positive, share=st.floats(0, 1))
def test_a_trapezoid_keeps_its_limits_and_arrives(
    length: float, speed: float, acceleration: float, share: float
) -> None:
    profile = Trapezoid(length, speed, acceleration)
    total = profile.duration_s
    s, v = profile.at(share * total)
    assert -1e-9 <= s <= length * (1 + 1e-9) and -1e-9 <= v <= speed * (1 + 1e-9)
    assert profile.at(total) == (length, 0.0)
    step = total * 1e-4
    later, v_later = profile.at(share * total + step)
    assert later >= s - 1e-9
    assert abs(v_later - v) <= acceleration * step * (1 + 1e-6) + 1e-9


def test_every_stop_misses_differently_and_never_jumps() -> None:
    draws = iter(float(i) for i in range(1, 100))

    def draw() -> Vector:
        return (next(draws), *(0.0,) * 5)

    arm = SimulatedArm(UR10, HOME, draw)
    assert arm.miss[0] == 1.0
    arm.start((0.5, *HOME[1:]), 1.0, 2.0)
    seen = misses_until_rest(arm)
    assert seen[-1] == 2.0 and max(b - a for a, b in pairwise(seen)) < 0.05
    arm.start((2.5, *HOME[1:]), 1.0, 2.0)
    for _ in range(62):
        arm.step(DT, 1.0)
    arm.brake(2.0)
    seen = misses_until_rest(arm)
    assert all(0 <= b - a < 0.05 for a, b in pairwise(seen))
    assert arm.miss[0] == 3.0  # a stop on the way is a stop: fully drawn anew


def test_pose_and_speed_of_the_tool_are_those_of_the_joints(started) -> None:
    made = started("  movej([0.5, -1.2, 1.0, -1.5, -1.0, 0.4], a=1.0, v=1.0)", model="UR10e")
    made.run_until(lambda: made.speed_rad_s > 0.4)
    told = made.robot.outputs.vector
    for side in ("actual", "target"):
        q, qd = np.array(told(f"{side}_q")), np.array(told(f"{side}_qd"))
        later, now = (forward(MODELS["UR10e"], q + dt_s * qd) for dt_s in (1e-6, 0.0))
        np.testing.assert_allclose(told(f"{side}_TCP_pose")[:3], now[:3, 3], atol=1e-9)
        np.testing.assert_allclose(told(f"{side}_TCP_speed"), difference(later, now) / 1e-6, atol=2e-3)
    made.end()
    made.run(1.0)
    assert told("actual_TCP_speed") == (0.0,) * 6
