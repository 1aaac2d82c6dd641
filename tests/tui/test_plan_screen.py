"""The plan screen: what it says while a plan is made, and a plan of many poses."""

from __future__ import annotations

import asyncio
from typing import Any

import msgspec
import numpy as np
import pytest
from textual.widgets import DataTable

from calibrate.geometry import pose as pose_of
from station.cell.status import EstimateStatus, PoseStatus
from station.protocol import verbs
from station.tui.desk import busy_words
from station.tui.live import LiveScreen
from station.tui.widgets.panels import estimate_lines, pose_map_lines, progress_lines
from station.tui.words import POSE_MARKS
from tests.tui.conftest import FakeLink, app_on, idle, opened, text_of, until


class SlowPlanner(FakeLink):
    """Makes a plan when it is told to."""

    def __init__(self) -> None:
        super().__init__()
        self.made = asyncio.Event()

    async def call(self, verb: verbs.Verb[Any], *, timeout_s: float = 0.0) -> Any:
        answer = await super().call(verb)
        if isinstance(verb, verbs.MakePlan):
            await self.made.wait()
        return answer


async def test_it_says_that_it_plans_for_as_long_as_it_does() -> None:
    link = SlowPlanner()
    async with opened(link, notifications=True) as pilot:
        await pilot.press("2", "n")
        await until(pilot, lambda: busy_words(verbs.MakePlan(25)) in text_of(pilot.app, "#reason"))
        await pilot.press("n")
        await until(pilot, lambda: any("One after the other" in n.message for n in pilot.app._notifications))
        assert link.verbs.count("make_plan") == 1
        link.made.set()
        await until(pilot, lambda: not text_of(pilot.app, "#reason").strip())


async def test_the_end_of_two_hundred_poses_is_told_as_the_start_is(link: FakeLink) -> None:
    status = idle()
    poses = tuple(PoseStatus(index=i, name=f"p{i + 1:03d}", why=f"place {i + 1}") for i in range(200))
    link.show(msgspec.structs.replace(status, session=msgspec.structs.replace(status.session, poses=poses)))
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: "/200" in text_of(pilot.app, "#bar"))
        await pilot.press("2", "end")
        await until(pilot, lambda: "place 200" in text_of(pilot.app, "#plan-detail"))
        await pilot.press("d")
        await until(pilot, lambda: verbs.Drop(199) in link.asked)
        fewer = msgspec.structs.replace(status.session, poses=poses[:-1])
        link.show(msgspec.structs.replace(status, session=fewer))
        await until(pilot, lambda: "place 199" in text_of(pilot.app, "#plan-detail"))


@pytest.mark.parametrize(
    ("count", "current", "first", "last"), [(25, None, "", ""), (200, 0, "1", "116"), (200, 199, "88", "200")]
)
def test_the_map_of_poses_leaves_room_for_the_rest(
    count: int, current: int | None, first: str, last: str
) -> None:
    status = idle()
    first_one: PoseStatus = PoseStatus(index=0, name="p0", state="failed")
    poses = (first_one, *(PoseStatus(index=i, name=f"p{i}") for i in range(1, count)))
    session = msgspec.structs.replace(status.session, poses=poses, current=current)
    *rows, words = pose_map_lines(msgspec.structs.replace(status, session=session))
    assert len(rows) <= 4
    assert max(map(len, [*rows, words])) <= 29
    assert words == (f"{first} to {last} of {count}" if first else "+ done - skipped x failed")


def test_the_marks_are_explained_once_one_needs_it() -> None:
    assert pose_map_lines(idle()) == ["· " * 12 + "·", "· " * 11 + "·"]
    assert all(f"{mark} {state}" in LiveScreen.HELP for state, mark in POSE_MARKS.items())


def test_the_time_that_is_left_stands_beside_the_steps() -> None:
    status = idle()
    poses = (msgspec.structs.replace(status.session.poses[0], state="settling"), *status.session.poses[1:])
    session = msgspec.structs.replace(status.session, poses=poses, current=0, remaining_s=639.0)
    steps = progress_lines(msgspec.structs.replace(status, session=session))[-1]
    assert steps == "move ██ settle █▒ capture ░░ write ░░ 10:39 left"
    assert len(steps) <= 48  # what 80 columns leave


