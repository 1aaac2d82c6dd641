"""A network between the station and a controller, in which everything takes its time, both ways."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager

PORTS = (29999, 30001, 30002, 30003, 30004)
"""Of a controller: dashboard, primary, secondary, real time, RTDE."""
PIECE_BYTES = 1 << 16


@contextmanager
def delayed_link(controller_host: str, delay_s: float) -> Iterator[str]:
    """Give a loopback address at which the controller answers `delay_s` later, each way.

    It works in a thread of its own, so that the station's event loop does not hold it up.
    """
    first, second, third = os.urandom(3)
    host = f"127.{first % 254 + 1}.{second}.{third % 254 + 1}"
    loop = asyncio.new_event_loop()
    listening, ending = threading.Event(), asyncio.Event()

    async def serve() -> None:
        servers = [
            await asyncio.start_server(_Link(controller_host, port, delay_s).serve, host, port)
            for port in PORTS
        ]
        listening.set()
        await ending.wait()
        for server in servers:
            server.close()
        left = asyncio.all_tasks() - {asyncio.current_task()}
        for task in left:
            task.cancel()
        await asyncio.gather(*left, return_exceptions=True)

    thread = threading.Thread(target=lambda: loop.run_until_complete(serve()), daemon=True)
    thread.start()
    assert listening.wait(60)
    try:
        yield host
    finally:
        loop.call_soon_threadsafe(ending.set)
        thread.join()
        loop.close()


class _Link:
    def __init__(self, host: str, port: int, delay_s: float) -> None:
        self._host, self._port, self._delay_s = host, port, delay_s

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
