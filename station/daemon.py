"""`station serve`: the daemon process, owner of cell, session and sockets; systemd, signals."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path

from recordings.schema.messages import Source
from station.cell.config import REAL_DRIVERS, StationConfig
from station.cell.errors import ConfigError
from station.cell.process import RealTimeThreads, freeze_startup
from station.cell.status import StationState
from station.devices.base import Camera
from station.devices.cell import Cell
from station.devices.serial_trigger import SerialTrigger
from station.server.connections import ClientServer
from station.server.dispatch import SessionDispatcher
from station.server.quitting import way_of_service
from station.server.stop_server import StopServer
from station.session.session import Session

log = logging.getLogger(__name__)

CONTROL_SERVED_S = 1.0
GATHER_S = 0.04
PING_S = 0.1
"""Period of pings to systemd's watchdog, far below any `WatchdogSec`."""


def notify(line: str) -> None:
    """Send 'READY=1', 'STATUS=…' to systemd (sd_notify), where it listens. Never blocks."""
    if not (address := os.environ.get("NOTIFY_SOCKET", "")):
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.setblocking(False)
        link.sendto(line.encode(), address)


class Daemon:
    def __init__(
        self,
        cell: Cell,
        root: Path,
        control: Path,
        told_to_end: Callable[[], None] = lambda: None,
        real_time: RealTimeThreads | None = None,
    ) -> None:
        """`told_to_end` is called when SIGTERM, SIGINT, `end` or the verb `quit` begins the shutdown."""
        self.session = Session(cell, root)
        service = way_of_service(os.getpid(), os.environ.get("NOTIFY_SOCKET", ""))
        dispatcher = SessionDispatcher(self.session, end=self.end, service=service)
        self._client_server = ClientServer(control, dispatcher)
        self._stop_server = StopServer(control, dispatcher)
        self.session.supervisor.before_round = self._stop_server.round
        self.session.supervisor.after_round = self._ping
        self._pinged_s = 0.0
        self._changed = asyncio.Event()
        self._ending, self._told_to_end = asyncio.Event(), told_to_end
        self._served_s = time.monotonic()
        self._said = ""
        self._real_time = real_time

    async def run(self, ready: Callable[[], None] = lambda: None) -> None:
        """Run until SIGTERM or SIGINT. `ready` is called once the socket listens. Raises StationError."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self.end)
        await self._client_server.start()
        try:
            self._stop_server.start()
            await self.session.start()
            self.session.store.watch(self._changed.set)
            freeze_startup()
            notify("READY=1")
            ready()
            telling = asyncio.create_task(self.session.kept_going(self._tell))
            await self._ending.wait()
            telling.cancel()
        finally:
            # The order matters: stop the arm, finish the recording, then tell the clients.
            await self.session.close()
            notify("STOPPING=1")
            await self._client_server.close()
            self._stop_server.close()
            log.info("ended")

    def end(self) -> None:
        if not self._ending.is_set():
            self._ending.set()
            self._told_to_end()

    async def _tell(self) -> None:
        """Send changes of the status to watchers, gathered for a moment."""
        while True:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(CONTROL_SERVED_S / 4):
                    await self._changed.wait()
            self._changed.clear()
            self._client_server.publish()
            self._tell_systemd()
            self._served_s = time.monotonic()
            await asyncio.sleep(GATHER_S)

    def _ping(self) -> None:
        """Ping systemd's watchdog, where there is one, only while event loop and recorder work."""
        if self._real_time is not None:
            self._real_time.sweep()
        now_s = time.monotonic()
        if now_s - self._pinged_s >= PING_S and self._healthy():
            self._pinged_s = now_s
            notify("WATCHDOG=1")

    def _healthy(self) -> bool:
        """Tell whether session and recorder work; systemd restarts the daemon if this stays false."""
        recorder = self.session.context.recorder
        writing = recorder is None or recorder.error is not None or recorder.alive
        return writing and time.monotonic() - self._served_s < CONTROL_SERVED_S

    def _tell_systemd(self) -> None:
        status = self.session.store.status
        text = status.state.value
        if status.session.poses and status.state is not StationState.IDLE:
            text += f", pose {status.session.captured} of {len(status.session.poses)}"
        if text != self._said:
            self._said = text
            notify(f"STATUS={text}")


def configured_cell(config: StationConfig, text: bytes, log_dir: Path, control: Path) -> Cell:
    """Make the cell of a configuration, not connected. ConfigError for devices that exclude each other.

    `control`: path of the control socket, beside which poses are posted.
    """
    trigger = None if config.trigger is None else SerialTrigger(config.trigger)
    camera, source = _camera(config, trigger)
    if config.robot.driver == "posted":
        from station.devices.posted import PostedArm

        arm = PostedArm(config, source, control)
        return Cell(config, arm, camera, source, trigger=trigger, config_text=text)
    from station.devices.ur import UrRobot

    robot = UrRobot(config.robot, log_dir)
    return Cell(config, robot.link, camera, source, mover=robot, trigger=trigger, config_text=text)


def _camera(config: StationConfig, trigger: SerialTrigger | None) -> tuple[Camera, Source]:
    if config.camera.driver == "aravis":
        from station.devices.aravis import AravisCamera

        return AravisCamera(config.camera, trigger), "real"
    if config.camera.driver == "webcam":
        from station.devices.webcam import WebcamCamera

        return WebcamCamera(config.camera), "real"
    raise ConfigError("unreal-camera", driver=config.camera.driver, drivers=" or ".join(REAL_DRIVERS))
