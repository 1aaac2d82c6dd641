"""Opens a recording: one file, or a session folder whose parts belong together."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from recordings.errors import MissingSegmentError, RecordingError, UnfinishedRecordingError, recover_line
from recordings.files import PART_SUFFIX
from recordings.schema.messages import CaptureEvent, Image, RobotState, SessionInfo, View
from recordings.segment import RecordingSegment
from recordings.session_parts import parts_of_file, parts_of_folder


class Recording:
    """A proven recording. Iterators raise CorruptRecordingError at a message wrong in itself."""

    def __init__(
        self,
        path: Path,
        segments: list[RecordingSegment],
        missing: tuple[str, ...] = (),
        losses: tuple[str, ...] = (),
    ) -> None:
        self.path = path
        self.segments = segments
        """In the order they were recorded."""
        self.missing = missing
        """A sentence for each part of the session that should be there and is not."""
        self.losses = losses
        """A sentence for everything that recovery could not save, or that nobody can rule out."""
        self._by_number = {part.info.part: part for part in segments}

    @property
    def info(self) -> SessionInfo:
        """Of the first part."""
        return self.segments[0].info

    @property
    def sha256(self) -> str:
        """Of the file; of the parts' hashes, one after the other, when there are several."""
        if len(self.segments) == 1:
            return self.segments[0].sha256
        return hashlib.sha256("".join(part.sha256 for part in self.segments).encode()).hexdigest()

    def views(self) -> list[View]:
        """The latest attempt of every pose, in the order of their index."""
        latest: dict[int, View] = {}
        for view in chain.from_iterable(part.views for part in self.segments):
            before = latest.get(view.index)
            if before is None or (view.part, view.attempt) >= (before.part, before.attempt):
                latest[view.index] = view
        return [latest[index] for index in sorted(latest)]

    def image(self, view: View) -> Image:
        """The view's picture; its array is read-only."""
        try:
            return self._by_number[view.part].image(view.picture_sequence)
        except KeyError as error:
            raise RecordingError(f"{self.path} has no picture for view {view.index}") from error

    def stored_image(self, view: View) -> tuple[str, bytes] | None:
        """(format, file bytes) of a picture that is kept compressed; None when it is kept raw."""
        return self._by_number[view.part].stored_image(view.picture_sequence)

    def images(self) -> Iterator[tuple[View, Image]]:
        """One at a time, in the order of `views`."""
        for view in self.views():
            yield view, self.image(view)

    def robot_states(self) -> Iterator[RobotState]:
        return chain.from_iterable(part.robot_states() for part in self.segments)

    def events(self) -> Iterator[CaptureEvent]:
        return chain.from_iterable(part.events() for part in self.segments)

    def attachments(self) -> dict[str, bytes]:
        """Of all parts; the latest part's where a name is in several."""
        merged: dict[str, bytes] = {}
        for part in self.segments:
            merged.update(part.attachments)
        return merged

    def media_types(self) -> dict[str, str]:
        """Of the attachments."""
        return {name: kind for part in self.segments for name, kind in part.media_types.items()}


def open_recording(path: Path, *, incomplete: bool = False) -> Recording:
    """Reads and proves the whole recording. At most 256 MiB of memory, whatever the file says.

    Raises UnfinishedRecordingError for one that was never finished or is cut, CorruptRecordingError for one
    that breaks a rule of the format, MissingSegmentError when parts of the session are not there (unless
    `incomplete`: then `missing` names them), RecordingError when there is none.
    """
    path = Path(path)
    if path.is_dir():
        found = parts_of_folder(path)
        remedy = f"Copy it back beside the others; if it is lost for good: {recover_line(path)}"
    else:
        _require_finished(path)
        found = parts_of_file(path)
        remedy = f"If the other parts are lost for good: {recover_line(path.parent)}"
    if found.missing and not incomplete:
        raise MissingSegmentError(f"{'; '.join(found.missing)}. {remedy}")
    return Recording(path, found.parts, found.missing, found.losses)


def _require_finished(path: Path) -> None:
    unfinished = path if path.name.endswith(PART_SUFFIX) else path.with_name(path.name + PART_SUFFIX)
    if unfinished.is_file() and (unfinished == path or not path.exists()):
        raise UnfinishedRecordingError(
            f"{path} was never finished. Save what is whole: {recover_line(unfinished)}"
        )
