"""Rail, next action and frame: one next action in every state, STOP on every screen and question."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from textual.screen import Screen

from recordings.schema.messages import RobotIdentity
from station.cell.status import (
    NO_IMAGE,
    ArmCondition,
    DetectionStatus,
    GuidanceStatus,
    LeaseStatus,
    PoseStatus,
    RecorderStatus,
    RobotStatus,
    StationState,
    StationStatus,
)
from station.protocol.verbs import Check
from station.tui.dialogs import Confirm, ConfirmMotion, Reason
from station.tui.frame import Question, StopBlock, bar_line, next_line, rail_line
from station.tui.task import DIGITS, Action, Known, next_action, steps
from tests.recordings.small_recording import make_state
from tests.tui.conftest import (
    SUMMARY,
    FakeLink,
    after_check,
    idle,
    in_session,
    opened,
    said,
    text_of,
    until,
    with_robot,
)

SIZES = [(80, 24), (160, 48)]
HELD = ArmCondition(held="protective stop: find what the arm ran into, then enable it on the pendant")


def guided(seen: DetectionStatus) -> StationStatus:
    """By hand, while the camera sees this."""
    guidance = GuidanceStatus(outline=((0.0, 0.0), (1.0, 1.0)), words="Closer")
    return msgspec.structs.replace(idle(StationState.FREE_DRIVE), detection=seen, guidance=guidance)


CASES = [
    (Known(), ""),
    (Known(idle(), silent_s=3.0), ""),
    (Known(idle(), busy="Planning"), ""),
    (Known(gone="nobody serves there"), ""),
    (Known(idle(), gone="nobody serves there"), "Ctrl-Q"),
    (Known(idle(StationState.STOPPED)), "F8"),
    (Known(idle(StationState.FAULT)), "F8"),
    (Known(idle(StationState.DISCONNECTED)), "1"),
    (Known(idle(StationState.CHECKING)), ""),
    (Known(idle(StationState.MOVING)), ""),
    (Known(idle(StationState.SEALING)), ""),
    (Known(idle(StationState.PAUSED)), "F5"),
    (Known(in_session(idle(StationState.PAUSED), poses=(PoseStatus(0, "hand-01", "done"),))), "F7"),
    (Known(idle(StationState.FREE_DRIVE)), "F2"),
    (Known(with_robot(idle(StationState.IDLE), condition=HELD)), ""),
    (Known(with_robot(idle(StationState.PAUSED), condition=HELD)), ""),
    (Known(idle(), (Check("camera", "failed", "none", "plug it in"),)), "1"),
    (Known(in_session(idle(), poses=())), "F5"),
    (Known(in_session(idle(), name="")), "F5"),
    (Known(in_session(idle(), recording="/r", captured=25)), "F9"),
    (Known(in_session(idle(), recording="/r", captured=0)), "F5"),
    (Known(with_robot(in_session(idle(), recording="/r", captured=2), by_hand=True)), "F3"),
    (Known(after_check(idle())), DIGITS["sessions"]),
    (Known(after_check(in_session(idle(), recording="/r"))), DIGITS["sessions"]),
    (Known(after_check(idle(), captured=0)), "F5"),
]


@pytest.mark.parametrize(("known", "key"), CASES)
def test_every_state_has_one_next_action(known: Known, key: str) -> None:
    assert next_action(known).on("capture").key == key


def test_a_key_of_another_screen_becomes_the_way_there() -> None:
    action = next_action(Known(after_check(idle())))
    assert (action.on("sessions").key, action.on("capture").key) == ("k", DIGITS["sessions"])
    lost = next_action(Known(idle(StationState.DISCONNECTED)))
    assert (lost.on("connect").key, lost.on("capture").key) == ("", DIGITS["connect"])
    assert next_action(Known(guided(DetectionStatus(cause=NO_IMAGE)))).look, "the board is not to blame"


@pytest.mark.parametrize("known", [known for known, _ in CASES])
@pytest.mark.parametrize("width", [70, 100, 140])
def test_rail_names_every_step_and_marks_one_now(known: Known, width: int) -> None:
    made = steps(known)
    assert [step.mode for step in made] == ["connect", "plan", "capture", "result"]
    line = rail_line(made, "plan", width)
    assert max(len(row) for row in line.plain.split("\n")) <= width
    assert all(step.mode.title() in line.plain for step in made)
    latched = known.status is not None and known.status.state in (StationState.STOPPED, StationState.FAULT)
    assert sum(step.mark == "stopped" for step in made) == latched
    backs = [line.plain[span.start : span.end] for span in line.spans if " on $" in str(span.style)]
    assert backs and all("Plan" in text or text.strip() == made[1].text for text in backs), "marked once"


@given(
    width=st.integers(40, 200),
    model=st.text(alphabet="UR10e x", max_size=60),
    safety=st.sampled_from(["", "NORMAL", "PROTECTIVE STOP", "ROBOT EMERGENCY STOP"]),
    state=st.sampled_from(list(StationState)),
)
def test_the_bar_fits_and_keeps_state_and_simulated_first(
    width: int, model: str, safety: str, state: StationState
) -> None:
    robot = RobotStatus(RobotIdentity(model), make_state(0), ArmCondition(safety=safety), remote=True)
    status = msgspec.structs.replace(
        idle(state),
        robot=robot,
        recorder=RecorderStatus(free_bytes=10**11),
        lease=LeaseStatus("anna on tty1", 7),
    )
    line = bar_line(Known(status), "Capture", width).plain
    assert len(line) <= width
    assert line.startswith(" Capture ")
    assert ("▲ NO ROBOT" in line) == (state is StationState.DISCONNECTED)
    assert "SIMULATED" in line


def test_who_lost_the_daemon_in_a_session_reads_how_many_poses_are_safe() -> None:
    unfinished = in_session(idle(StationState.MOVING), captured=12)
    assert "12 poses are safe" in next_action(Known(unfinished, gone="nobody serves there")).why
    for done in ({"recording": "/r", "captured": 12}, {"captured": 0}, {"name": "", "captured": 0}):
        status = in_session(idle(), **done)
        assert "safe" not in next_action(Known(status, gone="nobody serves there")).why


@pytest.mark.parametrize("width", [60, 80, 160])
@pytest.mark.parametrize("state", [StationState.IDLE, StationState.DISCONNECTED, StationState.MOVING])
def test_the_bar_says_not_accepted_on_the_smallest_screen(width: int, state: StationState) -> None:
    status = with_robot(idle(state), not_accepted="not accepted: its stops were never tested")
    status = msgspec.structs.replace(status, source="real")
    assert "not accepted" in bar_line(Known(status), "Connect", width).plain


@given(why=st.text(alphabet="abc ü…°", max_size=300), look=st.booleans(), width=st.integers(60, 160))
def test_what_a_person_should_look_at_is_never_cut(why: str, look: bool, width: int) -> None:
    line = next_line(Action("F8", "Acknowledge", why, look=look), width).plain
    assert " F8  Acknowledge " in line
    assert why in line if look else len(line) <= width


WINDOWS = [
    lambda: Confirm("Finish?", "words", "Finish"),
    lambda: ConfirmMotion(SUMMARY),
    lambda: Reason("Not installed", "a gate failed"),
]


@pytest.mark.parametrize(("size", "theme"), list(zip(SIZES, ("station-dark", "terminal"), strict=True)))
async def test_stop_stands_whole_on_every_screen_and_question(
    link: FakeLink, size: tuple[int, int], theme: str
) -> None:
    link.answers["doctor"] = []
    async with opened(link, size) as pilot:
        pilot.app.theme = theme

        def whole(screen: Screen[object]) -> bool:
            if not screen.query(StopBlock):
                return False  # not composed yet
            block = screen.query_one(StopBlock)
            words = str(block.render())
            return (
                "STOP" in words
                and "F12" in words
                and block.region.right == size[0]
                and block.region.y == 0
                and block.region.height >= 3
                and block.region.width >= len(words)
                and screen.get_widget_at(size[0] - 3, 1)[0] is block
            )

        for stops, key in enumerate(DIGITS.values(), start=1):
            await pilot.press(key)
            await until(pilot, lambda: whole(pilot.app.screen))
            await pilot.press("f12")
            await until(pilot, lambda stops=stops: link.verbs.count("stop") == stops)
            drawn = pilot.app.screen._compositor.render_strips()
            assert any("SIMULATED" in strip.text for strip in drawn)
            assert str(pilot.app.screen.query_one("#bar").render()).split()[0].lower() in DIGITS
        await pilot.click("#rail", offset=(2, 0))
        await until(pilot, lambda: pilot.app.current_mode == "connect")
        for window in WINDOWS:
            pilot.app.push_screen(window())
            await until(pilot, lambda: whole(pilot.app.screen))
            assert "SIMULATED" in text_of(pilot.app, "#bar")
            stops = link.verbs.count("stop")
            await pilot.click(StopBlock)
            await until(pilot, lambda stops=stops: link.verbs.count("stop") == stops + 1)
            link.show(idle(StationState.STOPPED))  # what is known goes on while a question is open
            await until(pilot, lambda: "STOPPED" in text_of(pilot.app, "#bar"))
            assert pilot.app.screen.query_one(StopBlock).latched
            link.show(idle())
            await until(pilot, lambda: "IDLE" in text_of(pilot.app, "#bar"))
            if isinstance(pilot.app.screen, Question):  # STOP made the approval of a motion useless
                await pilot.app.pop_screen()


@pytest.mark.parametrize("state", [StationState.IDLE, StationState.PAUSED])
@pytest.mark.parametrize("session", [{}, {"captured": 3}])
def test_no_step_asks_a_person_who_moves_the_arm_to_let_it_move(
    state: StationState, session: dict[str, object]
) -> None:
    status = in_session(idle(state), **session)
    assert next_action(Known(with_robot(status, by_hand=True))).key == "F3"
    assert next_action(Known(status)).key in ("F5", "n")


@pytest.mark.parametrize("size", SIZES)
async def test_the_screens_have_no_stop_for_an_arm_that_a_person_moves(
    link: FakeLink, size: tuple[int, int]
) -> None:
    link.show(with_robot(idle(), by_hand=True))
    async with opened(link, size, notifications=True) as pilot:
        block = pilot.app.screen.query_one(StopBlock)
        words = str(block.render())
        assert "pendant" in words and "F12" not in words
        assert max(map(len, words.splitlines())) <= block.size.width and words.count("\n") < block.size.height
        await pilot.click(StopBlock)
        assert "stop" not in link.verbs
        await pilot.press("f12")  # the daemon answers whose STOP it is
        await until(pilot, lambda: "stop" in link.verbs)
        link.show(None)  # what arm the next daemon has is not known: STOP is for it, too
        await until(pilot, lambda: pilot.app.known.live is None)
        await pilot.press("f12")
        await until(pilot, lambda: link.send_stop() in said(pilot))


async def test_without_colours_stop_and_chips_are_reversed(
    link: FakeLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    async with opened(link) as pilot:
        strips = pilot.app.screen._compositor.render_strips()
        for filter_ in pilot.app._filters:
            strips = [strip.apply_filter(filter_, pilot.app.background_colors[1]) for strip in strips]
        reversed_ = "".join(s.text for strip in strips for s in strip if s.style and s.style.reverse)
        assert "STOP F12" in reversed_ and "SIMULATED" in reversed_
        assert all(s.style is None or s.style.color is None for strip in strips for s in strip)
