"""A network between the station and a controller, in which everything takes its time, both ways.

`python -m tests.delayed_link HOST DELAY_S OWN_HOST PARENT_PID` is a process of its own, so that a busy
station does not hold it up.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from station.cell.child import start_child
from station.cell.process import die_with_parent
from tests.patience import PATIENCE_S

PORTS = (29999, 30001, 30002, 30003, 30004)
"""Of a controller: dashboard, primary, secondary, real time, RTDE."""
PIECE_BYTES = 1 << 16


@contextmanager
def delayed_link(controller_host: str, delay_s: float) -> Iterator[str]:
    """Give a loopback address at which the controller answers `delay_s` later, each way."""
    first, second, third = os.urandom(3)
    host = f"127.{first % 254 + 1}.{second}.{third % 254 + 1}"
    what = [controller_host, str(delay_s), host, str(os.getpid())]
    link = start_child("delayed link", [sys.executable, "-m", "tests.delayed_link", *what], PATIENCE_S, None)
    try:
        yield host
    finally:
        link.stop(10.0)


async def serve(controller_host: str, delay_s: float, host: str) -> None:
    for port in PORTS:
        await asyncio.start_server(Link(controller_host, port, delay_s).serve, host, port)
    print('{"ready": true}', flush=True)
    await asyncio.to_thread(sys.stdin.read)  # until the test ends
    os._exit(0)


class Link:
    """One port: what a client sends comes to the controller's port later, and what that answers, too."""

    def __init__(self, host: str, port: int, delay_s: float) -> None:
        self._host = host
        self._port = port
        self._delay_s = delay_s

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            other_reader, other_writer = await asyncio.open_connection(self._host, self._port)
            await asyncio.gather(self._carry(reader, other_writer), self._carry(other_reader, writer))

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        loop = asyncio.get_running_loop()
        under_way: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()

        async def deliver() -> None:
            while True:
                due_s, piece = await under_way.get()
                await asyncio.sleep(due_s - loop.time())
                if not piece or writer.is_closing():
                    break
                writer.write(piece)
            writer.close()

        delivering = asyncio.create_task(deliver())
        with contextlib.suppress(OSError):
            while piece := await reader.read(PIECE_BYTES):
                under_way.put_nowait((loop.time() + self._delay_s, piece))
        under_way.put_nowait((loop.time() + self._delay_s, b""))
        await delivering


if __name__ == "__main__":
    die_with_parent(int(sys.argv[4]))
    asyncio.run(serve(sys.argv[1], float(sys.argv[2]), sys.argv[3]))
