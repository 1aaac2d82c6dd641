"""Hardware for the wizard: the real driver before a simulated controller, a rendered camera."""

from __future__ import annotations

from multiprocessing import resource_tracker

from station.cell.config import CameraChoice, CameraConfig
from station.devices.base import Camera
from station.devices.guided import RealHardware
from station.simulation.camera import RenderedCamera
from station.simulation.truth import CellTruth

CAMERA = CameraChoice("aravis", "SIM00001", "MER-131-75GM SIM00001")


class SimulatedHardware(RealHardware):
    """The arm by its address as any other; the one camera there is looks at this truth."""

    def __init__(self, truth: CellTruth, host: str) -> None:
        self.truth, self.host = truth, host
        resource_tracker.ensure_running()  # a screen, which has no stderr to pass on, cannot start it

    async def cameras(self) -> tuple[CameraChoice, ...]:
        return (CAMERA,)

    async def camera(self, found: CameraChoice, exposure_us: float) -> Camera:
        camera = RenderedCamera(self.truth, self.host, CameraConfig(exposure_us=exposure_us))
        camera.glimpse = camera.capture  # of the size that a real camera's glimpse has
        await camera.open()
        return camera
