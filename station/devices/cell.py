"""A cell: the devices that one configuration describes, behind their protocols."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from recordings.schema.messages import CameraModel, Source
from station.cell.acceptance import ArmSubject, not_accepted, read_acceptance
from station.cell.config import SPEED_CAP_M_S, StationConfig
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
    def subject(self) -> ArmSubject:
        """The arm as it is now: what an acceptance is bound to."""
        robot, identity = self.robot, self.robot.identity
        firmware = identity.controller_version
        return ArmSubject(
            self.source, identity.model, identity.serial, firmware, robot.payload, robot.control_path
        )

    def acceptance_trouble(self, root: Path) -> str:
        """Why the stops of this real arm are not accepted; empty: they are, or nothing real moves."""
        if self.source != "real" or not self.robot.identity.serial or not self.robot.control_path:
            return ""
        speed_m_s = min(self.config.limits.speed_m_s, SPEED_CAP_M_S)
        return not_accepted(read_acceptance(root), self.subject, speed_m_s)

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
