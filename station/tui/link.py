"""The screen's only way to the daemon. It holds no truth: statuses come in, requests go out."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any, Protocol

from station.protocol import Verb
from station.status import StationStatus


class Link(Protocol):
    """What the screen needs of a connection; `station.client.Client` is one, tests bring another."""

    async def request(self, verb: Verb, **args: Any) -> Any:
        """The daemon's result. RefusedError with the daemon's reason; StationError when it is gone."""

    def statuses(self) -> AsyncIterator[StationStatus]:
        """The full status now and at every change; ends when the daemon is gone."""

    async def close(self) -> None: ...


Connect = Callable[[], Awaitable[Link]]
