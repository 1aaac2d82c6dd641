"""The simulated GigE camera shows the simulated cell, and runs only where it disturbs nobody."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from calibrate.boards.detect import detect
from station.simulation.cells import make_cell
from station.simulation.launch import SimulatedController, start_gige
from station.simulation.netns import is_isolated, isolated_command
from station.simulation.truth import write_truth
from tests.codes import raises
from tests.gige_vision.opened import opened


def test_it_does_not_run_beside_other_networks() -> None:
    if is_isolated():
        pytest.skip("this machine has nothing but lo")
    with raises("not-isolated"):
        start_gige("", Path(), "")


@pytest.mark.gige
@pytest.mark.process
async def test_its_pictures_show_the_board_from_where_the_arm_stands(
    lonely_network: None, controller: Callable[..., SimulatedController], tmp_path: Path
) -> None:
    cell = make_cell(seed=2)
    write_truth(cell, tmp_path / "truth.json")
    arm = controller(truth=tmp_path / "truth.json")
    with start_gige(arm.host, tmp_path / "truth.json", "SIM00002"):
        async with opened(packet_size=8996, exposure_us=10_000.0) as camera:
            picture = await camera.capture()
            assert detect(picture.pixels, cell.board).found


def test_a_command_can_be_run_with_nothing_but_lo() -> None:
    code = "from station.simulation.netns import is_isolated; print(is_isolated())"
    done = subprocess.run(
        isolated_command([sys.executable, "-c", code]), capture_output=True, text=True, timeout=30
    )
    if done.returncode != 0:
        pytest.skip(f"no network namespaces here: {done.stderr.strip()}")
    assert done.stdout.strip() == "True"
