"""Latch: what a person must acknowledge before the arm may move again, kept over restarts of the daemon.

STOP, a safety stop, a fault and a lost connection each hold the latch. While it is held no service may
approve motion, whatever the station's state. After STOP, a safety stop or a fault the state is latched, too.
Only a person ends it (`server.dispatch`), except where the station moves no real arm.

ROOT/latch-real.json     one file a source, so that nobody acknowledges a real arm's STOP in a simulated cell

The file is written by a thread, so that STOP never waits for a disk, and it is removed by an acknowledgement.
A daemon that finds it starts latched, also after a kill or a power cut.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import msgspec

from recordings.files import read_file, sync_folder, write_atomically
from recordings.schema.messages import Source
from station.cell.status import StationState
from station.session.threads import LATCH

log = logging.getLogger(__name__)

RETRY_S = 1.0
"""Pause before a latch that could not be written, as on a full disk, is written again."""
_LIMIT_BYTES = 64 * 1024
_UNREADABLE = "latch-unreadable"


class Latch(msgspec.Struct, frozen=True, omit_defaults=True):
    """What happened, as the file keeps it."""

    reason: str
    """Sentence for people."""
    cause: str
    """Code of the reason, for programs."""
    state: Literal["stopped", "fault"] | None = None
    """State in which a daemon starts that finds the latch; None: as usual, only services are barred. A lost
    connection leaves the station paused or idle, where a person may approve motion again."""
    needs_person: bool = True
    """Only a person at a terminal may acknowledge it, as for every real arm that the station moves."""
    since_wall_ns: int = 0
    """0: not known."""

    @property
    def when(self) -> str:
        """When it was latched, in this computer's time, for people."""
        if not self.since_wall_ns:
            return "at an unknown time"
        return time.strftime("on %Y-%m-%d at %H:%M", time.localtime(self.since_wall_ns / 1e9))


class LatchKeeper:
    """Holder of the latch in memory, and of its file. For the event loop's thread only, but for `read`."""

    def __init__(self, root: Path, source: Source, moved: bool, told: Callable[[Latch | None], None]) -> None:
        """`moved`: the station moves the arm. `told`: called after every change."""
        self._path = root / f"latch-{source}.json"
        self._real = source == "real" and moved
        self._told = told
        self.held: Latch | None = None
        """What a person must acknowledge; None: nothing."""
        self._written: Latch | None = None
        """What the file holds."""
        self._changed = asyncio.Event()
        self._settled = asyncio.Event()
        self._settled.set()

    @property
    def needs_person(self) -> bool:
        """Only a person at a terminal may acknowledge what is held."""
        return self._real or (self.held is not None and self.held.needs_person)

    @property
    def bars_services(self) -> str:
        """Why no service may approve motion now; empty: services may."""
        return self.held.reason if self.held is not None else ""

    def read(self) -> Latch | None:
        """Read what an earlier daemon left; None: nothing. Blocks: call it from a thread.

        A file that cannot be read counts as STOP, because nobody knows what it said.
        """
        try:
            return msgspec.json.decode(read_file(self._path, _LIMIT_BYTES), type=Latch)
        except FileNotFoundError:
            return None
        except (OSError, msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            reason = f"{self._path} tells of a STOP or a fault, and cannot be read: {error}."
            return Latch(reason, _UNREADABLE, "stopped")

    def begin_with(self, found: Latch | None) -> None:
        """Hold what `read` found, without writing it again."""
        self.held = self._written = found
        self._told(found)

    def hold(self, reason: str, cause: str, state: StationState | None = None) -> None:
        """Hold the latch; the file is written later. `state`: stopped, fault, or None (see `Latch.state`).

        A latch that only bars services never replaces one that keeps the station stopped. What needed a
        person before goes on to need one.
        """
        before = self.held
        if before is not None and before.state is not None and state is None:
            return
        made = Latch(reason, cause, needs_person=self.needs_person, since_wall_ns=time.time_ns())
        if state is StationState.STOPPED:
            made = msgspec.structs.replace(made, state="stopped")
        elif state is StationState.FAULT:
            made = msgspec.structs.replace(made, state="fault")
        self._change(made)

    def release(self) -> None:
        """End the latch, as a person acknowledged; the file is removed later (`settled`)."""
        self._change(None)

    def release_bar(self) -> None:
        """End a latch that only bars services; one that keeps the station stopped stays."""
        if self.held is not None and self.held.state is None:
            self.release()

    def _change(self, latch: Latch | None) -> None:
        self.held = latch
        self._settled.clear()
        self._changed.set()
        self._told(latch)

    async def run(self) -> None:
        """Bring every change to the disk, for the daemon's life; try again what fails."""
        while True:
            await self._changed.wait()
            self._changed.clear()
            wanted = self.held
            if wanted != self._written:
                try:
                    await LATCH.run(self._write, wanted)
                except OSError as error:
                    log.error("%s: %s; a daemon started now would not know of it", self._path, error)
                    await asyncio.sleep(RETRY_S)
                    self._changed.set()
                    continue
                self._written = wanted
            if self.held == self._written:
                self._settled.set()

    async def settled(self, within_s: float) -> None:
        """Wait until the file says what is held, at most `within_s`: a disk may hang."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                await self._settled.wait()

    def _write(self, latch: Latch | None) -> None:
        if latch is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path, msgspec.json.encode(latch))
        else:
            self._path.unlink(missing_ok=True)
            sync_folder(self._path.parent)