def test_a_pose_that_failed_says_why_in_place_of_its_steps() -> None:
    status = idle()
    failed = msgspec.structs.replace(status.session.poses[0], state="failed", reason="the board is cut")
    session = msgspec.structs.replace(
        status.session, poses=(failed, *status.session.poses[1:]), current=0, captured=0
    )
    assert progress_lines(msgspec.structs.replace(status, session=session)) == [
        f"{failed.name}: failed",
        "the board is cut",
    ]


def test_a_plan_that_was_not_begun_says_which_key_is_next() -> None:
    status = idle()
    session = msgspec.structs.replace(status.session, name="")
    assert "F5" in progress_lines(msgspec.structs.replace(status, session=session))[0]


@pytest.mark.parametrize(("size", "lines"), [((80, 24), 3), ((100, 40), 3), ((160, 48), 2)])
async def test_the_advice_uses_the_width_there_is(link: FakeLink, size: tuple[int, int], lines: int) -> None:
    advice = "at best 1 more for 0.5 mm; the next best: 428 mm, tilt 31°, roll +1°, board left"
    found = EstimateStatus(9, (1.0, 2.0, 3.0), 0.4, 0.05, advice=advice)
    link.show(msgspec.structs.replace(idle(), estimate=found))
    async with app_on(link).run_test(size=size) as pilot:
        await until(pilot, lambda: "board left" in text_of(pilot.app, "#estimate"))
        shown = text_of(pilot.app, "#estimate").splitlines()[2:]
        assert " ".join(shown) == advice
        assert len(shown) == lines
        await pilot.resize_terminal(120, 40)
        await until(pilot, lambda: len(text_of(pilot.app, "#estimate").splitlines()) == 4)


async def test_a_pose_added_here_is_called_by_its_number(link: FakeLink) -> None:
    status = idle()
    status = msgspec.structs.replace(
        status,
        session=msgspec.structs.replace(status.session, poses=status.session.poses[3:]),  # some were dropped
        robot=msgspec.structs.replace(status.robot, joints_rad=(0.0,) * 6),
    )
    link.show(status)
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: "/22" in text_of(pilot.app, "#bar"))
        await pilot.press("2", "a")
        await until(pilot, lambda: "add" in link.verbs)
        (added,) = [verb for verb in link.asked if isinstance(verb, verbs.Add)]
        assert added.pose.name == "here-26"


def test_the_estimate_of_a_sealed_session_asks_for_no_more_poses() -> None:
    found = EstimateStatus(
        9, (1.0, 2.0, 3.0), 0.4, 0.05, advice="go on: every pose still helps", improve="6 times better"
    )
    status = msgspec.structs.replace(idle(), estimate=found)
    assert "p on screen 2 plans the rest" in estimate_lines(status)
    assert "go on" in " ".join(estimate_lines(status))
    session = msgspec.structs.replace(status.session, recording="s.mcap")
    lines = estimate_lines(msgspec.structs.replace(status, session=session))
    assert lines[-1] == "F9 finds the final one" and len(lines) == 3


async def test_the_sketch_fills_its_place_before_anything_new_is_told(link: FakeLink) -> None:
    status = idle()
    places = [
        tuple(tuple(row) for row in pose_of(np.eye(3), np.array([x, x, x])).tolist()) for x in (0.3, 0.9)
    ]
    poses = tuple(
        PoseStatus(index=i, name=f"p{i}", base_from_flange=place)  # type: ignore[arg-type]
        for i, place in enumerate(places)
    )
    link.show(msgspec.structs.replace(status, session=msgspec.structs.replace(status.session, poses=poses)))
    async with app_on(link).run_test(size=(160, 48)) as pilot:
        await until(pilot, lambda: "/2" in text_of(pilot.app, "#bar"))
        await pilot.press("2")
        await until(
            pilot, lambda: max(map(len, text_of(pilot.app, "#plan-sketch").splitlines()), default=0) > 30
        )


async def test_a_pose_that_changes_is_told_where_it_stands(link: FakeLink) -> None:
    status = idle()
    async with opened(link) as pilot:
        await pilot.press("2")
        poses = list(status.session.poses)
        poses[7] = msgspec.structs.replace(poses[7], state="failed", reason="too dark")
        session = msgspec.structs.replace(status.session, poses=tuple(poses))
        link.show(msgspec.structs.replace(status, session=session))
        table = pilot.app.screen.query_one(DataTable)
        await until(
            pilot, lambda: table.row_count == 25 and table.get_row_at(7)[2:5:2] == ["x failed", "too dark"]
        )
        assert table.get_row_at(6)[2] == "· planned"
