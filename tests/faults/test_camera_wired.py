"""A simulated cell whose trigger box fires the camera: pulses, frames and noise, paired by counters."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path

import pytest

from station.devices.cell import Cell
from station.simulation.camera import RenderedCamera
from station.simulation.cells import cell_config, make_cell
from station.simulation.launch_cell import simulated_cell
from tests.codes import raises

pytestmark = pytest.mark.process


@pytest.fixture
async def cell(tmp_path: Path) -> AsyncIterator[Cell]:
    truth = make_cell()
    made = await asyncio.to_thread(
        simulated_cell, truth, partial(cell_config, truth), tmp_path, hardware_trigger=True
    )
    assert made.trigger is not None
    assert await made.trigger.open() == "calibration-trigger SIM1"
    await made.camera.open()
    yield made
    await made.camera.close()
    await made.trigger.close()
    await asyncio.to_thread(made.ended)


async def test_19_pulses_and_frames_pair_by_counter_whatever_the_line_picks_up(cell: Cell) -> None:
    camera, box = cell.camera, cell.trigger
    assert isinstance(camera, RenderedCamera) and box is not None
    assert cell.config.camera.trigger == "hardware" and cell.config.trigger is not None
    assert [(await camera.capture()).trigger_count for _ in range(2)] == [1, 2]

    camera.pulse()  # noise between the box and the camera: a frame without a counted pulse
    await asyncio.sleep(0.5)
    with raises("surplus-frames", frames=1):
        await camera.capture()
    assert (await camera.capture()).trigger_count == 3

    await camera.inject("lost-frame")  # the box fired, the picture never came
    with raises("no-image"):
        await camera.capture(timeout_s=0.5)
    assert (await camera.capture()).trigger_count == 5
    assert box.pulses == 5 and camera.counts().paired == 4 and camera.counts().missing == 1
