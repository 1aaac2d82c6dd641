"""The pendant's speed slider: slow is no fault, standing still is said."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from station.devices import ur_moves
from tests.codes import raises
from tests.patience import until

pytestmark = pytest.mark.process

Make = Callable[..., Awaitable[Any]]


async def test_at_five_percent_the_move_arrives(cell: Make) -> None:
    c = await cell()
    c.admin.ask("slider", fraction=0.05)
    goal = c.joints_rad()
    goal[5] += 0.02
    move = asyncio.create_task(c.robot.move(goal, 0.8, 1.0))
    await until(lambda: c.robot.notice == "speed slider at 5 %")
    await move
    assert max(abs(a - b) for a, b in zip(c.joints_rad(), goal, strict=True)) < 1e-3
    assert c.robot.notice == ""


async def test_at_zero_the_arm_waits_and_the_operator_is_told(cell: Make) -> None:
    c = await cell()
    move = await c.cruising()
    c.admin.ask("slider", fraction=0.0)
    await until(lambda: "slider on the pendant is at 0" in c.robot.notice)
    await asyncio.sleep(0.3)
    assert not move.done()
    c.admin.ask("slider", fraction=1.0)
    await move


async def test_at_zero_for_too_long_the_move_is_given_up(cell: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ur_moves, "SLIDER_ZERO_S", 0.8)
    c = await cell()
    move = await c.cruising()
    c.admin.ask("slider", fraction=0.0)
    with raises("slider-zero"):
        await move
    c.admin.ask("slider", fraction=1.0)
    await c.stays_at_rest()
