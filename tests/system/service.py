"""A program of a named service, without a terminal: `python -m tests.system.service SOCKET PLAN`.

It takes control, learns the hash of the plan once, as a person would hand it over, and says that it is ready.
Then it acknowledges, prepares and approves whatever it can until its input ends. At last it prints how often
it was refused, by code.
"""

from __future__ import annotations

import asyncio
import json
import sys
from collections import Counter
from pathlib import Path

from station.cell.errors import StationError
from station.protocol.client import Client

PAUSE_S = 0.005


class Service:
    def __init__(self, client: Client, sha256: str) -> None:
        self._client = client
        self._sha256 = sha256
        self.refused = Counter[str]()

    async def work(self) -> None:
        while True:
            for ask in (self._acknowledge, self._run, self._resume):
                try:
                    await ask()
                except StationError as error:
                    self.refused[error.code] += 1
            await asyncio.sleep(PAUSE_S)

    async def _acknowledge(self) -> None:
        await self._client.request("acknowledge")

    async def _run(self) -> None:
        await self._approve("run")

    async def _resume(self) -> None:
        await self._approve("resume")

    async def _approve(self, purpose: str) -> None:
        offer = await self._client.request("prepare", purpose=purpose)
        await self._client.request("go", token=offer["token"], approval_sha256=self._sha256)


async def main(socket: Path, plan: Path) -> None:
    async with Client(socket) as client:
        await client.request("load_plan", plan=json.loads(plan.read_text()))
        offer = await client.request("prepare", purpose="run")
        service = Service(client, offer["approval_sha256"])
        print('{"ready": true}', flush=True)
        working = asyncio.create_task(service.work())
        await asyncio.to_thread(sys.stdin.read)
        working.cancel()
        print(json.dumps(service.refused), flush=True)


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1]), Path(sys.argv[2])))
