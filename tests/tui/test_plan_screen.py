"""The plan screen: what it says while a plan is made, and a plan of many poses."""

from __future__ import annotations

import asyncio

import msgspec
from textual.widgets import DataTable

from station.protocol import verbs
from station.tui.daemon_link import BUSY
from tests.tui.conftest import FakeLink, idle, in_session, opened, said, text_of, until


async def test_it_says_that_it_plans_for_as_long_as_it_does(link: FakeLink) -> None:
    made = link.slow["make_plan"] = asyncio.Event()
    async with opened(link, notifications=True) as pilot:
        await pilot.press("2", "n")
        await until(pilot, lambda: BUSY[verbs.MakePlan] in text_of(pilot.app, "#next"))
        await pilot.press("n")
        await until(pilot, lambda: "Busy" in said(pilot))
        assert link.verbs.count("make_plan") == 1
        made.set()
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
        await until(pilot, lambda: table.row_count == 25 and str(table.get_row_at(7)[-1]) == "too dark")
        assert str(table.get_row_at(7)[-2]) == "failed", "a long reason pushes no column out of sight"
        assert [str(table.get_row_at(row)[0])[-1] for row in (6, 7)] == ["○", "✗"]  # never cut away


async def test_a_key_between_a_shorter_plan_and_its_drawing_asks_nothing(link: FakeLink) -> None:
    status = idle()
    async with opened(link) as pilot:
        await pilot.press("2", "end")
        await until(pilot, lambda: pilot.app.screen.query_one(DataTable).cursor_row == 24)
        pilot.app.hear(in_session(status, poses=status.session.poses[:8]))
        pilot.app.screen.action_pose("retake")
        pilot.app.screen.on_data_table_row_selected()
        await pilot.pause()
        await pilot.press("r")
        await until(pilot, lambda: link.verbs)
        assert link.verbs == ["retake"] and verbs.Retake(7) in link.asked
