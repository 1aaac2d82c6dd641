"""The station's log, also inside the recording: what the programs said stays with what they did."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable

from recordings.errors import RecordingError
from recordings.schema.messages import CaptureEvent
from station.session.recording import SessionRecording, stamps_now

_LEVELS = ((logging.ERROR, "error"), (logging.WARNING, "warning"), (logging.INFO, "info"))
_TEXT_LIMIT = 2000


class Logbook(logging.Handler):
    """Attach it to the logger `station`. Events for people reach the recording by their own way."""

    def __init__(self, recording: Callable[[], SessionRecording | None]) -> None:
        super().__init__(logging.INFO)
        self._recording = recording

    def emit(self, record: logging.LogRecord) -> None:
        """From any thread; never raises, a log must not harm what it describes."""
        recording = self._recording()
        recorder = recording.recorder if recording is not None else None
        if recorder is None or record.name == "station.events":
            return
        level = next((word for number, word in _LEVELS if record.levelno >= number), "debug")
        text = f"{record.name}: {record.getMessage()}"[:_TEXT_LIMIT]
        with contextlib.suppress(RecordingError):
            recorder.event(CaptureEvent(stamps_now(), "log", detail=text, level=level))  # type: ignore[arg-type]
