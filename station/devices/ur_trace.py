"""Every sample of an arm from here to there, by a connection of its own that comes back after a cut."""

from __future__ import annotations

import asyncio
import contextlib
import time

from recordings.schema.messages import RobotState
from station.cell.errors import RobotError
from station.devices.ur_state import StateReader

RECONNECT_S = 0.3


class TraceRecorder:
    """Reads only. `begin`, then `end` for what came between; again and again."""

    def __init__(self, host: str) -> None:
        self._host = host
        self._states: list[RobotState] = []
        self._reader: StateReader | None = None
        self._keeper: asyncio.Task[None] | None = None

    async def begin(self) -> None:
        """Returns once samples come. RobotError when none do."""
        self._states = []
        await self._open()
        self._keeper = asyncio.create_task(self._keep())

    async def end(self) -> list[RobotState]:
        """All samples since `begin`, in order."""
        if self._keeper is not None:
            self._keeper.cancel()
            await asyncio.gather(self._keeper, return_exceptions=True)
        await self._close()
        return self._states

    @property
    def newest(self) -> RobotState | None:
        return self._states[-1] if self._states else None

    def silent_s(self) -> float:
        """Time since the last sample came."""
        newest = self.newest
        return (time.monotonic_ns() - newest.stamps.host_monotonic_ns) / 1e9 if newest else 0.0

    async def _open(self) -> None:
        states = self._states
        self._reader = reader = StateReader(self._host, states.append, lambda _: None)
        reader.start()
        await asyncio.wrap_future(reader.started)

    async def _close(self) -> None:
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.request_end()
            await asyncio.to_thread(reader.join, 3.0)

    async def _keep(self) -> None:
        """A lost connection is opened again until it comes."""
        while True:
            await asyncio.sleep(RECONNECT_S)
            if self._reader is None or self._reader.ended is not None:
                await self._close()
                with contextlib.suppress(RobotError):
                    await self._open()
