"""Rebuilds a recording that was never finished, is cut or damaged, from what is proven whole in it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import msgspec

from recordings.errors import CorruptRecordingError, RecordingError, UnfinishedRecordingError
from recordings.files import EMPTY_SUFFIX, PART_SUFFIX, discard_leftover, lock, rename_new, sync_folder
from recordings.manifest import MANIFEST_FILE, give_up_parts, missing_parts, read_manifest
from recordings.mcap.scan import open_file
from recordings.rebuild import NothingToSaveError, rebuild
from recordings.schema.messages import SessionInfo
from recordings.schema.topics import Topic
from recordings.segment import RecordingSegment

DAMAGED_SUFFIX = ".damaged"


@dataclass(frozen=True)
class Recovery:
    """What was saved, and what was not."""

    path: Path
    kept_original: Path | None
    """Where the damaged file is now; None when there was nothing to repair."""
    poses: int
    pictures: int
    robot_states: int
    lost_bytes: int
    losses: tuple[str, ...] = ()

    @property
    def rebuilt(self) -> bool:
        return self.kept_original is not None

    @property
    def missing(self) -> bool:
        """A part of the session that is not there at all."""
        return bool(self.losses) and not self.rebuilt

    @property
    def text(self) -> str:
        """What became of the file, one line."""
        if self.missing:
            return f"{self.path}: {self.losses[0]}"
        if not self.rebuilt:
            return f"{self.path}: whole, nothing was lost ({self.poses} poses)"
        return (
            f"{self.path}: saved {self.poses} poses, {self.pictures} pictures and {self.robot_states} "
            f"robot states; {self.lost_bytes} bytes were lost"
        )


def recover(source: Path, output: Path | None = None) -> list[Recovery]:
    """A file, or every file of a session folder. The result is read back strictly before it gets its name.

    Without `output` the recovered file takes the recording's name and the damaged one is kept beside it as
    `.damaged`. Parts of the session that are not in its folder are given up: reported here, and named by
    every later reader. Raises RecordingError when another process still writes it or nothing can be saved.
    """
    if source.is_dir():
        if output is not None:
            raise RecordingError("a session folder is recovered in place; leave out the output")
        return _recover_session(source)
    return [_recover_file(source, output)[0]]


def _recover_session(folder: Path) -> list[Recovery]:
    try:
        files = sorted(p for p in folder.iterdir() if p.name.endswith((".mcap", ".mcap" + PART_SUFFIX)))
    except OSError as error:
        raise RecordingError(f"cannot open {folder}: {error.strerror}") from error
    if not files:
        raise RecordingError(f"{folder} holds no recording (*.mcap, *.mcap.part)")
    manifest = read_manifest(folder)
    done = [_recover_part(path) for path in files]
    present = {info.part: result.path.name for result, info in done if info is not None}
    sessions = {info.name for _, info in done if info is not None}
    results = [result for result, _ in done]
    if len(sessions) != 1:  # nothing is left, or files of several sessions: nobody knows whose parts lack
        return results
    session = sessions.pop()
    again = manifest and msgspec.structs.replace(manifest, given_up=[])  # said every time, not only the first
    missing = missing_parts(folder, again, set(present))
    if missing:
        give_up_parts(folder, session, present, missing)
    return [*results, *(_given_up(folder, part, name) for part, name in missing.items())]


def _given_up(folder: Path, part: int, name: str) -> Recovery:
    reason = (
        f"part {part} of the session is not in the folder; noted as lost in {MANIFEST_FILE}. "
        "Should it turn up, put it back here and it is read again"
    )
    return Recovery(folder / name, None, 0, 0, 0, 0, (reason,))


def _recover_part(source: Path) -> tuple[Recovery, SessionInfo | None]:
    """Of a session: a part that was begun but holds nothing is set aside, the session goes on without it."""
    try:
        return _recover_file(source, None)
    except NothingToSaveError as error:
        aside = _free_name(source.with_name(source.name + EMPTY_SUFFIX))
        rename_new(source, aside)
        return Recovery(source, aside, 0, 0, 0, aside.stat().st_size, (str(error),)), None


def _recover_file(source: Path, output: Path | None) -> tuple[Recovery, SessionInfo]:
    descriptor = open_file(source)
    try:
        lock(descriptor, source)
        final = output or source.with_name(source.name.removesuffix(PART_SUFFIX))
        if final.suffix != ".mcap":
            raise RecordingError(f"{final}: a recording's name ends in .mcap")
        if final != source and os.path.lexists(final):
            raise RecordingError(f"{final} exists already; name another output with -o")
        try:
            return _nothing_lost(RecordingSegment(source), source, final)
        except (UnfinishedRecordingError, CorruptRecordingError):
            return _rebuild(descriptor, source, final, in_place=output is None)
    finally:
        os.close(descriptor)


def _nothing_lost(part: RecordingSegment, source: Path, final: Path) -> tuple[Recovery, SessionInfo]:
    """A file that is whole; at most its last rename was missing."""
    if source.name.endswith(PART_SUFFIX):
        rename_new(source, final)
    else:
        final = source
    return _report(final, part, None, 0, ())


def _report(
    path: Path, part: RecordingSegment, original: Path | None, lost_bytes: int, losses: tuple[str, ...]
) -> tuple[Recovery, SessionInfo]:
    done = Recovery(
        path=path,
        kept_original=original,
        poses=len({view.index for view in part.views}),
        pictures=len(part.image_sequences()),
        robot_states=len(part.messages(Topic.ROBOT_STATE)),
        lost_bytes=lost_bytes,
        losses=losses,
    )
    return done, part.info


def _rebuild(descriptor: int, source: Path, final: Path, in_place: bool) -> tuple[Recovery, SessionInfo]:
    temporary = final.with_name(final.name + ".recovering")
    discard_leftover(temporary)
    try:
        rebuilt = rebuild(descriptor, source, temporary)
        original = source
        if in_place:
            original = _put_in_place(source, temporary, final)
        else:
            rename_new(temporary, final)
        return _report(final, rebuilt.part, original, rebuilt.lost_bytes, rebuilt.losses)
    except OSError as error:
        raise RecordingError(
            f"writing {temporary} failed ({error.strerror}); {source} is unchanged"
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def _put_in_place(source: Path, temporary: Path, final: Path) -> Path:
    """Where the damaged file is now. A kill at any moment leaves one under a name that the next run finds."""
    original = _free_name(source.with_name(source.name + DAMAGED_SUFFIX))
    try:
        os.link(source, original)
    except OSError:  # no second names here (exFAT): for a moment there is none at all
        rename_new(source, original)
    temporary.replace(source)
    sync_folder(source.parent)
    if final != source:
        rename_new(source, final)
    return original


def _free_name(path: Path) -> Path:
    """The path, or with -2, -3 … where an earlier recovery left one."""
    count, free = 1, path
    while os.path.lexists(free):
        count += 1
        free = path.with_name(f"{path.name}-{count}")
    return free
