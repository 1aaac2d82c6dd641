"""What the session relies on, held against every camera driver: `camera_drivers.DRIVERS`.

docs/contributor/drivers.md says how a new one gets in.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, suppress
from itertools import pairwise

import numpy as np
import pytest

from recordings.schema.messages import Image
from station.cell.errors import CameraError
from station.devices.base import Camera
from station.simulation.launch import SimulatedController, start_controller
from tests.codes import raises
from tests.patience import beats
from tests.station.devices.camera_drivers import DRIVERS, Driver

pytestmark = [pytest.mark.gige, pytest.mark.process]
LATE_S = 0.3


@pytest.fixture(scope="module")
def arm(request: pytest.FixtureRequest) -> Iterator[SimulatedController]:
    """Controller that a rendered camera looks from; in the network of the others, where there is one."""
    with suppress(pytest.skip.Exception):
        request.getfixturevalue("lonely_network")
    with start_controller() as running:
        yield running


@pytest.fixture(params=list(DRIVERS))
def driver(request: pytest.FixtureRequest) -> Iterator[Driver]:
    made = DRIVERS[request.param](request)
    with made.ends:
        yield made


@asynccontextmanager
async def opened(driver: Driver, camera: Camera | None = None) -> AsyncIterator[Camera]:
    camera = camera or driver.camera
    if driver.trigger is not None:
        await driver.trigger.open()
    try:
        identity = await camera.open()
        assert identity == camera.identity and identity.driver and identity.model and identity.serial
        yield camera
    finally:
        await camera.close()
        if driver.trigger is not None:
            await driver.trigger.close()


def require_sound(image: Image) -> None:
    """Pixels of a kind that can be recorded, and a time that says how good it is."""
    pixels = image.pixels
    assert pixels.dtype in (np.uint8, np.uint16) and pixels.flags.c_contiguous and pixels.size
    colour = pixels.ndim == 3
    assert (colour and pixels.shape[2] == 3) == (image.pixel_format == "BGR8")
    assert colour or image.pixel_format.startswith(("Mono", "Bayer"))
    assert (pixels.dtype == np.uint16) == image.pixel_format.startswith(("Mono10", "Mono12", "Mono16"))
    assert image.stamps.host_monotonic_ns and image.stamps.host_wall_ns
    assert image.time is not None and 0 < image.time.bound_s < 1


def require_answer(driver: Driver, image: Image, asked_ns: int, answered_ns: int) -> None:
    """It was exposed and came between question and answer, and its time is within its bound of the truth."""
    assert asked_ns <= image.stamps.host_monotonic_ns <= answered_ns
    middle_ns, bound_ns = image.time.host_monotonic_ns, image.time.bound_s * 1e9
    assert asked_ns - bound_ns <= middle_ns <= answered_ns + bound_ns
    if driver.truth_ns is not None:
        began_ns, ended_ns = driver.truth_ns(image)
        assert asked_ns <= began_ns <= ended_ns <= image.stamps.host_monotonic_ns
        assert abs(middle_ns - (began_ns + ended_ns) / 2) <= bound_ns


async def test_a_camera_that_is_not_open_says_so_and_can_be_closed(driver: Driver) -> None:
    assert driver.camera.counts().frames == 0
    await driver.camera.close()
    with pytest.raises(CameraError):
        await driver.camera.capture(timeout_s=1.0)
    await driver.camera.close()


async def test_each_capture_is_one_new_picture_with_its_time(driver: Driver) -> None:
    async with opened(driver) as camera:
        images, kept = [], []
        for _ in range(4):
            asked_ns = time.monotonic_ns()
            image = await camera.capture()
            require_sound(image)
            require_answer(driver, image, asked_ns, time.monotonic_ns())
            images.append(image)
            kept.append(image.pixels.copy())
        ids = [image.frame_id for image in images if image.frame_id is not None]
        assert len(set(ids)) == len(ids) in (0, 4)
        arrivals = [image.stamps.host_monotonic_ns for image in images]
        assert all(a < b for a, b in pairwise(arrivals))
        assert all(np.array_equal(i.pixels, k) for i, k in zip(images, kept, strict=True)), "a buffer reused"
        counts, timing = camera.counts(), camera.timing
        assert counts.frames >= 4 and counts.missing == 0
        assert timing.source == images[-1].time.source
        settings = json.loads(json.dumps(await camera.settings()))
        if "region" in settings:
            assert tuple(settings["region"][2:]) == images[0].pixels.shape[1::-1]


async def test_looks_do_not_disturb_a_capture(driver: Driver) -> None:
    async with opened(driver) as camera:
        await camera.capture()
        asked_ns = time.monotonic_ns()
        glimpse = await camera.glimpse()
        assert glimpse.pixels.size
        assert camera.identity.driver == "playback" or glimpse.stamps.host_monotonic_ns >= asked_ns
        both = await asyncio.gather(camera.capture(), camera.glimpse())
        assert all(image.pixels.size for image in both)
        asked_ns = time.monotonic_ns()
        require_answer(driver, await camera.capture(), asked_ns, time.monotonic_ns())
        assert camera.counts().missing == 0


async def test_a_picture_that_does_not_come_is_an_error_in_time_and_the_next_one_good(driver: Driver) -> None:
    if driver.silence is None:
        pytest.skip("what is played or rendered is never late")
    async with opened(driver) as camera:
        await camera.capture()
        async with driver.silence(), beats() as gone_on:
            with raises("no-image", CameraError):
                await camera.capture(timeout_s=LATE_S)
        assert len(gone_on) >= 5, "the daemon's loop goes on meanwhile"
        assert camera.counts().missing == 1
        asked_ns = time.monotonic_ns()
        require_answer(driver, await camera.capture(), asked_ns, time.monotonic_ns())


async def test_a_capture_that_is_given_up_does_not_disturb_the_next(driver: Driver) -> None:
    """STOP cancels a capture wherever it is; the frame that then comes is nobody's."""
    async with opened(driver) as camera:
        for wait_s in (0.0, 0.001, 0.003, 0.006, 0.012):
            await asyncio.wait({given_up := asyncio.create_task(camera.capture())}, timeout=wait_s)
            given_up.cancel()
            await asyncio.wait({given_up})
            asked_ns = time.monotonic_ns()
            require_answer(driver, await camera.capture(), asked_ns, time.monotonic_ns())


async def test_a_camera_that_was_closed_is_the_same_one_when_opened_again(driver: Driver) -> None:
    async with opened(driver) as camera:
        serial = camera.identity.serial
        await camera.capture()
    async with opened(driver) as camera:
        await camera.capture()
        assert camera.identity.serial == serial
