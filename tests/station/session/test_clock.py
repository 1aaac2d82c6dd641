"""Clocks of a running session: a wall clock that is set, a picture whose time is not known well enough."""

from __future__ import annotations

import time

import msgspec
import pytest

from station.cell.status import StationState as S
from station.session.monitor import Monitor
from tests.station.session_rig import Rig


async def test_24_a_step_of_the_wall_clock_is_told_once(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monitor = Monitor(rig.session.context)
    real_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: real_ns() + 3_600_000_000_000)
    monitor.refresh(0.0)
    monitor.refresh(0.0)
    told = [e for e in rig.told("wall-clock-set") if e.values["step_s"] == 3600.0]
    # The session's own monitor may have told it, too.
    assert 1 <= len(told) <= 2


async def test_25_a_pose_whose_time_is_too_uncertain_is_refused(rig: Rig) -> None:
    cell = rig.session.context.cell
    capture = msgspec.structs.replace(cell.config.capture, time_bound_s=0.001)  # no clock: ±25 ms
    object.__setattr__(cell, "config", msgspec.structs.replace(cell.config, capture=capture))
    await rig.give_go()
    await rig.until(S.PAUSED)
    values = rig.told("time-unsure")[0].values
    assert (values["bound_s"], values["limit_s"]) == (0.025, 0.001)
    assert "done" not in rig.pose_states
