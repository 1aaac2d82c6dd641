"""From a configuration to the cell's devices. Drivers are imported only where they are wanted."""

from __future__ import annotations

from pathlib import Path

from recordings.schema.messages import Source
from station.cell.config import StationConfig
from station.cell.errors import ConfigError
from station.devices.base import Camera, Trigger
from station.devices.cell import Cell


def configured_cell(config: StationConfig, text: bytes, log_dir: Path) -> Cell:
    """Nothing is connected yet. ConfigError for devices that must not be combined."""
    from station.devices.ur import UrRobot

    trigger = _trigger(config)
    camera, source = _camera(config, trigger)
    return Cell(
        config=config,
        robot=UrRobot(config.robot, log_dir),
        camera=camera,
        source=source,
        trigger=trigger,
        config_text=text,
    )


def _camera(config: StationConfig, trigger: Trigger | None) -> tuple[Camera, Source]:
    if config.camera.driver == "aravis":
        from station.devices.aravis import AravisCamera

        return AravisCamera(config.camera, trigger), "real"
    # A recorded or rendered picture beside an arm that really moves would be a wrong calibration.
    raise ConfigError(
        f"camera.driver '{config.camera.driver}' shows no real picture and never runs beside a real arm: "
        "use 'aravis', or `station serve --simulate`"
    )


def _trigger(config: StationConfig) -> Trigger | None:
    if config.trigger is None:
        return None
    from station.devices.serial_trigger import SerialTrigger

    return SerialTrigger(config.trigger)
