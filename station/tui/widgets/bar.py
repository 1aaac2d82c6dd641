"""The always-visible line: who the robot is, how fast, how safe, how far, and the STOP key."""

from __future__ import annotations

from rich.text import Text
from textual.reactive import reactive
from textual.widgets import Static

from station.status import StationState, StationStatus
from station.tui.words import STATE_WORDS, duration, size

_ALARM = {StationState.STOPPED, StationState.FAULT, StationState.DISCONNECTED}


class StatusBar(Static):
    """First line: identity and health. Second line: why it stopped and what to do, when it did."""

    status: reactive[StationStatus | None] = reactive(None)

    def watch_status(self, status: StationStatus | None) -> None:
        if status is None:
            self.set_class(True, "alarm")
            self.update(Text("no connection to the daemon: trying again every second", no_wrap=True))
            return
        self.set_class(status.state in _ALARM, "alarm")
        self.set_class(status.state is StationState.PAUSED, "warn")
        self.update(Text(self.first_line(status), no_wrap=True, overflow="ellipsis"))

    @staticmethod
    def first_line(status: StationStatus) -> str:
        robot, session = status.robot, status.session
        marks = [m for m, on in (("SIMULATED", status.simulated), ("PLAYBACK", status.playback)) if on]
        who = " ".join([*marks, robot.model or "no robot"])
        speed = f"{robot.speed_m_s:.2f}/{robot.speed_limit_m_s:.2f} m/s"
        where = {True: "REMOTE", False: "LOCAL", None: ""}[robot.remote]
        state = STATE_WORDS[status.state]
        safety = robot.safety or "-"
        count = f"{session.captured}/{len(session.poses)} {duration(session.elapsed_s)}"
        disk = size(status.recorder.free_bytes)
        parts = [f"{state} {who}", speed, " ".join(p for p in (safety, where) if p), count, disk, "F12=STOP"]
        return " " + "│".join(parts)


class ReasonLine(Static):
    """Why the station is not working, in a sentence, with what to do; hidden while all is well."""

    status: reactive[StationStatus | None] = reactive(None)

    def watch_status(self, status: StationStatus | None) -> None:
        reason = "" if status is None else status.reason
        self.display = bool(reason)
        self.update(Text(" " + reason, overflow="fold"))
