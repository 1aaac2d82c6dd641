"""Devices of a cell that is being set up: they are read and shown, and the arm only stopped."""

from __future__ import annotations

import asyncio

from station.cell.config import CameraChoice, CameraConfig
from station.cell.errors import CameraError
from station.devices.aravis import AravisCamera
from station.devices.aravis_device import genicam_problem
from station.devices.base import Camera
from station.devices.discovery import discover, discover_usb
from station.devices.ur import GuidedArm
from station.devices.webcam import WebcamCamera, discover_webcams


class RealHardware:
    """The devices of this computer and its network."""

    async def arm(self, host: str) -> GuidedArm:
        """Connect for reading only. Raises RobotError that names the pendant's menu items.

        `host` may be followed by the model, for a controller that does not tell it.
        """
        return await GuidedArm.connected_to(host)

    async def cameras(self) -> tuple[CameraChoice, ...]:
        """Cameras that answer now. Raises CameraError."""
        network, usb = await asyncio.to_thread(lambda: (discover(), discover_usb()))
        known = [(c.model, c.serial) for c in network] + [(c.model, c.serial) for c in usb]
        genicam = [CameraChoice("aravis", serial, f"{model} {serial}") for model, serial in known]
        webcams = [CameraChoice("webcam", node, f"{name}, webcam") for node, name in discover_webcams()]
        return (*genicam, *webcams)

    async def genicam_problem(self) -> CameraError | None:
        """Return why no GenICam camera can be opened here, whatever is connected; None: one can."""
        return await asyncio.to_thread(genicam_problem)

    async def camera(self, found: CameraChoice, exposure_us: float) -> Camera:
        """Open it with this exposure time. Raises CameraError."""
        driver = AravisCamera if found.driver == "aravis" else WebcamCamera
        camera = driver(CameraConfig(driver=found.driver, device=found.device, exposure_us=exposure_us))
        await camera.open()
        return camera
