"""The real daemon in front of a simulated controller that outlives it: python -m tests.system.cell_daemon …

`station serve --simulate` owns its controller, which ends with it; here a test can look at the arm of a
daemon that was killed. CELL_CONTROL: what drives the arm.
CELL_SOURCE: `real` lets only approve whom a real arm's daemon would, of the simulated arm all the same.
CELL_SERVICE: the user whose programs may approve by the hash.
CELL_HANGS: `camera` or `disk` hangs for ever, from the second image or the first view on.
"""

from __future__ import annotations

import asyncio
import os
import sys
import threading
from pathlib import Path

import msgspec

from recordings.schema.messages import Image
from station.cell.session_folder import SessionState
from station.cli.serve import log_to_stderr, serve_cell
from station.devices.base import DeviceThread
from station.devices.cell import Cell
from station.devices.ur import UrRobot
from station.session import recording as session_recording
from station.simulation.camera import RenderedCamera
from station.simulation.cells import cell_config
from station.simulation.truth import read_truth


class HangingCamera(RenderedCamera):
    """Its driver takes one image and never returns from the next."""

    _driver: DeviceThread | None = None

    async def capture(self, timeout_s: float = 5.0) -> Image:
        if self._driver is not None:
            await self._driver.run(threading.Event().wait)
        self._driver = DeviceThread("hanging driver")
        return await super().capture(timeout_s)

    async def close(self) -> None:
        if self._driver is not None:
            await self._driver.close(lambda: None)


def let_the_disk_hang() -> None:
    """No state of a session with a view is ever written."""
    write = session_recording.write_state

    def writes(folder: Path, state: SessionState) -> None:
        if any(pose.state == "done" for pose in state.poses):
            threading.Event().wait()
        write(folder, state)

    session_recording.write_state = writes


def main() -> None:
    host, truth_file, root, socket = sys.argv[1:5]
    log_to_stderr()
    truth = read_truth(Path(truth_file))
    config = cell_config(truth, host)
    capture = msgspec.structs.replace(config.capture, free_space_bytes=1)
    robot = msgspec.structs.replace(config.robot, control=os.environ.get("CELL_CONTROL"))
    services = tuple(filter(None, [os.environ.get("CELL_SERVICE")]))
    approval = msgspec.structs.replace(config.approval, services=services)
    config = msgspec.structs.replace(config, capture=capture, robot=robot, approval=approval)
    place, hangs = Path(root), os.environ.get("CELL_HANGS", "")
    if hangs == "disk":
        let_the_disk_hang()
    driver = UrRobot(config.robot, place)
    cell = Cell(
        config=config,
        arm=driver.link,
        mover=driver,
        camera=(HangingCamera if hangs == "camera" else RenderedCamera)(truth, host, config.camera),
        source="real" if os.environ.get("CELL_SOURCE") == "real" else "simulated",
        attachments={"truth.json": Path(truth_file).read_bytes()},
    )
    asyncio.run(serve_cell(cell, place, Path(socket), end_with_stdin="INVOCATION_ID" not in os.environ))


if __name__ == "__main__":
    main()
