"""The plan screen: what it says while a plan is made, and a plan of many poses."""

from __future__ import annotations

import asyncio

import msgspec
from textual.widgets import DataTable

from calibrate.arms.classes import ARM_CLASSES
from recordings.schema.messages import RobotIdentity
from station.cell.status import EstimateStatus, PoseStatus, StationStatus
from station.protocol import verbs
from station.tui.daemon_link import BUSY
from station.tui.plan_screen import facts_line
from station.tui.task import Known
from tests.tui.conftest import CELL, FakeLink, idle, in_session, opened, said, text_of, until, with_robot


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


def told(status: StationStatus) -> str:
    return facts_line(Known(status, configuration=CELL)).plain


def test_a_goal_that_the_arm_does_not_reach_is_told_before_and_while_it_is_captured() -> None:
    poses = tuple(PoseStatus(i, f"p{i}", predicted_sigma_mm=4 / (i + 1)) for i in range(8))
    planned = in_session(idle(), poses=poses, working_distance_m=0.5, floor_mm=0.2)
    assert "0.5 mm" in told(planned) and "0.2 mm" not in told(planned)
    assert "1.3 mm" in told(in_session(planned, floor_mm=1.3)), "by a usual arm"
    estimate = EstimateStatus(4, predicted_error_mm=2.5, floor_mm=2.4, with_more_views_mm=2.49)
    seen = msgspec.structs.replace(planned, estimate=estimate)
    assert "± 2.4 mm" in told(seen) and "own 2.4 mm" in told(seen), "by this one's images"


def test_of_an_arm_that_tells_no_joints_it_says_what_they_would_win() -> None:
    posted = in_session(with_robot(idle(), by_hand=True, identity=RobotIdentity("xArm 6")), poses=())
    silent = with_robot(posted, state=msgspec.structs.replace(posted.robot.state, joints_rad=()))
    assumed = ARM_CLASSES["industrial-six"].title
    assert assumed in told(silent) and assumed not in told(posted)
    assert assumed not in told(with_robot(posted, state=None)), "nobody knows yet what it tells"


async def test_retake_goes_on_to_the_next_pose_and_one_key_retakes_all_that_failed(link: FakeLink) -> None:
    failed = (3, 7, 24)
    status = idle()
    poses = [
        msgspec.structs.replace(pose, state="failed" if pose.index in failed else "done")
        for pose in status.session.poses
    ]
    async with opened(link) as pilot:
        await pilot.press("2")
        assert not pilot.app.screen.does_something("retake_failed"), "nothing failed"
        link.show(in_session(status, poses=tuple(poses)))
        await until(pilot, lambda: pilot.app.screen.does_something("retake_failed"))
        await pilot.press("r", "r")
        await until(pilot, lambda: link.verbs.count("retake") == 2)
        assert verbs.Retake(0) in link.asked and verbs.Retake(1) in link.asked
        link.asked.clear()
        await pilot.press("a")
        await until(pilot, lambda: len(link.verbs) == len(failed))
        assert [verb for verb in link.asked if isinstance(verb, verbs.Retake)] == [
            verbs.Retake(index) for index in failed
        ]
