"""The always-visible line: who the robot is, how fast, how safe, how far, and the STOP key."""

from __future__ import annotations

from rich.text import Text
from textual.reactive import reactive
from textual.widgets import Static

from station.cell.status import StationState, StationStatus
from station.protocol.states import RUNNING
from station.tui.words import STATE_WORDS, duration, size

_ALARM = {StationState.STOPPED, StationState.FAULT, StationState.DISCONNECTED}
STOP_KEY = "F12=STOP"
LEVELS = 6
DRIVEN_BY = {"ur_rtde": "by ur_rtde", "script": "by own script"}
"""What drives the arm. The own script, not yet accepted on a real arm, stays longer as the line narrows."""
_NEXT = {
    StationState.STOPPED: "F8 acknowledges",
    StationState.FAULT: "F8 acknowledges",
    StationState.PAUSED: "F5 continues, F7 finishes",
    StationState.FREE_DRIVE: "F2 captures an image here, F3 ends it",
}
"""The next key by state. The daemon's own sentence is for shells too."""
_AT_REST = {StationState.IDLE, StationState.PAUSED, StationState.FREE_DRIVE}
NO_DAEMON = " NO DAEMON: trying again every second. To stop the arm use the pendant."

NO_ANSWER = " NO ANSWER for {:.0f} s: state UNKNOWN. To stop the arm: EMERGENCY STOP."


class StatusBar(Static):
    """One line, as full as its width allows; the STOP key is the last thing to be left out: never."""

    status: reactive[StationStatus | None] = reactive(None)
    silent_s: reactive[float | None] = reactive(None)

    def watch_status(self) -> None:
        status, silent = self.status, self.silent_s is not None
        self.set_class(silent or status is None or status.state in _ALARM, "alarm")
        waits = status is not None and (status.state is StationState.PAUSED or bool(status.robot.held))
        self.set_class(waits and not silent, "warn")
        self.refresh()

    def watch_silent_s(self) -> None:
        self.watch_status()

    def render(self) -> Text:
        if self.silent_s is not None:
            line = NO_ANSWER.format(self.silent_s)
        elif self.status is None:
            line = NO_DAEMON
        else:
            line = bar_line(self.status, self.size.width)
        return Text(line, no_wrap=True, overflow="ellipsis")


def bar_line(status: StationStatus, width: int) -> str:
    """The fullest line that fits `width` cells: less important parts go first, then names are cut."""
    for level in range(LEVELS):
        line = _line(_parts(status, level))
        if len(line) + len(STOP_KEY) <= width:
            return line.ljust(width - len(STOP_KEY)) + STOP_KEY
    who, *rest = _parts(status, LEVELS - 1)
    room = width - len(_line(rest)) - len(STOP_KEY) - 1
    line = _line([who[: max(0, room - 1)] + "…", *rest])
    return line[: max(0, width - len(STOP_KEY))] + STOP_KEY


def _line(parts: list[str]) -> str:
    return " " + "".join(part + "│" for part in parts)


def _parts(status: StationStatus, level: int) -> list[str]:
    """`level` 0 has everything; every level leaves something out."""
    robot, session = status.robot, status.session
    simulated = ["SIMULATED"] if status.simulated else []
    who = [*simulated, robot.model or "no robot"]
    count = f"{session.captured}/{len(session.poses)}"
    progress = count if level >= 2 else f"{count} {duration(session.elapsed_s)}"
    if status.playback:  # a recorded arm has no speed and no safety that anybody must look at
        parts = [" ".join(["PLAYBACK, no live arm:", STATE_WORDS[status.state], *who]), progress]
    else:
        limit = f"/{robot.speed_limit_m_s:.2f}" if level < 4 else ""
        where = {True: "REMOTE", False: "LOCAL", None: ""}[robot.remote]
        parts = [
            " ".join([STATE_WORDS[status.state], *who]),
            *([f"{robot.speed_m_s:.2f}{limit} m/s"] if level < LEVELS - 1 else []),
            " ".join(p for p in (robot.safety or "-", where) if p),
            progress,
        ]
        if robot.control_path and level < (4 if robot.control_path == "script" else 1):
            parts.append(DRIVEN_BY[robot.control_path])
    if level < 3 and status.recorder.free_bytes is not None:
        parts.append(size(status.recorder.free_bytes) + " free" * (level < 1))
    if level < 1 and status.lease.holder:
        parts.append(f"control: {status.lease.holder}")
    return parts


def said_of(status: StationStatus) -> str:
    """Reason of a standstill, what comes next by itself, and the next key."""
    held, next_key = "", _NEXT.get(status.state, "")
    if status.state in _AT_REST and status.robot.held:  # elsewhere the reason says it
        held, next_key = status.robot.held, next_key and f"then {next_key}"
    return " │ ".join(words for words in (status.reason, status.pending, held, next_key) if words)


def _is_well(status: StationStatus) -> bool:
    at_ease = status.state is StationState.IDLE and not status.robot.held
    return at_ease or (status.state in RUNNING and not status.reason)


class ReasonLine(Static):
    """The reason of a standstill in a sentence, with what to do; hidden while all is well."""

    status: reactive[StationStatus | None] = reactive(None)
    trouble: reactive[str] = reactive("")
    """Stands before what the daemon said last."""
    busy: reactive[str] = reactive("")
    """Long work that was asked for here."""
    _reason = ""

    def watch_trouble(self) -> None:
        self.watch_status()

    def watch_busy(self) -> None:
        self.watch_status()

    def watch_status(self) -> None:
        said = ""
        if self.status is not None and not self.trouble:
            said = said_of(self.status)
        # A playback has no trouble, and a cell at rest or at work neither: the line only tells.
        calm = self.status is None or self.status.playback or _is_well(self.status)
        self.set_class(calm and not self.trouble, "note")
        told = "\n".join(words for words in (self.trouble, self.busy, said) if words)
        if told != self._reason:
            self._reason = told
            self.display = bool(told)
            self.update(Text(told, overflow="fold"))
