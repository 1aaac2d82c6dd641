"""Opening of the cell's devices, again and again until each is there, and closing."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable

from station.cell.errors import CameraError, RefusedError, RobotError, StationError
from station.cell.status import CameraStatus, TriggerStatus
from station.session.context import SessionContext

log = logging.getLogger(__name__)

RETRY_S = 3.0


class DeviceConnector:
    """Background task that opens all devices (read-only), with retries, and closes them at the end."""

    def __init__(self, context: SessionContext) -> None:
        self._context = context
        self.troubles: dict[str, str] = {}
        """Device → error of its last opening."""

    async def run(self) -> None:
        """Open all devices in parallel."""
        await asyncio.gather(
            self._until_open("worker", self._context.workers.start),
            self._until_open("robot", self._open_robot),
            self._until_open("camera", self._open_camera),
            self._until_open("trigger", self._open_trigger),
        )

    async def _until_open(self, device: str, opening: Callable[[], Awaitable[None]]) -> None:
        while True:
            try:
                await opening()
            except Exception as error:
                if not isinstance(error, StationError):
                    log.exception("%s could not be opened", device)
                if self.troubles.get(device) != str(error):
                    self.troubles[device] = str(error)
                    self._context.store.problem(error, said=f"{device}: {{}}")
                await asyncio.sleep(RETRY_S)
            else:
                self.troubles.pop(device, None)
                return

    async def _open_robot(self) -> None:
        identity = await self._context.cell.arm.connect()
        self._found("robot", f"{identity.model} {identity.serial}")

    async def _open_camera(self) -> None:
        identity = await self._context.cell.camera.open()
        self._context.store.update(camera=CameraStatus(identity))
        self._found("camera", f"{identity.model} {identity.serial}")

    async def _open_trigger(self) -> None:
        if (trigger := self._context.cell.trigger) is not None:
            identity = await trigger.open()
            self._context.store.update(trigger=TriggerStatus(identity))
            self._found("trigger", identity)

    def _found(self, device: str, identity: str) -> None:
        store = self._context.store
        store.event("device-found", f"{device} {identity} found", device=device)
        try:
            self._context.require_same_cell(connected=False)
        except RefusedError as elsewhere:  # of an interrupted session; only now the device says who it is
            store.problem(elsewhere)
            if store.status.cause == "interrupted":
                store.update(reason=str(elsewhere))

    async def close(self) -> None:
        """Close all devices in parallel, so that a hanging camera does not delay the robot's."""
        cell = self._context.cell

        async def close_robot() -> None:
            with contextlib.suppress(RobotError):
                await cell.arm.close()

        async def close_camera() -> None:
            with contextlib.suppress(CameraError):
                await cell.camera.close()
            if cell.trigger is not None:
                await cell.trigger.close()

        await asyncio.gather(close_robot(), close_camera())
