"""Folders of sessions on the disk, and the state of a session that survives a restart.

ROOT/sessions/20260131-101500-cell/   session.mcap, session-2.mcap … one file a segment
                                      session.json  poses and their state, written after every pose
ROOT/active                           names the session that runs; still there after a crash
"""

from __future__ import annotations

import re
import time
from collections.abc import Collection
from pathlib import Path

import msgspec

from recordings.files import PART_SUFFIX, read_file, session_name_from, sync_folder, write_atomically
from recordings.same_session import description_of
from recordings.schema.earlier import lift_session
from recordings.schema.messages import SessionInfo, Source
from station.cell.errors import StationError
from station.cell.pose_plan import Plan
from station.cell.status import PoseStatus

STATE_FILE = "session.json"
CALIBRATION_FILE, REPORT_FILE = "calibration.yaml", "report.html"
_ACTIVE = "active"
_NAME_ATTEMPTS = 100
_LISTED = 200
_LIMIT_BYTES = 1024 * 1024
_UNDER_WAY = re.compile(rb'"state":"(moving|settling|capturing|writing)"')
"""What earlier versions wrote of a pose that is planned, and was under way."""


class SessionState(msgspec.Struct, frozen=True, omit_defaults=True):
    """`session.json`."""

    source: Source
    plan: Plan
    poses: tuple[PoseStatus, ...]
    parts: int = 1
    """Number of segments"""
    elapsed_s: float = 0.0
    """Total time of its runs."""
    check: bool = False
    """True: a drift check of the installed calibration."""
    sealed: bool = False
    first: SessionInfo | None = None
    """What the session began with: robot, camera, board, mount and lens; None: unknown, in older files."""


class SessionSummary(msgspec.Struct, frozen=True):
    """Session on the disk, for lists."""

    name: str
    folder: str
    recording: str
    """File of the recording, or folder of several; empty: nothing was recorded."""
    views: int
    check: bool
    """True: a drift check of the installed calibration."""
    sealed: bool
    calibration: str
    """Path of the calibration file made from it; empty: none."""


def new_session_folder(root: Path, cell: str) -> Path:
    """Make a new folder; names sort by time and are unique within a second. Raises StationError."""
    sessions = root / "sessions"
    stamp = time.strftime("%Y%m%d-%H%M%S")
    try:
        sessions.mkdir(parents=True, exist_ok=True)
        for attempt in range(1, _NAME_ATTEMPTS):
            suffix = "" if attempt == 1 else f"-{attempt}"
            folder = sessions / f"{session_name_from(f'{stamp}-{cell}')[: 40 - len(suffix)]}{suffix}"
            try:
                folder.mkdir()
            except FileExistsError:
                continue
            return folder
    except OSError as error:
        raise StationError("session-folder", folder=sessions, reason=error.strerror) from error
    raise StationError("session-folder", folder=sessions, reason="it has too many of this second")


def solve_arguments(recording: str, folder: str, without: Collection[int] = ()) -> tuple[str, ...]:
    """Arguments of `calibrate`: result and report into the session's folder, where the screen finds them.

    without: pose numbers, from 0, of the views that a person excludes.
    """
    output, report = (str(Path(folder) / name) for name in (CALIBRATION_FILE, REPORT_FILE))
    excluded = ",".join(str(index + 1) for index in sorted(without))
    left_out = ("--without", excluded) if excluded else ()
    return ("solve", recording, "-o", output, "--report", report, *left_out)


def require_writable(root: Path) -> None:
    """Write a file below `root` and remove it. Raises OSError."""
    probe = root / ".write-test"
    probe.write_bytes(b"x")
    probe.unlink(missing_ok=True)


def segment_path(folder: Path, segment: int) -> Path:
    return folder / ("session.mcap" if segment == 1 else f"session-{segment}.mcap")


def write_state(folder: Path, state: SessionState) -> None:
    write_atomically(folder / STATE_FILE, msgspec.json.encode(state))


def read_state(folder: Path) -> SessionState | None:
    """Read a session's state; None where it is missing or invalid."""
    try:
        text = _UNDER_WAY.sub(b'"state":"planned"', read_file(folder / STATE_FILE, _LIMIT_BYTES))
        plain = msgspec.json.decode(text)
        if isinstance(plain, dict) and "first" in plain:
            plain["first"] = lift_session(plain["first"])
        return msgspec.convert(plain, SessionState)
    except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


def mark_active(root: Path, folder: Path) -> None:
    sync_folder(folder.parent)  # make the folder durable before anything points to it
    write_atomically(root / _ACTIVE, folder.name.encode())


def clear_active(root: Path) -> None:
    (root / _ACTIVE).unlink(missing_ok=True)


def interrupted_session(root: Path) -> tuple[Path, SessionState] | None:
    """Find the session that was running when the daemon ended without finishing it; None: none.

    Earlier versions did not save what the session began with: then its first segment says so.
    """
    try:
        name = read_file(root / _ACTIVE, _LIMIT_BYTES).decode()
    except (OSError, UnicodeDecodeError):
        return None
    if session_name_from(name) != name:
        return None
    folder = root / "sessions" / name
    state = read_state(folder)
    if state is None or state.sealed:
        return None
    if state.first is None:
        state = msgspec.structs.replace(state, first=first_description(folder))
    return folder, state


def first_description(folder: Path) -> SessionInfo | None:
    """Read what a session began with from its first segment; None where it cannot be read."""
    finished = segment_path(folder, 1)
    return description_of(finished) or description_of(finished.with_name(finished.name + PART_SUFFIX))


def list_sessions(root: Path) -> list[SessionSummary]:
    """List the sessions below `root`, newest first."""
    try:
        folders = sorted((f for f in (root / "sessions").iterdir() if f.is_dir()), reverse=True)
    except OSError:
        return []
    return [_described(folder) for folder in folders[:_LISTED]]


def _described(folder: Path) -> SessionSummary:
    state = read_state(folder)
    named = [*folder.glob("*.mcap"), *folder.glob(f"*.mcap{PART_SUFFIX}")]
    files = [file for file in named if file.is_file()]
    calibration = folder / CALIBRATION_FILE
    return SessionSummary(
        name=folder.name,
        folder=str(folder),
        recording=str(files[0] if len(files) == 1 else folder) if files else "",
        views=sum(pose.counts for pose in state.poses) if state else 0,
        check=state is not None and state.check,
        sealed=bool(files) and not any(file.name.endswith(PART_SUFFIX) for file in files),
        calibration=str(calibration) if calibration.is_file() else "",
    )
