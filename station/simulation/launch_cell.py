"""A whole simulated cell for the daemon: truth, controller child, real driver, rendered camera."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from recordings.schema.messages import Mount
from station.cell.config import ControlPath, StationConfig, TriggerConfig
from station.cell.errors import ConfigError, StationError
from station.devices.base import Camera, Trigger
from station.devices.cell import Cell
from station.simulation.cell import CellTruth, NoiseLevel, SceneName, write_truth
from station.simulation.launch import start_controller
from station.simulation.scenes import make_cell

if TYPE_CHECKING:
    from station.simulation.trigger import SimulatedTriggerBox

GIGE_PACKET_BYTES = 8996


@dataclass(frozen=True)
class SimulationOptions:
    scene: SceneName = "paper"
    seed: int = 0
    noise: NoiseLevel = "low"
    mount: Mount = "eye-in-hand"
    time_scale: float = 1.0
    """Above 1 only in tests: real time is what is demonstrated."""
    gige: bool = False
    """The camera over GigE Vision, in a network namespace with only `lo`."""
    hardware_trigger: bool = False
    """A trigger box on a pseudo terminal fires the camera."""
    frame_rate_hz: float = 0.0
    """With `gige`: free-running at this rate. Drawing takes longer than a frame, so its images are numbered
    ones of the board as the camera sees it from where the arm starts."""
    control: ControlPath | None = None
    """Driver of the arm; None = what is installed."""
    robot: str = "UR10"
    """Another arm at the same place; its own start shows the board for seed 0."""
    free_space_bytes: int = 200_000_000
    """A demonstration must run on a small disk."""


def simulated_cell(options: SimulationOptions, folder: Path) -> Cell:
    """Starts the controller; blocking (a second). `folder` takes the truth and logs. Raises StationError."""
    from station.devices.ur import UrRobot
    from station.simulation.scenes import cell_config

    if options.frame_rate_hz and (options.hardware_trigger or not options.gige):
        raise ConfigError(
            "a simulated camera runs freely only over GigE, and without a trigger box",
            code="simulation-options",
        )
    folder.mkdir(parents=True, exist_ok=True)
    truth = make_cell(options.scene, options.seed, options.noise, options.mount)
    truth = msgspec.structs.replace(truth, robot_model=options.robot)
    truth_file = folder / "truth.json"
    write_truth(truth, truth_file)
    ends = ExitStack()
    controller = ends.enter_context(
        start_controller(
            truth.robot_model,
            truth=truth_file,
            time_scale=options.time_scale,
            log=folder / "controller.log",
        )
    )
    config = cell_config(truth, controller.host)
    capture = msgspec.structs.replace(config.capture, free_space_bytes=options.free_space_bytes)
    robot = msgspec.structs.replace(config.robot, model=options.robot, control=options.control)
    config = msgspec.structs.replace(config, capture=capture, robot=robot)
    box: SimulatedTriggerBox | None = None
    trigger: Trigger | None = None
    try:
        if options.hardware_trigger:
            from station.devices.serial_trigger import SerialTrigger
            from station.simulation.trigger import SimulatedTriggerBox

            box = ends.enter_context(SimulatedTriggerBox())
            camera_config = msgspec.structs.replace(config.camera, trigger="hardware")
            config = msgspec.structs.replace(config, camera=camera_config, trigger=TriggerConfig(box.port))
            trigger = SerialTrigger(TriggerConfig(box.port))
        config, camera, pulse = _camera(options, config, truth, truth_file, trigger, ends)
    except StationError:
        ends.close()
        raise
    if box is not None:
        box.on_pulse = pulse
    return Cell(
        config=config,
        robot=UrRobot(config.robot, folder),
        camera=camera,
        source="simulated",
        trigger=trigger,
        attachments={"truth.json": truth_file.read_bytes()},
        ended=ends.close,
    )


def _camera(
    options: SimulationOptions,
    config: StationConfig,
    truth: CellTruth,
    truth_file: Path,
    trigger: Trigger | None,
    ends: ExitStack,
) -> tuple[StationConfig, Camera, Callable[[], None]]:
    """The configuration with the camera it is about, and what an edge on its trigger line does."""
    if not options.gige:
        from station.simulation.camera import RenderedCamera

        rendered = RenderedCamera(truth, config.robot.host, config.camera, trigger)
        return config, rendered, rendered.pulse
    from station.devices.aravis import AravisCamera
    from station.simulation.launch import start_gige

    free = options.frame_rate_hz > 0
    serial = f"SIM{options.seed:05d}"
    simulator = ends.enter_context(
        start_gige(config.robot.host, truth=truth_file, serial=serial, numbered=free)
    )
    # The simulator has no test packets to negotiate the packet size with; loopback carries the largest.
    over_gige = msgspec.structs.replace(
        config.camera, driver="aravis", device="127.0.0.1", packet_size=GIGE_PACKET_BYTES
    )
    if free:
        over_gige = msgspec.structs.replace(
            over_gige,
            trigger="free-running",
            frame_rate_hz=options.frame_rate_hz,
            exposure_us=min(over_gige.exposure_us, 0.5e6 / options.frame_rate_hz),
        )
    config = msgspec.structs.replace(config, camera=over_gige)
    return config, AravisCamera(over_gige, trigger), lambda: simulator.inject("pulse")
