"""The one door to results: what clients may read, install, undo and withdraw below the daemon's root.

Whoever changes something there by a command is noticed, and every screen is told by the status.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TypeVar

import msgspec

from calibrate.check.history import FILE as CHECKS_FILE
from calibrate.errors import CalibrationError
from calibrate.files.folders import calibrations_folder, current_version
from calibrate.files.install import Cell, install, rollback, withdraw
from calibrate.files.touch import Touch
from calibrate.files.validity import Validity, ValidityState, validity_text
from calibrate.files.validity_log import FILE as VALIDITY_FILE
from calibrate.files.validity_log import read_validity_log
from recordings.schema.messages import Source
from station.analysis.pool import Workers
from station.analysis.result_files import (
    carry_out,
    install_session,
    note_touches,
    require_readable,
    result_of,
    sessions_of,
)
from station.cell.config import StationConfig
from station.cell.errors import RefusedError
from station.cell.status import ResultsStatus
from station.protocol import verbs
from station.session.context import StatusStore
from station.session.threads import WATCH

R = TypeVar("R")

LOOK_S = 1.0
READ_S = 60.0
LIST_S = 180.0
CHANGE_S = 60.0
"""Longest times that the process which reads and changes the files may take, on a busy computer."""
_DOUBTS = (ValidityState.IN_DOUBT, ValidityState.WITHDRAWN)


@dataclass(frozen=True)
class Looked:
    """What one look at the folders saw."""

    marks: frozenset[tuple[str, int]] = frozenset()
    """When each session and installation changed."""
    validity: Validity | None = None
    """Of the installed version as it was recorded; None: nothing is installed, or it cannot be read."""


class Results:
    """Results below `root`, for the event loop's thread. Files are read and changed in another process."""

    def __init__(
        self, config: StationConfig, source: Source, root: Path, store: StatusStore, reader: Workers
    ) -> None:
        """`source`: of the cell; only a simulated one installs what is simulated."""
        self._camera = config.camera.name
        self._max_age_days = config.validity.max_age_days
        self._cell: Cell = "simulated" if source == "simulated" else "real"
        self._root, self._store = root, store
        self.reader = reader
        self._looked: Looked | None = None
        """None: before the first look, whose findings are no news."""

    # --- what is there ---

    async def result(self, session: str) -> verbs.ResultData:
        """Return the calibration of a session; `session` as in `verbs.GetResult`."""
        shown = self._store.status.session
        named, check = (shown.name, shown.check) if not session else (_folder_name(session), False)
        return verbs.ResultData(await self._read(result_of, named, check, timeout_s=READ_S))

    async def sessions(self) -> verbs.SessionsData:
        """Return the recorded sessions, newest first."""
        return verbs.SessionsData(await self._read(sessions_of, timeout_s=LIST_S))

    async def installed(self) -> verbs.InstalledVersion:
        """Return what is installed, once its file was read. Raises CalibrationError."""
        await self._read(require_readable, timeout_s=READ_S)
        await self.look()
        return self._version()

    async def _read(self, function: Callable[..., R], *args: object, timeout_s: float) -> R:
        """Read below the root, after the first look: what changes after it is told."""
        if self._looked is None:
            await self.look()
        return await self.reader.call(function, self._root, self._camera, *args, timeout_s=timeout_s)

    # --- changes by a client ---

    async def install(self, wanted: verbs.Install, by: str) -> verbs.InstalledVersion:
        """Install by the rules of `calibrate install`. Raises CalibrationError."""
        put = partial(
            install, cell=self._cell, override=wanted.override, max_age_days=self._max_age_days, by=by
        )
        return await self._changed(install_session, self._camera, _folder_name(wanted.session), put)

    async def rollback(self, wanted: verbs.Rollback, by: str) -> verbs.InstalledVersion:
        """Go back to the version before. Raises CalibrationError."""
        undo = partial(rollback, camera=self._camera, by=by, seen=wanted.seen)
        return await self._changed(carry_out, undo)

    async def withdraw(self, wanted: verbs.Withdraw, by: str) -> verbs.InstalledVersion:
        """Take the installed version out of use. Raises CalibrationError."""
        end = partial(withdraw, reason=wanted.reason, camera=self._camera, by=by, seen=wanted.seen)
        return await self._changed(carry_out, end)

    async def note_touches(self, wanted: verbs.NoteTouches, by: str) -> verbs.TouchesNoted:
        """Write touch tests into a file and the installed version. Raises CalibrationError."""
        try:
            told = msgspec.convert(wanted.touches, list[Touch])
        except msgspec.ValidationError as error:
            raise RefusedError("wrong-arguments", verb=wanted.verb(), problem=str(error)) from None
        touches = [msgspec.structs.replace(touch, who=by) for touch in told]
        session = _folder_name(wanted.session)
        noted = await self.reader.call(
            note_touches, self._root, self._camera, session, touches, by, timeout_s=CHANGE_S
        )
        await self.look()
        return noted

    async def _changed(self, change: Callable[..., None], *args: object) -> verbs.InstalledVersion:
        """Carry out a change below the root; the status tells it before the answer does."""
        await self.reader.call(change, self._root, *args, timeout_s=CHANGE_S)
        await self.look()
        return self._version()

    def _version(self) -> verbs.InstalledVersion:
        now = self._store.status.results
        return verbs.InstalledVersion(now.installed or 0, now.validity)

    # --- changes by anybody ---

    async def watch(self) -> None:
        """Look once a second, for the daemon's life."""
        while True:
            await self.look()
            await asyncio.sleep(LOOK_S)

    async def look(self) -> None:
        """Look now, and tell what changed."""
        before = self._looked
        found = await WATCH.run(_look, self._root, self._camera, before)
        self._looked = found
        shown = self._store.status.results
        changes = shown.changes + (before is not None and found.marks != before.marks)
        validity = None if found.validity is None else found.validity.at(datetime.now(UTC))
        now = ResultsStatus(changes=changes)
        if validity is not None:
            now = ResultsStatus(validity.version, validity.state.value, changes)
        if now == shown:
            return
        self._store.update(results=now)
        if before is not None and (now.installed, now.validity) != (shown.installed, shown.validity):
            self._tell(validity)

    def _tell(self, validity: Validity | None) -> None:
        """Publish what is installed now, whoever changed it."""
        if validity is None:
            self._store.event("calibration-changed", "no calibration is installed any more", "warning")
            return
        self._store.event(
            "calibration-changed",
            f"installed calibration: version {validity.version}, {validity_text(validity)}",
            "warning" if validity.state in _DOUBTS else "info",
            version=validity.version,
            validity=validity.state.value,
        )

    def close(self) -> None:
        """End the process. A change that it is in the middle of is made, or not at all."""
        self.reader.close()


def _folder_name(session: str) -> str:
    """Return a session's name, which is never a path. RefusedError where it is one."""
    if "/" in session or session in (".", "..") or not session.isprintable():
        raise RefusedError("no-such-session", session=session)
    return session


def _look(root: Path, camera: str, before: Looked | None) -> Looked:
    """Look at the folders; in a thread, as the disk may hang."""
    marks = _marks(root)
    if before is not None and marks == before.marks:
        return before
    validity = None
    with suppress(CalibrationError, OSError):
        folder = calibrations_folder(root, camera)
        validity = read_validity_log(folder).of(current_version(folder)[0])
    return Looked(marks, validity)


def _marks(root: Path) -> frozenset[tuple[str, int]]:
    """Note when each session and installation below this root changed.

    A folder changes when a file comes or leaves, a link when its target does.
    """
    folders = [calibrations_folder(root), *(root / "calibrations" / "cameras").glob("*")]
    found = set[tuple[str, int]]()
    for path in (
        *(root / "sessions").glob("*"),
        *(folder / name for folder in folders for name in ("current", VALIDITY_FILE, CHECKS_FILE)),
    ):
        with suppress(OSError):
            found.add((str(path), path.lstat().st_mtime_ns))
    return frozenset(found)
