"""A whole simulated cell for the daemon: truth, controller child, real driver, rendered camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from recordings.messages import Mount
from station.cell import Cell
from station.config import StationConfig
from station.devices.base import Camera
from station.errors import StationError
from station.simulation.cell import CellTruth, NoiseLevel, SceneName, make_cell, write_truth
from station.simulation.launch import start_controller

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
    free_space_bytes: int = 200_000_000
    """A demonstration must run on a small disk."""


def simulated_cell(options: SimulationOptions, folder: Path) -> Cell:
    """Starts the controller; blocking (a second). `folder` takes the truth and logs. Raises RobotError."""
    from station.devices.ur import UrRobot
    from station.simulation.scenes import cell_config

    folder.mkdir(parents=True, exist_ok=True)
    truth = make_cell(options.scene, options.seed, options.noise, options.mount)
    truth_file = folder / "truth.json"
    write_truth(truth, truth_file)
    controller = start_controller(
        truth.robot_model, truth=truth_file, time_scale=options.time_scale, log=folder / "controller.log"
    )
    config = cell_config(truth, controller.host)
    capture = msgspec.structs.replace(config.capture, free_space_bytes=options.free_space_bytes)
    config = msgspec.structs.replace(config, capture=capture)
    try:
        config, camera, camera_ended = _camera(options, config, truth, truth_file)
    except StationError:
        controller.stop()
        raise

    def ended() -> None:
        camera_ended()
        controller.stop()

    return Cell(
        config=config,
        robot=UrRobot(config.robot, folder, folder),
        camera=camera,
        source="simulated",
        attachments={"truth.json": truth_file.read_bytes()},
        ended=ended,
    )


def _camera(
    options: SimulationOptions, config: StationConfig, truth: CellTruth, truth_file: Path
) -> tuple[StationConfig, Camera, Callable[[], None]]:
    """The configuration with the camera it is about, and what ends its processes."""
    if not options.gige:
        from station.simulation.camera import RenderedCamera

        return config, RenderedCamera(truth, config.robot.host, config.camera), lambda: None
    from station.devices.aravis import AravisCamera
    from station.simulation.gige_launch import start_gige

    simulator = start_gige(config.robot.host, truth=truth_file, serial=f"SIM{options.seed:05d}")
    # The simulator has no test packets to negotiate the packet size with; loopback carries the largest.
    over_gige = msgspec.structs.replace(
        config.camera, driver="aravis", device="127.0.0.1", packet_size=GIGE_PACKET_BYTES
    )
    config = msgspec.structs.replace(config, camera=over_gige)
    return config, AravisCamera(over_gige), simulator.stop
