"""The parts of the capture screen, as text: progress, error, coverage, events."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from recordings.geometry import pose as pose_of
from station.cell.config import matrix4
from station.cell.status import ArmCondition, EstimateStatus, PoseStatus, StationState
from station.tui.capture_panels import coverage_lines, error_columns, error_lines, errors_after
from station.tui.progress import chips, pose_line
from station.tui.stopped import stopped_text
from station.tui.task import Known
from station.tui.widgets.cell_drawing import draw
from tests.recordings.small_recording import make_state
from tests.tui.conftest import CELL, idle, in_session, with_robot


def test_steps_of_a_pose_are_marked_one_after_the_other() -> None:
    first, *rest = idle().session.poses
    settling = in_session(idle(StationState.SETTLING), current=0)
    assert pose_line(settling).plain == "✓ move  ▶ settle  ○ capture ○ save"
    failed = msgspec.structs.replace(first, state="failed", reason="the board is cut")
    assert "the board is cut" in pose_line(in_session(idle(), poses=(failed, *rest), current=0)).plain


@pytest.mark.parametrize(("count", "current"), [(25, None), (25, 24), (200, 0), (200, 199)])
@pytest.mark.parametrize(("width", "rows"), [(35, 3), (60, 3)])
def test_the_chip_of_the_pose_under_way_is_always_there(
    count: int, current: int | None, width: int, rows: int
) -> None:
    poses = [PoseStatus(index=i, name=f"p{i}") for i in range(count)]
    shown = [
        row.plain
        for row in chips(in_session(idle(), poses=tuple(poses), current=current).session, width, rows)
    ]
    assert len(shown) <= rows
    assert max(map(len, shown)) <= width
    if current is not None:
        assert f"{current + 1}▶" in "".join(shown)


@pytest.mark.parametrize("cause", ["stop", "protective-stop", "stale-state"])
def test_the_card_says_that_the_arm_stands_only_where_it_is_known(cause: str) -> None:
    status = msgspec.structs.replace(idle(StationState.STOPPED, "why it stopped"), cause=cause)

    def said(**robot: object) -> str:
        return stopped_text(with_robot(status, **robot)).plain.splitlines()[0]

    assert status.robot.connected
    rests = said(still=True)
    assert ("hy it stopped" in rests) is (cause != "protective-stop")
    assert (said(still=False) == rests) is (cause == "stale-state")
    assert (said(still=True, state=None) == rests) is (cause == "stale-state")
    assert "F5" in stopped_text(status).plain
    by_hand = stopped_text(with_robot(status, by_hand=True)).plain
    assert "F3" in by_hand and "F5" not in by_hand, "nobody can let it move from here"
    untold = with_robot(status, condition=ArmCondition())
    assert "✓" in stopped_text(status).plain and "✓" not in stopped_text(untold).plain


def test_the_error_falls_towards_its_goal() -> None:
    poses = tuple(
        PoseStatus(
            index=i,
            name=f"p{i}",
            predicted_sigma_mm=4 / (i + 1),
            estimated_sigma_mm=0.5 / (i + 1) if i < 6 else None,
        )
        for i in range(25)
    )
    estimate = EstimateStatus(6, predicted_error_mm=0.83, working_distance_m=0.5)
    status = msgspec.structs.replace(in_session(idle(), poses=poses), estimate=estimate)
    falling = [error_mm for error_mm, _ in errors_after(poses)]
    assert falling == sorted(falling, reverse=True), "more views make nothing worse"
    noisy = tuple(msgspec.structs.replace(p, estimated_sigma_mm=1.5 if p.index < 6 else None) for p in poses)
    floored = [error_mm for error_mm, _ in errors_after(noisy, floor_mm=1.2)]
    assert floored == [1.5] * 6 + [1.2] * 19, "the planned ones are those of this arm"
    lines = error_lines(Known(status, configuration=CELL), 60, 14).plain.split("\n")
    assert all(said in lines[0] for said in ("0.83 mm", "500 mm", "goal 1 mm")) and "✓" not in lines[0]
    assert len(lines) == 14
    assert any(line.startswith(" 1.00 ") for line in lines)
    enough = msgspec.structs.replace(status, estimate=msgspec.structs.replace(estimate, enough=True))
    assert "✓ goal 1 mm" in error_lines(Known(enough, configuration=CELL), 60, 14).plain
    coarse = msgspec.structs.replace(estimate, floor_mm=1.2, with_more_views_mm=0.82)
    beyond = error_lines(Known(msgspec.structs.replace(status, estimate=coarse), configuration=CELL), 60, 14)
    assert "1.2 mm" in beyond.plain and "1.2 mm" not in "\n".join(lines)
    assert len(beyond.plain.split("\n")) == 14 and max(map(len, beyond.plain.split("\n"))) <= 60
    check = in_session(enough, poses=poses, check=True)
    assert "mm" not in error_lines(Known(check, configuration=CELL), 60, 14).plain


def test_columns_stay_in_their_room_whatever_they_are_given() -> None:
    for errors in ([], [None], [0.0], [float("inf")], [1e-9, 1e9], [1.0] * 200):
        for goal in (None, 0.5):
            drawn = list(error_columns([(error, True) for error in errors], goal, 40, 8))
            assert len(drawn) in (0, 8) and all(len(line.plain) <= 40 for line in drawn)


def seeing(x_m: float, y_m: float) -> PoseStatus:
    """Straight above a place on the table, looking down, 0.5 m high."""
    down = np.diag([1.0, -1.0, -1.0])
    return PoseStatus(index=3, name="p4", base_from_flange=matrix4(pose_of(down, np.array([x_m, y_m, 0.5]))))


def test_the_parts_of_the_image_without_the_board_are_counted() -> None:
    views = ((1,) * 6, (1, 2, 3, 0, 0, 1))
    for image_views, said in ((views, "2 of 12 parts empty"), ((views[0],) * 2, "in every part")):
        known = Known(msgspec.structs.replace(idle(), estimate=EstimateStatus(3, image_views=image_views)))
        assert said in coverage_lines(known, 60, 12).plain


def test_the_scene_shows_arm_board_and_table(monkeypatch: pytest.MonkeyPatch) -> None:
    status = in_session(idle(), poses=(seeing(0.6, 0.0), seeing(0.5, 0.2)))
    standing = msgspec.structs.replace(make_state(0), joints_rad=(0.0, -1.6, -1.5, -1.6, 1.5, 0.0))
    status = with_robot(status, state=standing)
    drawn = draw(CELL, status, 0, 60, 24).plain
    assert "board" in drawn and "table" in drawn
    assert len({letter for letter in drawn if ord(letter) > 0x2500}) > 2
    monkeypatch.setenv("TERM", "linux")
    assert "board" not in draw(CELL, status, 0, 60, 24).plain, "its font has no braille"
