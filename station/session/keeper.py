"""Opens the devices and opens them again: read-only, in the background, for as long as the daemon lives."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable

from station.analysis.pool import WorkerError
from station.cell.errors import CameraError, RobotError, StationError
from station.cell.status import TriggerStatus
from station.session.context import SessionContext
from station.session.monitor import camera_status

log = logging.getLogger(__name__)

RETRY_S = 3.0


class DeviceConnector:
    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self.troubles: dict[str, str] = {}
        """Device → why it is not there."""

    async def run(self) -> None:
        """Everything at once: none waits for another."""
        await asyncio.gather(
            self._start_worker(),
            self._until_open("robot", self._open_robot),
            self._until_open("camera", self._open_camera),
            self._until_open("trigger", self._open_trigger),
        )

    async def _start_worker(self) -> None:
        try:
            await self._context.workers.start()
        except WorkerError as error:
            log.warning("%s", error)

    async def _until_open(self, device: str, opening: Callable[[], Awaitable[None]]) -> None:
        while True:
            try:
                await opening()
            except Exception as error:
                if not isinstance(error, StationError):
                    log.exception("%s could not be opened", device)
                if self.troubles.get(device) != str(error):
                    self.troubles[device] = str(error)
                    self._context.store.event(f"{device}: {error}", "warning")
                await asyncio.sleep(RETRY_S)
            else:
                self.troubles.pop(device, None)
                return

    async def _open_robot(self) -> None:
        identity = await self._context.cell.robot.connect()
        self._context.store.event(f"robot {identity.model} {identity.serial} found")

    async def _open_camera(self) -> None:
        identity = await self._context.cell.camera.open()
        model = self._context.cell.config.camera.model
        width, height = (model.width, model.height) if model else (0, 0)
        self._context.store.update(camera=camera_status(self._context, True, width, height, 0))
        self._context.store.event(f"camera {identity.model} {identity.serial} found")

    async def _open_trigger(self) -> None:
        if (trigger := self._context.cell.trigger) is not None:
            identity = await trigger.open()
            self._context.store.update(trigger=TriggerStatus(present=True, identity=identity))
            self._context.store.event(f"trigger {identity} found")

    async def close(self) -> None:
        cell = self._context.cell
        for closing in (cell.camera.close(), cell.robot.close()):
            with contextlib.suppress(RobotError, CameraError):
                await closing
        if cell.trigger is not None:
            await cell.trigger.close()
        await asyncio.to_thread(cell.ended)
