"""The real daemon in front of a simulated controller that outlives it: python -m tests.system.cell_daemon …

`station serve --simulate` owns its controller, which ends with it; here a test can look at the arm of a
daemon that was killed. CELL_TOLD: another truth, that the configuration is made from. CELL_CONTROL: what
drives the arm.
"""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

import msgspec

from station.cli.serve import log_to_stderr, serve_cell
from station.devices.cell import Cell
from station.devices.ur import UrRobot
from station.simulation.camera import RenderedCamera
from station.simulation.cell import read_truth
from station.simulation.scenes import cell_config


def main() -> None:
    host, truth_file, root, socket = sys.argv[1:5]
    log_to_stderr()
    truth = read_truth(Path(truth_file))
    config = cell_config(read_truth(Path(os.environ.get("CELL_TOLD", truth_file))), host)
    capture = msgspec.structs.replace(config.capture, free_space_bytes=1)
    robot = msgspec.structs.replace(config.robot, control=os.environ.get("CELL_CONTROL"))
    config = msgspec.structs.replace(config, capture=capture, robot=robot)
    place = Path(root)
    cell = Cell(
        config=config,
        robot=UrRobot(config.robot, place),
        camera=RenderedCamera(truth, host, config.camera),
        source="simulated",
        attachments={"truth.json": Path(truth_file).read_bytes()},
    )
    asyncio.run(serve_cell(cell, place, Path(socket), end_with_stdin="INVOCATION_ID" not in os.environ))


if __name__ == "__main__":
    main()
