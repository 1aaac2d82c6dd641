"""The bar as it reads at the usual widths: golden lines, and the STOP key in every one of them."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from station.cell.status import RecorderStatus, RobotStatus, StationState, StationStatus
from station.tui.widgets.bar import bar_line
from tests.tui.conftest import FakeLink, app_on, idle, text_of, until

ROBOT = RobotStatus(
    connected=True, model="UR10", safety="NORMAL", remote=True, speed_m_s=0.21, speed_limit_m_s=0.25
)

WIDE = (
    " FREE-DRIVE SIMULATED UR10e Series 5 (lab bench)│0.21/0.25 m/s│"
    "AUTOMATIC MODE SAFEGUARD REMOTE│18/25│212 GB│    F12=STOP"
)

SCRIPTED = " MOVING SIMULATED UR10│0.21/0.25 m/s│NORMAL REMOTE│18/25│by own script│212 GB│    F12=STOP"

LIBRARY = " MOVING SIMULATED UR10│0.21/0.25 m/s│NORMAL REMOTE│18/25 6:02│212 GB│             F12=STOP"


def working(state: StationState = StationState.MOVING) -> StationStatus:
    status = idle(state)
    session = msgspec.structs.replace(status.session, captured=18, elapsed_s=362.0)
    recorder = RecorderStatus(recording=True, free_bytes=212_000_000_000)
    return msgspec.structs.replace(status, robot=ROBOT, session=session, recorder=recorder)


def long_one() -> StationStatus:
    status = working(StationState.FREE_DRIVE)
    robot = msgspec.structs.replace(
        ROBOT, model="UR10e Series 5 (lab bench)", safety="AUTOMATIC MODE SAFEGUARD"
    )
    return msgspec.structs.replace(status, robot=robot)


def driven_by(path: str) -> StationStatus:
    return msgspec.structs.replace(working(), robot=msgspec.structs.replace(ROBOT, control_path=path))


def played() -> StationStatus:
    return msgspec.structs.replace(working(), playback=True)


@pytest.mark.parametrize(
    ("status", "width", "line"),
    [
        (working(), 80, " MOVING SIMULATED UR10│0.21/0.25 m/s│NORMAL REMOTE│18/25 6:02│212 GB│   F12=STOP"),
        (
            working(StationState.FREE_DRIVE),
            80,
            " FREE-DRIVE SIMULATED UR10│0.21/0.25 m/s│NORMAL REMOTE│18/25│212 GB│    F12=STOP",
        ),
        (
            long_one(),
            80,
            " FREE-DRIVE SIMULATED UR10e Seri…│AUTOMATIC MODE SAFEGUARD REMOTE│18/25│F12=STOP",
        ),
        (
            long_one(),
            120,
            WIDE,
        ),
        (driven_by("script"), 90, SCRIPTED),
        (driven_by("ur_rtde"), 90, LIBRARY),
        (played(), 80, " PLAYBACK, no live arm: MOVING SIMULATED UR10│18/25 6:02│212 GB free│   F12=STOP"),
    ],
)
def test_golden_lines(status: StationStatus, width: int, line: str) -> None:
    assert bar_line(status, width) == line


@given(
    width=st.integers(20, 200),
    model=st.text(alphabet="UR10e x", max_size=60),
    safety=st.sampled_from(["", "NORMAL", "PROTECTIVE STOP", "ROBOT EMERGENCY STOP"]),
    state=st.sampled_from(list(StationState)),
    both=st.booleans(),
)
def test_the_stop_key_is_at_the_right_edge_whatever_the_rest(
    width: int, model: str, safety: str, state: StationState, both: bool
) -> None:
    robot = msgspec.structs.replace(ROBOT, model=model, safety=safety)
    status = msgspec.structs.replace(working(state), playback=both, robot=robot)
    line = bar_line(status, width)
    assert len(line) <= width
    assert line.endswith("F12=STOP")


@pytest.mark.parametrize("size", [(80, 24), (120, 34)])
async def test_on_the_screen_it_is_the_first_line(link: FakeLink, size: tuple[int, int]) -> None:
    link.show(long_one())
    async with app_on(link).run_test(size=size) as pilot:
        await until(pilot, lambda: text_of(pilot.app, "#bar") == bar_line(long_one(), size[0]))
        assert pilot.app.screen.query_one("#bar").region.y == 0
        await pilot.resize_terminal(60, 20)
        await pilot.pause()
        assert text_of(pilot.app, "#bar").endswith("F12=STOP")


def test_a_disk_that_is_nearly_full_is_not_left_out() -> None:
    status = msgspec.structs.replace(working(), recorder=RecorderStatus(free_bytes=0))
    assert "│0 B free│" in bar_line(status, 120)
    assert "│0 B│" in bar_line(status, 74)


@pytest.mark.parametrize(
    ("state", "key"),
    [(StationState.FREE_DRIVE, "F2"), (StationState.PAUSED, "F5"), (StationState.FAULT, "F8 acknowledges")],
)
async def test_the_reason_names_the_next_key(link: FakeLink, state: StationState, key: str) -> None:
    link.show(idle(state, "why"))
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: "why │ " in text_of(pilot.app, "#reason"))
        assert key in text_of(pilot.app, "#reason")


HELD = "protective stop: find what the arm ran into, then enable it again on the pendant"


@pytest.mark.parametrize(
    ("state", "key"), [(StationState.IDLE, ""), (StationState.PAUSED, "then F5 continues")]
)
async def test_what_holds_the_arm_at_rest_is_said_before_the_next_key(
    link: FakeLink, state: StationState, key: str
) -> None:
    """Acknowledged here, and still stopped at the pendant."""
    status = idle(state)
    link.show(msgspec.structs.replace(status, robot=msgspec.structs.replace(status.robot, held=HELD)))
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: HELD in text_of(pilot.app, "#reason"))
        assert key in text_of(pilot.app, "#reason")
        assert not pilot.app.screen.query_one("#reason").has_class("note")
        link.show(status)
        await until(pilot, lambda: HELD not in text_of(pilot.app, "#reason"))


async def test_a_pause_that_waits_for_the_pose_is_said_at_once(link: FakeLink) -> None:
    link.show(msgspec.structs.replace(working(), pending="pauses after this pose"))
    async with app_on(link).run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: text_of(pilot.app, "#reason") == "pauses after this pose")
