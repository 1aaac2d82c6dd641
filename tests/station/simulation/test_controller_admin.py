"""The admin port: where the arm truly was, hands on the arm, clocks that drift."""

from __future__ import annotations

import time

import numpy as np
import pytest

from tests.codes import raises

pytestmark = pytest.mark.process
HOME = [0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0]


def test_truth_is_where_the_arm_was_at_that_host_time(controller, rtde, admin) -> None:
    running = controller("UR10e")
    ask = admin(running)
    client = rtde(running)
    client.start("timestamp", "actual_q")
    ask.ask("hand_move", joints=[1.0, *HOME[1:]], speed_rad_s=1.0)
    samples = [client.sample() for _ in range(500)]
    zero_ns = ask.ask("state")["controller_zero_monotonic_ns"]
    moving = [s for s in samples if 0.1 < s["actual_q"][0] < 0.9]
    assert len(moving) > 100
    for sample in moving[::20]:
        at_ns = zero_ns + round(sample["timestamp"] * 1e9)
        truth = ask.ask("truth", at_monotonic_ns=at_ns)
        assert truth["joints_rad"] == pytest.approx(sample["actual_q"], abs=1e-9)
        between = ask.ask("truth", at_monotonic_ns=at_ns + 1_000_000)
        assert between["joints_rad"][0] > sample["actual_q"][0]
    base_from_flange = np.array(truth["base_from_flange"])
    assert base_from_flange.shape == (4, 4) and np.linalg.det(base_from_flange[:3, :3]) == pytest.approx(1.0)


def test_truth_waits_for_the_near_future_and_refuses_the_rest(controller, admin) -> None:
    ask = admin(controller("UR10"))
    soon_ns = time.monotonic_ns() + 100_000_000
    assert ask.ask("truth", at_monotonic_ns=soon_ns)["at_monotonic_ns"] == soon_ns
    assert time.monotonic_ns() >= soon_ns
    with raises("simulation-refused"):
        ask.ask("truth", at_monotonic_ns=1)
