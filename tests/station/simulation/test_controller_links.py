"""A controller that reboots, or was held up."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from itertools import pairwise
from typing import Any

import pytest

from tests.patience import wait_until

pytestmark = pytest.mark.process


def test_a_reboot_ends_links_and_starts_at_time_zero(controller, rtde, admin) -> None:
    running = controller("UR10")
    client = rtde(running)
    client.start("timestamp")
    before_s = client.sample()["timestamp"]
    admin(running).ask("restart", down_s=0.4)
    with pytest.raises(ConnectionError):
        while True:
            client.receive()
    again: list[Any] = []

    def back() -> bool:
        with suppress(ConnectionRefusedError):
            again.append(rtde(running))
        return bool(again)

    wait_until(back)
    again[0].start("timestamp", "robot_mode")
    sample = again[0].sample()
    assert sample["timestamp"] < before_s + 0.35 and sample["robot_mode"] == 3


def test_late_cycles_come_all_and_in_order(controller, rtde) -> None:
    running = controller("UR10e")
    client = rtde(running)
    client.start("timestamp")
    os.kill(running.process.pid, signal.SIGSTOP)
    time.sleep(0.2)
    os.kill(running.process.pid, signal.SIGCONT)
    stamps = [client.sample()["timestamp"] for _ in range(300)]
    assert [b - a for a, b in pairwise(stamps)] == pytest.approx([0.002] * 299, abs=1e-9)
