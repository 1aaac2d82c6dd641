"""The screen's only way to the daemon. It holds no truth: statuses come in, requests go out."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any, Protocol

from station.cell.errors import RefusedError
from station.cell.status import StationStatus


class Link(Protocol):
    """What the screen needs of a connection; `station.protocol.client.Client` is one, tests bring another."""

    root: Path | None
    """Below which the daemon keeps sessions and what is installed."""

    async def request(self, verb: str, **args: Any) -> Any:
        """The daemon's result. RefusedError with the daemon's reason; StationError when it is gone."""

    def statuses(self) -> AsyncIterator[StationStatus]:
        """The full status now and at every change; ends when the daemon is gone."""

    async def close(self) -> None: ...


Connect = Callable[[], Awaitable[Link]]

LISTEN_S = 0.5
SILENT_S = 2.0
"""A working daemon answers within milliseconds, on a busy computer within some hundred."""
_PATIENT_S = 7 * 86400.0


async def listen(link: Link, tell: Callable[[float | None], None]) -> None:
    """Asks something small again and again; ends with the link. A daemon that hangs keeps its socket open.

    `tell` hears for how many seconds it has not answered, and None when it did.
    """
    while True:
        asked_s = time.monotonic()
        answer = asyncio.ensure_future(link.request("watch", timeout_s=_PATIENT_S))
        try:
            while not (await asyncio.wait({answer}, timeout=LISTEN_S))[0]:
                if (waited_s := time.monotonic() - asked_s) >= SILENT_S:
                    tell(waited_s)
            problem = answer.exception()
        finally:
            answer.cancel()
        if problem is not None and not isinstance(problem, RefusedError):
            return
        tell(None)
        await asyncio.sleep(LISTEN_S)
