"""Waits end at once when the thing happens and give up after a minute: a computer may have much to do."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

PATIENCE_S = 60.0
NOTHING_CAME = "it did not come about"


def wait_until(condition: Callable[[], object], what: str = NOTHING_CAME) -> None:
    """Look until it holds, where no loop runs."""
    give_up_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < give_up_s, what
        time.sleep(0.01)


async def until(condition: Callable[[], object], what: str = NOTHING_CAME) -> None:
    """Look until it holds, while the loop goes on."""
    give_up_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < give_up_s, what
        await asyncio.sleep(0.002)


@asynccontextmanager
async def beats() -> AsyncIterator[list[float]]:
    """A moment every 10 ms for as long as the loop goes on meanwhile."""
    found: list[float] = []

    async def beat() -> None:
        while True:
            await asyncio.sleep(0.01)
            found.append(time.monotonic())

    beating = asyncio.create_task(beat())
    yield found
    beating.cancel()
