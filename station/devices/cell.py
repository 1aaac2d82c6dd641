"""A cell: the devices that one configuration describes, behind their protocols."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from recordings.schema.messages import CameraModel, Source
from station.cell.config import StationConfig
from station.cell.errors import ConfigError
from station.cell.plan import Plan
from station.devices.base import Camera, Robot, Trigger


@dataclass(frozen=True)
class Cell:
    config: StationConfig
    robot: Robot
    camera: Camera
    source: Source
    """`real` only when arm and camera both are."""
    trigger: Trigger | None = None
    config_text: bytes = b""
    """The file's bytes, for the recording."""
    config_path: str = ""
    """The file, for commands that are suggested; empty: there is none."""
    attachments: dict[str, bytes] = field(default_factory=dict)
    """More for every recording of this cell: a simulated one's truth."""
    plan: Plan | None = None
    """Loaded at the start: what a played-back cell can show."""
    ended: Callable[[], None] = lambda: None
    """Called once the devices are closed: ends child processes of a simulated cell."""

    @property
    def simulated(self) -> bool:
        return self.source == "simulated"

    @property
    def config_sha256(self) -> str:
        return hashlib.sha256(self.config_yaml).hexdigest()

    @property
    def config_yaml(self) -> bytes:
        return self.config_text or msgspec.yaml.encode(self.config)

    @property
    def camera_model(self) -> CameraModel | None:
        """Trustworthy intrinsics only; None where they are to be found from the images."""
        return None if self.config.camera.model_is_rough else self.config.camera.model


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
    # A recorded or rendered image beside an arm that really moves would be a wrong calibration.
    raise ConfigError(
        f"camera.driver '{config.camera.driver}' shows no real image and never runs beside a real arm",
        code="unreal-camera",
        remedy="Use 'aravis', or `station serve --simulate`.",
    )


def _trigger(config: StationConfig) -> Trigger | None:
    if config.trigger is None:
        return None
    from station.devices.serial_trigger import SerialTrigger

    return SerialTrigger(config.trigger)
