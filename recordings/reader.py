"""Opens a recording: one file, or a session folder whose parts belong together."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from recordings.errors import CorruptRecordingError, RecordingError, UnsealedRecordingError
from recordings.files import EMPTY_SUFFIX, PART_SUFFIX
from recordings.messages import CaptureEvent, Picture, RobotState, SessionInfo, View
from recordings.part import RecordingPart

PARTS_LIMIT = 100


class Recording:
    """A proven recording. Iterators raise CorruptRecordingError at a message wrong in itself."""

    def __init__(self, path: Path, parts: list[RecordingPart]) -> None:
        self.path = path
        self.parts = parts
        """In the order they were recorded."""
        self._by_number = {part.info.part: part for part in parts}

    @property
    def info(self) -> SessionInfo:
        """Of the first part."""
        return self.parts[0].info

    @property
    def sha256(self) -> str:
        """Of the file; of the parts' hashes, one after the other, when there are several."""
        if len(self.parts) == 1:
            return self.parts[0].sha256
        return hashlib.sha256("".join(part.sha256 for part in self.parts).encode()).hexdigest()

    def views(self) -> list[View]:
        """The latest attempt of every pose, in the order of their index."""
        latest: dict[int, View] = {}
        for view in chain.from_iterable(part.views for part in self.parts):
            before = latest.get(view.index)
            if before is None or (view.part, view.attempt) >= (before.part, before.attempt):
                latest[view.index] = view
        return [latest[index] for index in sorted(latest)]

    def picture(self, view: View) -> Picture:
        """The view's picture; its array is read-only."""
        try:
            return self._by_number[view.part].picture(view.picture_sequence)
        except KeyError as error:
            raise RecordingError(f"{self.path} has no picture for view {view.index}") from error

    def stored_picture(self, view: View) -> tuple[str, bytes] | None:
        """(format, file bytes) of a picture that is kept compressed; None when it is kept raw."""
        return self._by_number[view.part].stored_picture(view.picture_sequence)

    def pictures(self) -> Iterator[tuple[View, Picture]]:
        """One at a time, in the order of `views`."""
        for view in self.views():
            yield view, self.picture(view)

    def robot_states(self) -> Iterator[RobotState]:
        return chain.from_iterable(part.robot_states() for part in self.parts)

    def events(self) -> Iterator[CaptureEvent]:
        return chain.from_iterable(part.events() for part in self.parts)

    def attachments(self) -> dict[str, bytes]:
        """Of all parts; the latest part's where a name is in several."""
        merged: dict[str, bytes] = {}
        for part in self.parts:
            merged.update(part.attachments)
        return merged

    def media_types(self) -> dict[str, str]:
        """Of the attachments."""
        return {name: kind for part in self.parts for name, kind in part.media_types.items()}


def open_recording(path: Path) -> Recording:
    """Reads and proves the whole recording. At most 256 MiB of memory, whatever the file says.

    Raises UnsealedRecordingError for one that was never finished or is cut, CorruptRecordingError for one
    that breaks a rule of the format, RecordingError when there is none.
    """
    path = Path(path)
    if not path.is_dir():
        unfinished = path if path.name.endswith(PART_SUFFIX) else path.with_name(path.name + PART_SUFFIX)
        if unfinished.is_file() and (unfinished == path or not path.exists()):
            raise UnsealedRecordingError(
                f"{path} was never finished. Save what is whole: recordings recover {unfinished}"
            )
        return Recording(path, [RecordingPart(path)])
    return Recording(path, _open_parts(path))


def _open_parts(folder: Path) -> list[RecordingPart]:
    names = sorted(entry.name for entry in folder.iterdir())
    unsealed = [name for name in names if name.endswith(".mcap" + PART_SUFFIX)]
    if unsealed:
        raise UnsealedRecordingError(
            f"{folder / unsealed[0]} was never finished. Save what is whole: recordings recover {folder}"
        )
    files = [name for name in names if name.endswith(".mcap")]
    if not files:
        raise RecordingError(f"{folder} holds no recording (*.mcap)")
    if len(files) > PARTS_LIMIT:
        raise RecordingError(
            f"{folder} holds {len(files)} recordings: name one of them, or one session's folder"
        )
    parts = sorted((RecordingPart(folder / name) for name in files), key=lambda part: part.info.part)
    _check_one_session(folder, parts, sum(f".part{EMPTY_SUFFIX}" in name for name in names))
    return parts


def _check_one_session(folder: Path, parts: list[RecordingPart], set_aside: int) -> None:
    """The parts are of one session and none is missing, but for as many as recovery found empty."""
    first = parts[0].info
    for before, part in zip([None, *parts], parts, strict=False):
        info = part.info
        if (info.name, info.mount, info.board, info.source) != (
            first.name,
            first.mount,
            first.board,
            first.source,
        ):
            raise RecordingError(
                f"{part.path} and {parts[0].path} are of different sessions: name one of them, not the folder"
            )
        if info.camera != first.camera or info.camera_identity.serial != first.camera_identity.serial:
            raise RecordingError(f"{part.path} was recorded with another camera than {parts[0].path}")
        set_aside -= info.part - 1 - (before.info.part if before else 0)
        if set_aside < 0:
            raise CorruptRecordingError(f"a part before {part.path} of session '{first.name}' is missing")
        if before and before.info.part == info.part:
            raise CorruptRecordingError(f"{before.path} and {part.path} are both part {info.part}")
