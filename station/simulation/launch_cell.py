"""A whole simulated cell for the daemon: truth, controller child, real driver, rendered camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec

from recordings.messages import Mount
from station.cell import Cell
from station.simulation.cell import NoiseLevel, SceneName, make_cell, write_truth
from station.simulation.launch import start_controller


@dataclass(frozen=True)
class SimulationOptions:
    scene: SceneName = "paper"
    seed: int = 0
    noise: NoiseLevel = "low"
    mount: Mount = "eye-in-hand"
    time_scale: float = 1.0
    """Above 1 only in tests: real time is what is demonstrated."""
    free_space_bytes: int = 200_000_000
    """A demonstration must run on a small disk."""


def simulated_cell(options: SimulationOptions, folder: Path) -> Cell:
    """Starts the controller; blocking (a second). `folder` takes the truth and logs. Raises RobotError."""
    from station.devices.ur import UrRobot
    from station.simulation.camera import RenderedCamera
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
    return Cell(
        config=config,
        robot=UrRobot(config.robot, folder, folder),
        camera=RenderedCamera(truth, controller.host, config.camera),
        source="simulated",
        attachments={"truth.json": truth_file.read_bytes()},
        ended=controller.stop,
    )
