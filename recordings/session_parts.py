"""The files of one session, opened together: of one session they must be, and what is missing is named."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from recordings.errors import CorruptRecordingError, RecordingError, UnfinishedRecordingError, recover_line
from recordings.files import PART_SUFFIX
from recordings.manifest import PARTS_LIMIT, Manifest, missing_parts, read_manifest
from recordings.segment import RecordingSegment


@dataclass(frozen=True)
class SessionParts:
    """What of a session was found, in the order it was recorded."""

    parts: list[RecordingSegment]
    missing: tuple[str, ...] = ()
    """A sentence for each part that must be there and is not."""
    losses: tuple[str, ...] = ()
    """What the recording does not hold any more, or may not: known, and no reason to refuse it."""


def parts_of_file(path: Path) -> SessionParts:
    """One file that is the whole session, or says of which session it is a part."""
    part = RecordingSegment(path)
    info = part.info
    manifest = read_manifest(path.parent)
    if manifest is not None and (manifest.session, manifest.parts.get(info.part)) != (info.name, path.name):
        manifest = None  # it lists other files of this folder
    sentences: tuple[str, ...] = ()
    if missing_parts(path.parent, manifest, {info.part}):
        count = str(len(manifest.parts)) if manifest else f"at least {info.part}"
        text = f"{path} is part {info.part} of {count} of session '{info.name}'"
        sentences = (f"{text}: give the session's folder ({path.parent}) instead of the file",)
    return SessionParts([part], sentences, _losses([part], manifest))


def parts_of_folder(folder: Path) -> SessionParts:
    """Every part in the folder. RecordingError when they are of different sessions, or one twice."""
    try:
        names = sorted(entry.name for entry in folder.iterdir())
    except OSError as error:
        raise RecordingError(f"cannot open {folder}: {error.strerror}") from error
    unsealed = [name for name in names if name.endswith(".mcap" + PART_SUFFIX)]
    if unsealed:
        raise UnfinishedRecordingError(
            f"{folder / unsealed[0]} was never finished. Save what is whole: {recover_line(folder)}"
        )
    files = [name for name in names if name.endswith(".mcap")]
    manifest = read_manifest(folder)
    if not files:
        raise RecordingError(_no_files_text(folder, manifest))
    if len(files) > PARTS_LIMIT:
        raise RecordingError(
            f"{folder} holds {len(files)} recordings: name one of them, or one session's folder"
        )
    parts = sorted((RecordingSegment(folder / name) for name in files), key=lambda part: part.info.part)
    _check_one_session(parts, manifest)
    missing = missing_parts(folder, manifest, {part.info.part for part in parts})
    session = parts[0].info.name
    sentences = tuple(
        f"{folder} lacks part {n}{f' ({name})' if name else ''} of session '{session}'"
        for n, name in missing.items()
    )
    return SessionParts(parts, sentences, _losses(parts, manifest))


def _no_files_text(folder: Path, manifest: Manifest | None) -> str:
    if manifest is None:
        return f"{folder} holds no recording (*.mcap)"
    files = ", ".join(filter(None, manifest.parts.values()))
    return f"{folder} holds none of the parts of session '{manifest.session}': copy back {files}"


def _check_one_session(parts: list[RecordingSegment], manifest: Manifest | None) -> None:
    first = parts[0].info
    if manifest is not None and manifest.session != first.name:
        raise RecordingError(
            f"{parts[0].path} is of session '{first.name}', its folder of '{manifest.session}': "
            "name the file, not the folder"
        )
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
        if before and before.info.part == info.part:
            raise CorruptRecordingError(
                f"{before.path} and {part.path} are both part {info.part}: move the copy away"
            )


def _losses(parts: list[RecordingSegment], manifest: Manifest | None) -> tuple[str, ...]:
    found = [
        f"{part.path.name} was cut or damaged: {part.lost_bytes} bytes were lost when it was recovered"
        for part in parts
        if part.lost_bytes
    ]
    present = {part.info.part for part in parts}
    if manifest is not None:
        given_up = [n for n in manifest.given_up if n not in present]
        found += [f"part {n} of the session was lost" for n in given_up]
    elif parts[-1].recovered:
        found.append(
            f"{parts[-1].path.name} was interrupted, and no parts.json beside it says whether the session "
            "went on: a later part may be missing"
        )
    return tuple(found)
