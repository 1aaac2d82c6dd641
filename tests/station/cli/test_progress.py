"""What a terminal is told about a session: what is new, once."""

from __future__ import annotations

import io

from rich.console import Console

from station.cell.status import Event, StationStatus
from station.cli.attended import SessionProgress


def test_what_happened_before_the_session_is_not_said_again():
    words = io.StringIO()
    earlier, later = Event(1, "info", "sealed"), Event(2, "info", "go by ann")
    with SessionProgress(Console(file=words), quiet=False) as progress:
        progress.skip(StationStatus(events=(earlier,)))
        progress(StationStatus(events=(earlier, later)))
    assert "go by ann" in words.getvalue()
    assert "sealed" not in words.getvalue()
