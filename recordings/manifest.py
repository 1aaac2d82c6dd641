"""`parts.json`: the segments a session's folder must hold, so that a lost one is noticed, the last one too.

A segment cannot know of those that follow it, and a finished file is never touched again: the list stands
beside them. A segment is entered when its file is there and before anything in it is acknowledged.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

from recordings.errors import CorruptRecordingError, RecordingError, disk_error
from recordings.files import EMPTY_SUFFIX, PART_SUFFIX, read_beginning, write_atomically

MANIFEST_FILE = "parts.json"
PARTS_LIMIT = 100
_LIMIT_BYTES = 64 * 1024


class Manifest(
    msgspec.Struct,
    frozen=True,
    forbid_unknown_fields=True,
    omit_defaults=True,
    tag_field="format",
    tag="station-session/1",
):
    session: str
    parts: dict[int, str]
    """Segment → file name; one given up by recovery whose file nobody knew has ''."""
    given_up: list[int] = []
    """Segments that `recordings recover` did not find. One that comes back is read again."""


def read_manifest(folder: Path) -> Manifest | None:
    """None where there is none: a folder of an older version, or single files. Raises RecordingError."""
    path = folder / MANIFEST_FILE
    if not os.path.lexists(path):
        return None
    try:
        content = read_beginning(path, _LIMIT_BYTES)
    except OSError as error:
        raise disk_error("read", path, error) from error
    try:
        manifest = msgspec.json.decode(content, type=Manifest)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise _damaged(path, str(error)) from error
    if not manifest.parts or not 1 <= min(manifest.parts) <= max(manifest.parts) <= PARTS_LIMIT:
        raise _damaged(path, f"its parts are not numbered 1 to at most {PARTS_LIMIT}")
    if any(len(Path(name).parts) > 1 for name in manifest.parts.values()):
        raise _damaged(path, "a part lies outside the folder")
    return manifest


def _damaged(path: Path, reason: str) -> CorruptRecordingError:
    return CorruptRecordingError("damaged-manifest", path=path, reason=reason)


def enter_part(folder: Path, session: str, part: int, file_name: str) -> None:
    """Note a segment without which the session is incomplete from now on. Returns when it is on the disk."""
    known = read_manifest(folder) or Manifest(session, {})
    if known.session != session:
        raise RecordingError("other-session", folder=folder, session=known.session, wanted=session)
    _write(folder, msgspec.structs.replace(known, parts=known.parts | {part: file_name}))


def give_up_parts(folder: Path, session: str, present: dict[int, str], missing: dict[int, str]) -> None:
    """The session counts as all there is; what is missing stays named. Raises RecordingError."""
    known = read_manifest(folder)
    parts = (known.parts if known else {}) | missing | present
    given_up = sorted({*(known.given_up if known else []), *missing} - present.keys())
    _write(folder, Manifest(session, dict(sorted(parts.items())), given_up))


def missing_parts(folder: Path, manifest: Manifest | None, present: set[int]) -> dict[int, str]:
    """Part → file name ('' when unknown) of what should be in the folder and is not.

    Neither `present` nor set aside by recovery because nothing was in it, nor given up before.
    """
    named = manifest.parts if manifest else {}
    empty = {
        path.name.partition(PART_SUFFIX + EMPTY_SUFFIX)[0]
        for path in folder.glob(f"*{PART_SUFFIX}{EMPTY_SUFFIX}*")
    }
    nameless_empty = len(empty - set(named.values()))
    missing: dict[int, str] = {}
    for part in range(1, max(*present, *named, 1) + 1):
        name = named.get(part, "")
        if part in present or name in empty or (manifest and part in manifest.given_up):
            continue
        if not name and nameless_empty:
            nameless_empty -= 1
            continue
        missing[part] = name
    return missing


def _write(folder: Path, manifest: Manifest) -> None:
    try:
        write_atomically(folder / MANIFEST_FILE, msgspec.json.encode(manifest))
    except OSError as error:
        raise disk_error("write", folder / MANIFEST_FILE, error) from error
