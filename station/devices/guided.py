"""Devices of a cell that is being set up: they are read and shown, and the arm only stopped."""

from __future__ import annotations

import asyncio
import contextlib

from calibrate.kinematics import MODELS
from station.cell.config import CameraChoice, CameraConfig, RobotConfig
from station.cell.errors import RobotError
from station.devices.aravis import AravisCamera
from station.devices.base import Camera
from station.devices.discovery import discover, discover_usb
from station.devices.ur_dashboard import STOP, STOPPED
from station.devices.ur_link import UrLink
from station.devices.ur_probe import identify, open_dashboard, unsupported_model
from station.devices.webcam import WebcamCamera, discover_webcams


class GuidedArm(UrLink):
    """The read-only half of the driver, and STOP."""

    def trouble(self) -> str:
        """Why the arm cannot be guided now, and what to do on the pendant; empty: nothing."""
        try:
            return self.condition(self.latest()).held
        except RobotError as problem:
            return str(problem)

    async def stop(self) -> None:
        """STOP, by the dashboard: it ends whatever program runs on the controller. RobotError if refused."""
        said = ""
        if self.dashboard is not None:
            with contextlib.suppress(RobotError):
                said = await self.dashboard.ask(STOP)
        if said != STOPPED:  # dead, or opened in local control: refused even after the switch to remote
            said = await (await self.renew_dashboard()).ask(STOP)
        if said != STOPPED:
            raise RobotError("stop-refused", answer=said)


class RealHardware:
    """The devices of this computer and its network."""

    async def arm(self, host: str) -> GuidedArm:
        """Connect for reading only. Raises RobotError that names the pendant's menu items.

        `host` may be followed by the model, for a controller that does not tell it.
        """
        address, _, told = host.partition(" ")
        dashboard = await open_dashboard(address)
        found = await identify(dashboard)
        await dashboard.close()
        model = told or found.model
        if found.model and found.model not in MODELS:
            raise unsupported_model(found.model, address)
        if model not in MODELS:
            raise RobotError("model-not-told", host=address, known=", ".join(MODELS))
        arm = GuidedArm(RobotConfig(model=model, host=address))
        await arm.connect()
        return arm

    async def cameras(self) -> tuple[CameraChoice, ...]:
        """Cameras that answer now. Raises CameraError."""
        network, usb = await asyncio.to_thread(lambda: (discover(), discover_usb()))
        known = [(c.model, c.serial) for c in network] + [(c.model, c.serial) for c in usb]
        genicam = [CameraChoice("aravis", serial, f"{model} {serial}") for model, serial in known]
        webcams = [CameraChoice("webcam", node, f"{name}, webcam") for node, name in discover_webcams()]
        return (*genicam, *webcams)

    async def camera(self, found: CameraChoice, exposure_us: float) -> Camera:
        """Open it with this exposure time. Raises CameraError."""
        driver = AravisCamera if found.driver == "aravis" else WebcamCamera
        camera = driver(CameraConfig(driver=found.driver, device=found.device, exposure_us=exposure_us))
        await camera.open()
        return camera
