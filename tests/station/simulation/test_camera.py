"""The rendered camera against a real simulated controller: pictures of where the arm truly is."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator

import numpy as np
import pytest

from calibrate.boards.detect import detect
from recordings.schema.messages import Image
from station.cell.errors import CameraError
from station.simulation.camera import RenderedCamera
from station.simulation.cells import make_cell
from station.simulation.launch import AdminClient, SimulatedController, start_controller
from station.simulation.truth import CellTruth, write_truth
from tests.codes import raises
from tests.patience import until
from tests.station.true_camera import board_seen

pytestmark = pytest.mark.process


def mid_exposure(picture: Image) -> tuple[int, float]:
    assert picture.time is not None and picture.time.source == "latched"
    return picture.time.host_monotonic_ns, picture.time.bound_s


@pytest.fixture(scope="module")
def cell() -> CellTruth:
    return make_cell(seed=3)


@pytest.fixture(scope="module")
def arm(cell: CellTruth, tmp_path_factory: pytest.TempPathFactory) -> Iterator[SimulatedController]:
    """One for all tests of this module: nothing here moves it."""
    truth = tmp_path_factory.mktemp("cell") / "truth.json"
    write_truth(cell, truth)
    with start_controller(truth=truth) as running:
        yield running


@pytest.fixture
async def camera(arm: SimulatedController, cell: CellTruth) -> AsyncIterator[RenderedCamera]:
    rendered = RenderedCamera(cell, arm.host)
    await rendered.open()
    yield rendered
    await rendered.close()


async def test_pictures_show_the_board_from_the_true_pose_at_mid_exposure(
    camera: RenderedCamera, arm: SimulatedController, cell: CellTruth
) -> None:
    picture = await camera.capture()
    assert picture.pixels.shape == (1024, 1280) and picture.pixels.dtype == np.uint8
    middle_ns, bound_s = mid_exposure(picture)
    assert 0 < bound_s < 0.02
    with AdminClient(arm.host) as admin:
        flange = np.array(admin.ask("truth", at_monotonic_ns=middle_ns)["base_from_flange"])
    view = board_seen(cell, flange)
    seen = detect(picture.pixels, cell.board)
    assert seen.found, seen.reason
    ray = view[:3, 3]
    first = seen.corners.pixels[np.flatnonzero(seen.corners.ids == 0)[0]]
    expected = [cell.camera.matrix[i][i] * ray[i] / ray[2] + cell.camera.matrix[i][2] for i in range(2)]
    assert np.linalg.norm(first - expected) < 3.0, "distortion moves it by a pixel or two at most"


async def test_without_a_controller_the_camera_says_so(cell: CellTruth) -> None:
    rendered = RenderedCamera(cell, "127.254.253.252")
    await rendered.open()
    try:
        for look in (rendered.capture, rendered.glimpse):
            with raises("camera-refused"):
                await look()
    finally:
        await rendered.close()


async def test_one_that_died_is_opened_again(camera: RenderedCamera) -> None:
    assert camera._workers is not None and camera._workers._pool is not None
    await camera.capture()
    for process in camera._workers._pool._processes.values():
        process.kill()
    with raises("camera-gone"):
        await camera.capture()
    await camera.capture()
    looking = asyncio.create_task(camera.glimpse())
    await until(lambda: camera._workers.waiting)
    looking.cancel()  # as of a screen that closes
    await camera.capture()
    assert camera.counts().missing == 0, "it is still the same, and counts from its own first image"


async def test_one_that_is_closed_during_a_capture_stays_closed(camera: RenderedCamera) -> None:
    taking = asyncio.create_task(camera.capture())
    await until(lambda: camera._workers is not None and camera._workers.waiting)
    await camera.close()
    with pytest.raises(CameraError):  # gone in the midst of a call, or not open for the next one
        await taking
    with raises("not-open"):
        await camera.capture()


async def test_while_it_starts_nothing_is_said_of_its_clock(
    arm: SimulatedController, cell: CellTruth, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Doctor would call a clock missing that is only not read yet."""
    rendered, call = RenderedCamera(cell, arm.host), RenderedCamera._call
    while_starting = []

    async def called(camera: RenderedCamera, *request: object, **limit: float) -> object:
        while_starting.append(camera.timing)
        return await call(camera, *request, **limit)

    monkeypatch.setattr(RenderedCamera, "_call", called)
    opening = asyncio.create_task(rendered.open())
    while not while_starting:
        await asyncio.sleep(0.001)
    await rendered.glimpse()
    assert while_starting[0] is None
    assert rendered.timing is not None and rendered.timing.source == "latched"
    await opening
    await rendered.close()
