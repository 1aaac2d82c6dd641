"""The plan screen: what it says while a plan is made, and a plan of many poses."""

from __future__ import annotations

import asyncio

import msgspec
from textual.widgets import DataTable

from station.protocol import verbs
from station.tui.daemon_link import BUSY
from tests.tui.conftest import FakeLink, idle, in_session, opened, said, text_of, until


class SlowPlanner(FakeLink):
    """Makes a plan when it is told to."""

    def __init__(self) -> None:
        super().__init__()
        self.made = asyncio.Event()

    async def request(self, verb: str, *, timeout_s: float = 0.0, **args: object) -> object:
        answer = await super().request(verb, **args)
        if verb == "make_plan":
            await self.made.wait()
        return answer


async def test_it_says_that_it_plans_for_as_long_as_it_does() -> None:
    link = SlowPlanner()
    async with opened(link, notifications=True) as pilot:
        await pilot.press("2", "n")
        await until(pilot, lambda: BUSY[verbs.MakePlan] in text_of(pilot.app, "#next"))
        await pilot.press("n")
        await until(pilot, lambda: "Busy" in said(pilot))
        assert link.verbs.count("make_plan") == 1
        link.made.set()
        await until(pilot, lambda: "Wait" not in text_of(pilot.app, "#next"))


async def test_run_makes_the_plan_that_is_not_there_and_asks(link: FakeLink) -> None:
    link.show(in_session(idle(), poses=()))
    async with opened(link) as pilot:
        await pilot.press("f5")
        await until(pilot, lambda: pilot.app.screen.query("#motion"))
        assert link.verbs == ["make_plan", "prepare"]


async def test_a_pose_that_changes_is_told_where_it_stands(link: FakeLink) -> None:
    status = idle()
    async with opened(link) as pilot:
        await pilot.press("2")
        poses = list(status.session.poses)
        poses[7] = msgspec.structs.replace(poses[7], state="failed", reason="too dark")
        link.show(in_session(status, poses=tuple(poses)))
        table = pilot.app.screen.query_one(DataTable)
        await until(
            pilot, lambda: table.row_count == 25 and str(table.get_row_at(7)[-2]) == "failed: too dark"
        )
        assert [str(table.get_row_at(row)[0])[-1] for row in (6, 7)] == ["○", "✗"]  # never cut away
