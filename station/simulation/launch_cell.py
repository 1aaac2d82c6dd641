"""Complete simulated cell for the daemon: truth, controller process, real driver, rendered camera."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import msgspec

from recordings.schema.messages import Mount
from station.cell.config import StationConfig, TriggerConfig
from station.devices.base import Camera
from station.devices.cell import Cell
from station.devices.serial_trigger import SerialTrigger
from station.simulation.cells import make_cell
from station.simulation.launch import start_controller
from station.simulation.truth import CellTruth, NoiseLevel, SceneName, write_truth

GIGE_PACKET_BYTES = 8996
TRUTH = "truth.json"


FREE_SPACE_BYTES = 200_000_000
"""Free disk space below which no pose is captured; small, so that demonstrations run anywhere."""


@dataclass(frozen=True)
class SimulationOptions:
    scene: SceneName = "paper"
    seed: int = 0
    noise: NoiseLevel = "low"
    mount: Mount = "eye-in-hand"
    time_scale: float = 1.0
    """Speed of simulated time; above 1 in tests only."""
    gige: bool = False
    """Simulate the camera over GigE Vision, in a network namespace with only `lo`."""
    hardware_trigger: bool = False
    """Trigger the camera by a simulated box on a pseudo terminal."""


def simulated_cell(options: SimulationOptions, folder: Path) -> Cell:
    """Make the cell and start its controller; blocking (a second). Raises StationError.

    `folder`: for truth and logs.
    """
    from station.devices.ur import UrRobot
    from station.simulation.cells import cell_config

    truth = make_cell(options.scene, options.seed, options.noise, options.mount)
    with ExitStack() as ends:
        host, attachments = start_cell(truth, folder, ends, options.time_scale)
        config = cell_config(truth, host)
        trigger: SerialTrigger | None = None
        changes: dict[str, object] = {}
        if options.hardware_trigger:
            from station.simulation.trigger import SimulatedTriggerBox

            box = ends.enter_context(SimulatedTriggerBox())
            trigger = SerialTrigger(TriggerConfig(box.port))
            config = msgspec.structs.replace(config, trigger=TriggerConfig(box.port))
            changes["trigger"] = "hardware"
        if options.gige:
            # The simulator has no test packets to negotiate a packet size with; loopback carries the largest.
            changes |= {"driver": "aravis", "device": "127.0.0.1", "packet_size": GIGE_PACKET_BYTES}
        config = msgspec.structs.replace(
            config,
            capture=msgspec.structs.replace(config.capture, free_space_bytes=FREE_SPACE_BYTES),
            camera=msgspec.structs.replace(config.camera, **changes),
        )
        camera, pulse = _camera(options, config, truth, folder, trigger, ends)
        if options.hardware_trigger:
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
        attachments=attachments,
        ended=started.close,
        own_simulator=True,
    )


def start_cell(
    truth: CellTruth, folder: Path, ends: ExitStack, time_scale: float = 1.0
) -> tuple[str, dict[str, bytes]]:
    """Start the controller; return its address, and what a recording has of the truth.

    `folder` takes the truth and logs. Raises StationError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / TRUTH
    write_truth(truth, file)
    log = folder / "controller.log"
    controller = start_controller(truth.robot_model, truth=file, time_scale=time_scale, log=log)
    return ends.enter_context(controller).host, {TRUTH: file.read_bytes()}


def _camera(
    options: SimulationOptions,
    config: StationConfig,
    truth: CellTruth,
    folder: Path,
    trigger: SerialTrigger | None,
    ends: ExitStack,
) -> tuple[Camera, Callable[[], None]]:
    """Make the camera, and the function that an edge on its trigger line calls."""
    if not options.gige:
        from station.simulation.camera import RenderedCamera

        rendered = RenderedCamera(truth, config.robot.host, config.camera, trigger)
        return rendered, rendered.pulse
    from station.devices.aravis import AravisCamera
    from station.simulation.launch import start_gige

    serial, log = f"SIM{options.seed:05d}", folder / "camera.log"
    gige = start_gige(config.robot.host, truth=folder / TRUTH, serial=serial, log=log)
    simulator = ends.enter_context(gige)
    return AravisCamera(config.camera, trigger), lambda: simulator.inject("pulse")
