"""Complete simulated cell for the daemon: controller process, real driver, rendered camera."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import msgspec

from station.cell.config import StationConfig, TriggerConfig
from station.devices.base import Camera
from station.devices.cell import Cell
from station.devices.serial_trigger import SerialTrigger
from station.devices.ur import UrRobot
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
    hardware_trigger: bool = False,
    path: str = "",
    attachments: dict[str, bytes] | None = None,
) -> Cell:
    """Make a cell that is as `truth` says and start its controller; blocking (a second). Raises StationError.

    `configured`: its configuration for a controller's address; `path`: the file that it comes from. `folder`
    takes truth and logs. `time_scale`: speed of simulated time; above 1 in tests only. `gige`: simulate the
    camera over GigE Vision, in a network namespace with only `lo`. `hardware_trigger`: trigger it by a
    simulated box on a pseudo terminal. `attachments`: of every recording, besides the truth.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file, log = folder / TRUTH, folder / "controller.log"
    write_truth(truth, file)
    with ExitStack() as ends:
        controller = start_controller(truth.robot_model, truth=file, time_scale=time_scale, log=log)
        config = configured(ends.enter_context(controller).host)
        trigger: SerialTrigger | None = None
        changes: dict[str, object] = {}
        if hardware_trigger:
            from station.simulation.trigger import SimulatedTriggerBox

            box = ends.enter_context(SimulatedTriggerBox())
            trigger, changes["trigger"] = SerialTrigger(TriggerConfig(box.port)), "hardware"
            config = msgspec.structs.replace(config, trigger=TriggerConfig(box.port))
        if gige:
            # The simulator has no test packets to negotiate a packet size with; loopback carries the largest.
            changes |= {"driver": "aravis", "device": "127.0.0.1", "packet_size": GIGE_PACKET_BYTES}
        camera_config = msgspec.structs.replace(config.camera, **changes)
        config = msgspec.structs.replace(config, camera=camera_config)
        make = _gige if gige else _rendered
        camera, pulse = make(config, truth, folder, trigger, ends)
        if hardware_trigger:
            box.on_pulse = pulse
        started = ends.pop_all()
    robot = UrRobot(config.robot, folder)
    return Cell(
        config=config,
        robot=robot,
        mover=robot,
        camera=camera,
        source="simulated",
        trigger=trigger,
        config_path=path,
        attachments={TRUTH: file.read_bytes()} | (attachments or {}),
        ended=started.close,
        own_simulator=True,
    )


_Made = tuple[Camera, Callable[[], None]]
"""A camera, and the function that an edge on its trigger line calls"""


def _rendered(
    config: StationConfig, truth: CellTruth, folder: Path, trigger: SerialTrigger | None, ends: ExitStack
) -> _Made:
    from station.simulation.camera import RenderedCamera

    camera = RenderedCamera(truth, config.robot.host, config.camera, trigger)
    return camera, camera.pulse


def _gige(
    config: StationConfig, truth: CellTruth, folder: Path, trigger: SerialTrigger | None, ends: ExitStack
) -> _Made:
    from station.devices.aravis import AravisCamera
    from station.simulation.launch import start_gige

    serial, log = f"SIM{truth.seed:05d}", folder / "camera.log"
    gige = start_gige(config.robot.host, truth=folder / TRUTH, serial=serial, log=log)
    simulator = ends.enter_context(gige)
    return AravisCamera(config.camera, trigger), lambda: simulator.inject("pulse")
