"""Hardware for the wizard: the real driver before a simulated controller, a rendered camera."""

from __future__ import annotations

from recordings.schema.messages import Image
from station.cell.config import CameraConfig
from station.cli.new import RealHardware
from station.operate.draft import CameraChoice, CameraReader
from station.simulation.camera import RenderedCamera
from station.simulation.truth import CellTruth

CAMERA = CameraChoice("aravis", "SIM00001", "MER-131-75GM SIM00001")


class RenderedReader:
    """`draft.CameraReader` of what the simulated arm shows."""

    def __init__(self, truth: CellTruth, host: str) -> None:
        self._truth, self._host = truth, host
        self.exposure_us = 10_000.0
        self.camera = RenderedCamera(truth, host, CameraConfig(exposure_us=self.exposure_us))

    async def glimpse(self) -> Image:
        return await self.camera.capture()

    async def expose(self, exposure_us: float) -> None:
        if exposure_us != self.exposure_us:
            await self.camera.close()
            self.exposure_us = exposure_us
            self.camera = RenderedCamera(self._truth, self._host, CameraConfig(exposure_us=exposure_us))
            await self.camera.open()

    async def close(self) -> None:
        await self.camera.close()


class SimulatedHardware(RealHardware):
    """The arm by its address as any other; the one camera there is looks at this truth."""

    def __init__(self, truth: CellTruth, host: str) -> None:
        self.truth, self.host = truth, host

    async def cameras(self) -> tuple[CameraChoice, ...]:
        return (CAMERA,)

    async def camera(self, found: CameraChoice) -> CameraReader:
        reader = RenderedReader(self.truth, self.host)
        await reader.camera.open()
        return reader
