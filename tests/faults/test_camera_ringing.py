"""A camera bracket that rings on while the joints rest: the picture shows it."""

from __future__ import annotations

import pytest

from station.analysis.worker import image_motion
from station.simulation.camera import RenderedCamera
from station.simulation.cells import make_cell

pytestmark = pytest.mark.process


async def motion_px(camera: RenderedCamera) -> float:
    looks = [await camera.glimpse() for _ in range(3)]
    found = image_motion([look.pixels for look in looks if look is not None], make_cell().camera.width)
    assert found is not None
    return found


async def test_a_resting_camera_shows_no_motion_and_a_ringing_one_does(camera: RenderedCamera) -> None:
    assert await motion_px(camera) < 0.25
    await camera.inject("ringing", {"amplitude_rad": 0.004, "frequency_hz": 6.3})
    assert max([await motion_px(camera) for _ in range(3)]) > 1.0
    await camera.inject("ringing")
    assert await motion_px(camera) < 0.25
