"""Complete simulated cell for the daemon: controller process, real driver, rendered camera."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import msgspec

from station.cell.config import StationConfig
from station.devices.base import Camera
from station.devices.cell import Cell
from station.devices.ur import UrRobot
from station.simulation.camera import RenderedCamera
from station.simulation.launch import start_controller
from station.simulation.truth import CellTruth, write_truth

GIGE_PACKET_BYTES = 8996
TRUTH = "truth.json"


def simulated_cell(
    truth: CellTruth,
    configured: Callable[[str], StationConfig],
    folder: Path,
    *,
    time_scale: float = 1.0,
    gige: bool = False,
    path: str = "",
    attachments: dict[str, bytes] | None = None,
) -> Cell:
    """Make a cell that is as `truth` says and start its controller; blocking (a second). Raises StationError.

    `configured`: its configuration for a controller's address; `path`: the file that it comes from. `folder`
    takes truth and logs. `time_scale`: speed of simulated time; above 1 in tests only. `gige`: simulate the
    camera over GigE Vision, in a network namespace with only `lo`. `attachments`: of every recording, besides
    the truth.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file, log = folder / TRUTH, folder / "controller.log"
    content = write_truth(truth, file)
    with ExitStack() as ends:
        controller = start_controller(truth.robot_model, truth=file, time_scale=time_scale, log=log)
        camera: Camera
        config = configured(ends.enter_context(controller).host)
        if gige:
            # The simulator has no test packets to negotiate a packet size with; loopback carries the largest.
            changes = {"driver": "aravis", "device": "127.0.0.1", "packet_size": GIGE_PACKET_BYTES}
            seen = msgspec.structs.replace(config.camera, **changes)
            config = msgspec.structs.replace(config, camera=seen)
            camera = _gige(config, truth, folder, ends)
        else:
            camera = RenderedCamera(truth, config.robot.host, config.camera)
        started = ends.pop_all()
    robot = UrRobot(config.robot, folder)
    return Cell(
        config=config,
        robot=robot,
        mover=robot,
        camera=camera,
        source="simulated",
        config_path=path,
        attachments={TRUTH: content} | (attachments or {}),
        ended=started.close,
        own_simulator=True,
    )


def _gige(config: StationConfig, truth: CellTruth, folder: Path, ends: ExitStack) -> Camera:
    from station.devices.aravis import AravisCamera
    from station.simulation.launch import start_gige

    serial, log = f"SIM{truth.seed:05d}", folder / "camera.log"
    ends.enter_context(start_gige(config.robot.host, truth=folder / TRUTH, serial=serial, log=log))
    return AravisCamera(config.camera)
