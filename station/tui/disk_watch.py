"""The shown result and the sessions, read again when another screen or a shell changed them."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from dataclasses import replace

from station.protocol.verbs import Sessions
from station.tui.desk import KnowingApp
from station.tui.installed import Marks, marks, read_result, read_sessions, state_root
from station.tui.sessions import SessionsScreen

LOOK_S = 2.0


class DiskWatch:
    """Keeps `known.result` and `known.sessions` as they are on the disk."""

    def __init__(self, app: KnowingApp) -> None:
        self._app = app
        self._asked = asyncio.Event()
        self._marks: tuple[str, Marks] = ("", frozenset())
        """The shown file, and marks of all below the root, when they were read."""

    def look(self) -> None:
        """Look at once."""
        self._asked.set()

    async def follow(self) -> None:
        """Look every few seconds; a daemon at work is left in peace."""
        while True:
            with suppress(TimeoutError):
                await asyncio.wait_for(self._asked.wait(), LOOK_S)
            if self._asked.is_set() or not self._app.known.works:
                self._asked.clear()
                await self._read_changed()

    async def _read_changed(self) -> None:
        app, live = self._app, self._app.known.live
        path = app.result_path or ("" if live is None else live.session.calibration)
        root = state_root(path) if path else app.desk.client.root
        if root is None or (found := (path, await asyncio.to_thread(marks, root))) == self._marks:
            return
        self._marks = found
        result = await asyncio.to_thread(read_result, path) if path else None
        app.known = replace(app.known, result=result)
        if isinstance(app.screen, SessionsScreen):
            await self.read_sessions()

    async def read_sessions(self) -> None:
        client, sessions = self._app.desk.client, await self._app.desk.ask(Sessions())
        if sessions is None:
            self._marks = ("", frozenset())  # a notice said why; the next look asks again
            return
        kept = await asyncio.to_thread(read_sessions, client.root, client.camera, sessions)
        self._app.known = replace(self._app.known, sessions=kept)
