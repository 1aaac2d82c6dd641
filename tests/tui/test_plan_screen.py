"""The plan screen: what it says while a plan is made, and a plan of many poses."""

from __future__ import annotations

import asyncio
from typing import Any

import msgspec

from station.status import PoseStatus
from station.tui.plan import PLANNING
from tests.tui.conftest import FakeLink, idle, until
from tests.tui.test_keys import app_on, text_of


class SlowPlanner(FakeLink):
    """Makes a plan when it is told to."""

    def __init__(self) -> None:
        super().__init__()
        self.made = asyncio.Event()

    async def request(self, verb: str, **args: Any) -> Any:
        answer = await super().request(verb, **args)
        if verb == "make_plan":
            await self.made.wait()
        return answer


async def test_it_says_that_it_plans_for_as_long_as_it_does() -> None:
    link = SlowPlanner()
    async with app_on(link).run_test(size=(80, 24), notifications=True) as pilot:
        await until(pilot, lambda: "SIMULATED" in text_of(pilot.app, "#bar"))
        await pilot.press("2", "n")
        await until(pilot, lambda: text_of(pilot.app, "#plan-detail") == PLANNING)
        await pilot.press("n")
        await until(pilot, lambda: any("already" in n.message for n in pilot.app._notifications))
        assert link.verbs.count("make_plan") == 1
        link.made.set()
        await until(pilot, lambda: "p01" in text_of(pilot.app, "#plan-detail"))


async def test_the_end_of_two_hundred_poses_is_told_as_the_start_is(link: FakeLink) -> None:
    status = idle()
    poses = tuple(PoseStatus(index=i, name=f"p{i + 1:03d}", why=f"place {i + 1}") for i in range(200))
    link.show(msgspec.structs.replace(status, session=msgspec.structs.replace(status.session, poses=poses)))
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: "/200" in text_of(pilot.app, "#bar"))
        await pilot.press("2", "end")
        await until(pilot, lambda: "place 200" in text_of(pilot.app, "#plan-detail"))
        await pilot.press("d")
        await until(pilot, lambda: ("drop", {"index": 199}) in link.asked)
