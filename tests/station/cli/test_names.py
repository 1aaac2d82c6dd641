"""Names that look like rich's markup are printed as they are: brackets and colons belong to the name."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from station.cell.status import Event, PoseStatus, SessionStatus, StationStatus
from station.cli import main, requests
from station.cli.session import session_progress
from station.protocol.verbs import Check
from tests.command_line import call

NAMES = ("[red]x[/]", "[/]", "a :bug: [bold]", "end\\")
ALL = " ".join(NAMES)


def test_what_the_daemon_tells(monkeypatch: pytest.MonkeyPatch) -> None:
    session = SessionStatus(name=ALL, recording=f"/sessions/{ALL}", poses=(PoseStatus(0, "[/]"),))
    status = StationStatus(reason=ALL, session=session)
    monkeypatch.setattr(requests, "status_of", lambda socket: status)
    said = call(main, "status").stdout
    assert said.count(ALL) == 3
    checks = [Check("[/]", "failed", "[red]x[/]", "[/]")]
    monkeypatch.setattr(requests, "ask", lambda socket, verb: checks)
    said = call(main, "doctor").stdout
    assert "MISSING" in said and "[red]x[/]" in said and "→ [/]" in said


def test_events_of_a_session() -> None:
    words = io.StringIO()
    earlier, later = Event(1, "info", "sealed"), Event(2, "warning", f"event {ALL}")
    before = StationStatus(events=(earlier,))
    with session_progress(Console(file=words, width=200), False, before) as show:
        show(StationStatus(events=(earlier, later)))
    assert "sealed" not in words.getvalue(), "it was told before the session"
    assert f"event {ALL}" in words.getvalue()
