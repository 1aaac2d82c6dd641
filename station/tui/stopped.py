"""The card over the capture while STOP or a fault is latched: what happened, and the way on."""

from __future__ import annotations

from textual.content import Content
from textual.widgets import Static

from station.cell.status import StationStatus
from station.protocol.states import LATCHED
from station.tui.task import Known
from station.tui.words import UNKNOWN, lines, mark, sentence

STOPPED_BY = {
    "protective-stop": "The robot stopped itself (protective stop): it probably touched something.",
    "emergency-stop": "An emergency stop is pressed.",
    "safeguard-stop": "A guard or a scanner stopped the arm.",
}
"""What happened, by the cause of a stop that is cleared at the pendant."""


class Stopped(Static):
    """Over the capture while STOP or a fault is latched: what happened, and the way on in three steps."""

    def show(self, known: Known) -> None:
        status = known.live
        latched = status is not None and status.state in LATCHED and not known.old
        self.display = latched
        if status is None or not latched:
            return
        self.border_title = f"■ {status.state.value.upper()}"
        self.border_subtitle = "latched until F8"
        self.update(stopped_text(status))


def stopped_text(status: StationStatus) -> Content:
    session, robot = status.session, status.robot
    saved = f"{session.captured} of {len(session.poses)} poses are saved."
    if not session.poses:
        saved = "No session was running."
    held, told = robot.condition.held, robot.condition.safety
    pendant = mark("look", held) if held else mark("done", "nothing to clear there") if told else Content()
    if not held:
        pendant = Content.assemble(("safety ", "$dim"), (told or UNKNOWN, "bold $strong"), "  ", pendant)
    rests = " If the arm moves, press the emergency stop."  # its news may be old
    if robot.connected and not robot.by_hand and status.cause in ("stop", *STOPPED_BY):
        rests = " The arm stands still." if robot.still else " The arm is told to stop."
    return lines(
        Content.styled(f"{STOPPED_BY.get(status.cause, sentence(status.reason))}{rests}", "bold $strong"),
        Content(""),
        Content(saved),
        Content(""),
        Content.assemble(
            (" 1  ", "bold $strong"),
            ("Look at the cell. ", "bold"),
            "Is anybody in reach? Was anything touched?",
        ),
        Content.assemble((" 2  ", "bold $strong"), ("At the pendant: ", "bold"), pendant),
        Content.assemble(
            (" 3  ", "bold $strong"),
            (" F8  Acknowledge ", "bold $onaccent on $warn"),
            (f"  Nothing moves. {'F3 then goes on' if robot.by_hand else 'F5 then asks again'}.", "$dim"),
        ),
    )
