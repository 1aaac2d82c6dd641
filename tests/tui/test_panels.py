"""The small panels and the list of events, as lines of text."""

from __future__ import annotations

import msgspec
import pytest

from station.cell.status import EstimateStatus, Event, StationState, StationStatus
from station.tui.live import event_text
from station.tui.widgets.panels import device_lines, estimate_lines, progress_lines
from tests.tui.conftest import idle

SEALED = Event(
    0, "info", "sealed with 25 of 26 poses: /var/lib/station/sessions/20260131-101500-cell/session.mcap"
)


def sealed(calibration: str = "") -> StationStatus:
    estimate = EstimateStatus(
        25, (1.0, 2.0, 3.0), sigma_translation_mm=0.2, enough=True, advice="enough", improve="known better"
    )
    session = msgspec.structs.replace(idle().session, recording="/r", calibration=calibration)
    return msgspec.structs.replace(idle(), session=session, estimate=estimate)


def test_a_played_arm_is_said_to_be_none() -> None:
    (robot, camera, *_) = device_lines(msgspec.structs.replace(idle(), playback=True))
    assert "not live" in robot and "Hz" not in robot and not robot.endswith("ok")
    assert "not live" in camera and not camera.endswith("ok")
    session = msgspec.structs.replace(idle().session, current=3)
    played = msgspec.structs.replace(idle(StationState.MOVING), playback=True, session=session)
    assert progress_lines(played)[0] == "p04: played, no arm moves"


def test_a_solved_session_is_not_to_be_solved() -> None:
    assert "F9" in progress_lines(sealed())[0] and "F9" in estimate_lines(sealed())[-1]
    solved = sealed("/c")
    assert progress_lines(solved) == ["0 of 25 poses captured, solved: 3 shows it"]
    assert estimate_lines(solved)[-1] == "3 shows the final one"


def test_a_picture_counts_until_its_pose_was_taken_again() -> None:
    first, second, *rest = idle().session.poses
    first = msgspec.structs.replace(first, state="done")
    second = msgspec.structs.replace(second, kept=True)
    session = msgspec.structs.replace(idle().session, poses=(first, second, *rest))
    paused = msgspec.structs.replace(idle(StationState.PAUSED), session=session)
    assert progress_lines(paused) == ["2 of 25 poses captured, 1 to be captured again"]


def test_a_drift_check_is_to_be_judged_and_not_solved() -> None:
    check = sealed()
    check = msgspec.structs.replace(check, session=msgspec.structs.replace(check.session, check=True))
    said = " ".join([*progress_lines(check), *estimate_lines(check)])
    assert "k on 4 judges it" in said and "F9" not in said


def test_what_is_enough_needs_no_better_plan() -> None:
    running = sealed()
    running = msgspec.structs.replace(running, session=msgspec.structs.replace(running.session, recording=""))
    assert estimate_lines(running)[2:] == ["enough"]


@pytest.mark.parametrize(
    ("state", "line"),
    [(StationState.PAUSED, "1 of 25 poses captured"), (StationState.FREE_DRIVE, "p01: tilted left")],
)
def test_steps_of_a_pose_that_is_done_are_shown_only_where_the_next_may_follow(
    state: StationState, line: str
) -> None:
    session = idle().session
    done = msgspec.structs.replace(session.poses[0], state="done")
    session = msgspec.structs.replace(session, poses=(done, *session.poses[1:]), current=0)
    assert progress_lines(msgspec.structs.replace(idle(state), session=session))[0] == line


@pytest.mark.parametrize(
    ("width", "end"),
    [
        (80, "25 of 26 poses: …/20260131-101500-cell/session.mcap"),
        (160, "25 of 26 poses: /var/lib/station/sessions/20260131-101500-cell/session.mcap"),
        (0, "25 of 26 poses: /var/lib/station/sessions/20260131-101500-cell/session.mcap"),
    ],
)
def test_a_path_that_does_not_fit_keeps_its_end(width: int, end: str) -> None:
    line = event_text(SEALED, width).plain
    assert line.endswith(end)
    assert not width or len(line) <= width
