"""A whole simulated cell for the daemon: truth, controller child, real driver, rendered camera."""

from __future__ import annotations

from collections.abc import Callable
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
    """With `gige`: free-running at this rate. Drawing takes longer than a frame, so its pictures are numbered
    ones of the board as the camera sees it from where the arm starts."""
    control: ControlPath | None = None
    """What drives the arm; None = what is installed."""
    robot: str = "UR10"
    """Another arm at the same place; its own start shows the board for seed 0."""
    free_space_bytes: int = 200_000_000
    """A demonstration must run on a small disk."""


def simulated_cell(options: SimulationOptions, folder: Path) -> Cell:
    """Starts the controller; blocking (a second). `folder` takes the truth and logs. Raises StationError."""
    from station.devices.ur import UrRobot
    from station.simulation.scenes import cell_config

    if options.frame_rate_hz and (options.hardware_trigger or not options.gige):
        raise ConfigError("a simulated camera runs freely only over GigE, and without a trigger box")
    folder.mkdir(parents=True, exist_ok=True)
    truth = make_cell(options.scene, options.seed, options.noise, options.mount)
    truth = msgspec.structs.replace(truth, robot_model=options.robot)
    truth_file = folder / "truth.json"
    write_truth(truth, truth_file)
    controller = start_controller(
        truth.robot_model, truth=truth_file, time_scale=options.time_scale, log=folder / "controller.log"
    )
    config = cell_config(truth, controller.host)
    config = msgspec.structs.replace(
        config, robot=msgspec.structs.replace(config.robot, control=options.control)
    )
    capture = msgspec.structs.replace(config.capture, free_space_bytes=options.free_space_bytes)
    robot = msgspec.structs.replace(config.robot, model=options.robot)
    config = msgspec.structs.replace(config, capture=capture, robot=robot)
    try:
        wires = _Wires(options.hardware_trigger)
        config = wires.configured(config)
        config, camera, camera_ended = _camera(options, config, truth, truth_file, wires)
    except StationError:
        controller.stop()
        raise

    def ended() -> None:
        wires.end()
        camera_ended()
        controller.stop()

    return Cell(
        config=config,
        robot=UrRobot(config.robot, folder),
        camera=camera,
        source="simulated",
        trigger=wires.trigger,
        attachments={"truth.json": truth_file.read_bytes()},
        ended=ended,
    )


class _Wires:
    """The trigger box, its serial line and the wire from its output to the camera; or none of it."""

    def __init__(self, wanted: bool) -> None:
        self.camera: Callable[[], None] = lambda: None
        """The far end of the wire"""
        self._box: SimulatedTriggerBox | None = None
        self.trigger: Trigger | None = None
        if wanted:
            from station.devices.serial_trigger import SerialTrigger
            from station.simulation.trigger import SimulatedTriggerBox

            self._box = SimulatedTriggerBox(on_pulse=lambda: self.camera())
            self.trigger = SerialTrigger(TriggerConfig(self._box.port))

    def configured(self, config: StationConfig) -> StationConfig:
        if self._box is None:
            return config
        camera = msgspec.structs.replace(config.camera, trigger="hardware")
        return msgspec.structs.replace(config, camera=camera, trigger=TriggerConfig(self._box.port))

    def end(self) -> None:
        if self._box is not None:
            self._box.unplug()


def _camera(
    options: SimulationOptions,
    config: StationConfig,
    truth: CellTruth,
    truth_file: Path,
    wires: _Wires,
) -> tuple[StationConfig, Camera, Callable[[], None]]:
    """The configuration with the camera it is about, and what ends its processes."""
    if not options.gige:
        from station.simulation.camera import RenderedCamera

        rendered = RenderedCamera(truth, config.robot.host, config.camera, wires.trigger)
        wires.camera = rendered.pulse
        return config, rendered, lambda: None
    from station.devices.aravis import AravisCamera
    from station.simulation.launch import start_gige

    free = options.frame_rate_hz > 0
    serial = f"SIM{options.seed:05d}"
    simulator = start_gige(config.robot.host, truth=truth_file, serial=serial, numbered=free)
    # The simulator has no test packets to negotiate the packet size with; loopback carries the largest.
    over_gige = msgspec.structs.replace(
        config.camera, driver="aravis", device="127.0.0.1", packet_size=GIGE_PACKET_BYTES
    )
    if free:
        over_gige = msgspec.structs.replace(
            over_gige, trigger="free-running", frame_rate_hz=options.frame_rate_hz
        )
    config = msgspec.structs.replace(config, camera=over_gige)
    wires.camera = lambda: simulator.inject("pulse")
    return config, AravisCamera(over_gige, wires.trigger), simulator.stop
