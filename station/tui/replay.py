"""A recording in place of a daemon: it shows itself, and nothing can be commanded."""

from __future__ import annotations

import asyncio
import base64
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from calibrate.boards.detect import Detection, detect
from recordings.errors import RecordingError
from recordings.schema.messages import View
from station.cell.errors import RefusedError, StationError
from station.cell.status import DetectionStatus, StationStatus
from station.tui.timeline import END_TEXT, Timeline
from station.tui.words import duration

STEP_S = 0.1
KEYS_TEXT = "space pauses, left/right: picture, PgUp/PgDn: 10 s, Home: start"
JPEG_QUALITY = 80


class ReplayLink:
    """`station.tui.link.Link` over a recording, at the pace in which it was recorded.

    StationError for a recording that cannot be read.
    """

    root: Path | None = None

    def __init__(self, path: Path, pace: float = 1.0) -> None:
        try:
            self._timeline = Timeline(path)
        except RecordingError as error:
            raise StationError(f"{path} cannot be replayed: {error}") from error
        self._path, self._pace = path, pace
        self._at_s = 0.0
        self.paused = False
        self._status = self._timeline.status(0.0)
        self._seen = DetectionStatus()
        self._shown: View | None = None
        self._answer: dict[str, Any] | None = None
        self._closed = False

    async def request(self, verb: str, **args: Any) -> Any:
        """Looking is answered; RefusedError for everything else."""
        if verb == "preview":
            return await self._preview(int(args["width"]), int(args["height"]))
        if verb == "sessions":
            return []
        raise RefusedError(
            f"{verb.replace('_', ' ')}: this is the PLAYBACK of {self._path.name}; nothing can be commanded"
        )

    async def statuses(self) -> AsyncIterator[StationStatus]:
        """Until the end, which stays on the screen."""
        seen_s = time.monotonic()
        while not self._closed:
            now_s = time.monotonic()
            if not self.paused:
                self.seek((now_s - seen_s) * self._pace)
            seen_s = now_s
            self._status = await asyncio.to_thread(self._timeline.status, self._at_s)
            yield msgspec.structs.replace(self._status, detection=self._seen, reason=self._where())
            await asyncio.sleep(STEP_S)

    async def close(self) -> None:
        self._closed = True

    def toggle(self) -> None:
        """Pause or go on; from the end once more from the start."""
        if self.ended:
            self._at_s, self.paused = 0.0, False
        else:
            self.paused = not self.paused

    def seek(self, by_s: float) -> None:
        self._at_s = min(max(0.0, self._at_s + by_s), self._timeline.duration_s)

    def step(self, by: int) -> None:
        """To the next picture (1) or the one before (-1), and stay there."""
        self.paused = True
        self._at_s = self._timeline.picture_s(self._at_s, by)

    @property
    def ended(self) -> bool:
        return self._at_s >= self._timeline.duration_s

    def _where(self) -> str:
        how = END_TEXT if self.ended else "paused" if self.paused else "playing"
        return f"{duration(self._at_s)} of {duration(self._timeline.duration_s)} {how} │ {KEYS_TEXT}"

    async def _preview(self, width: int, height: int) -> dict[str, Any] | None:
        timeline = self._timeline
        view = timeline.view_at(self._status.session.elapsed_s) or next(iter(timeline.views), None)
        if view is None:
            return None
        if view is not self._shown:
            self._answer = await asyncio.to_thread(self._look, view, width, height)
            self._shown = view
        return self._answer

    def _look(self, view: View, width: int, height: int) -> dict[str, Any] | None:
        try:
            image = self._timeline.recording.image(view).pixels
        except RecordingError as error:
            self._seen = DetectionStatus(reason=str(error))
            return None
        seen = detect(image, self._timeline.recording.info.board, thorough=False)
        self._seen = _detection_status(seen)
        if image.dtype != np.uint8:
            image = (image >> 8).astype(np.uint8)
        rows, columns = image.shape[:2]
        scale = min(width / columns, height / rows, 1.0)
        size = (round(columns * scale), round(rows * scale))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
        corners = ((seen.pixels + 0.5) / (columns, rows)).tolist() if seen.found else []
        return {
            "jpeg_base64": base64.b64encode(jpeg).decode(),
            "corners": corners,
            "sequence": view.picture_sequence,
        }


def _detection_status(seen: Detection) -> DetectionStatus:
    return DetectionStatus(
        found=seen.found,
        reason=seen.reason,
        corners=len(seen.pixels),
        expected=seen.expected,
        sharpness=round(float(seen.sharpness), 4),
        saturated=round(float(seen.saturated), 4),
        coverage=round(float(seen.coverage), 4),
    )
