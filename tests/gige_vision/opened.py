"""A GenICam camera on this host, opened by the station's driver."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from station.cell.config import CameraConfig
from station.devices.aravis import AravisCamera


@asynccontextmanager
async def opened(box: Any = None, /, **config: Any) -> AsyncIterator[AravisCamera]:
    camera = AravisCamera(CameraConfig(**({"device": "127.0.0.1", "exposure_us": 1000.0} | config)), box)
    try:
        await camera.open()
        yield camera
    finally:
        await camera.close()
