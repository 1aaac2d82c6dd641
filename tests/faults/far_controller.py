"""A simulated controller on this host's loopback, reached on `ADDRESS` from another host.

The controller itself takes loopback clients only, so this program passes their bytes on. Run it in a network
namespace of its own; it prints the controller's address when it is ready, and ends with its input.
"""

from __future__ import annotations

import asyncio
import os
import sys

from station.simulation.launch import ADMIN_PORT, start_controller

PORTS = (29999, 30001, 30002, 30003, 30004, ADMIN_PORT)


async def passed_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while data := await reader.read(65536):
            writer.write(data)
            await writer.drain()
    except OSError:
        pass
    finally:
        writer.close()


async def relay(address: str, controller: str) -> None:
    def to(port: int) -> object:
        async def taken(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            far_reader, far_writer = await asyncio.open_connection(controller, port)
            await asyncio.gather(passed_on(reader, far_writer), passed_on(far_reader, writer))

        return asyncio.start_server(taken, address, port)

    servers = [await to(port) for port in PORTS]
    print(controller, flush=True)
    await asyncio.to_thread(os.read, 0, 1)
    for server in servers:
        server.close()


if __name__ == "__main__":
    with start_controller("UR10e") as simulated:
        asyncio.run(relay(sys.argv[1], simulated.host))
