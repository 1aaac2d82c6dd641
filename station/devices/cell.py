"""Cell: the devices that a configuration describes, behind their protocols."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from recordings.schema.messages import CameraModel, Source
from station.cell.arm_acceptance import ArmSubject, not_accepted, read_acceptance
from station.cell.config import SPEED_CAP_M_S, StationConfig
from station.cell.errors import RefusedError
from station.cell.pose_plan import Plan
from station.devices.base import Arm, Camera, Mover

if TYPE_CHECKING:
    from station.devices.serial_trigger import SerialTrigger


@dataclass(frozen=True)
class Cell:
    config: StationConfig
    arm: Arm
    """What tells where the arm is. Of a robot of Universal Robots it is the `link` of `mover`."""
    camera: Camera
    source: Source
    """`real` only when both arm and camera are real."""
    mover: Mover | None = None
    """What moves the arm, its driver; None: a person does, and the station sends the arm nothing."""
    trigger: SerialTrigger | None = None
    config_text: bytes = b""
    """Content of the configuration file, for the recording."""
    config_path: str = ""
    """Path of the configuration file, for suggested commands; empty: none."""
    attachments: dict[str, bytes] = field(default_factory=dict)
    """Further attachments of every recording: for a simulated cell, its true geometry."""
    plan: Plan | None = None
    """Plan to load at the start: the recorded poses of a played-back cell."""
    ended: Callable[[], None] = lambda: None
    """Called after the devices are closed, to end the processes of a simulated cell."""

    def require_mover(self) -> Mover:
        """Return what moves the arm. RefusedError where a person does."""
        if self.mover is None:
            raise RefusedError("moved-by-hand", robot=self.arm.identity.model)
        return self.mover

    @property
    def subject(self) -> ArmSubject:
        """Arm, firmware, payload and control path, to which an acceptance test is bound."""
        mover, identity = self.require_mover(), self.arm.identity
        firmware = identity.controller_version
        return ArmSubject(
            self.source, identity.model, identity.serial, firmware, mover.payload, mover.control_path
        )

    def acceptance_trouble(self, root: Path) -> str:
        """Say why a real arm's stops are not accepted; empty: they are, or no real arm moves."""
        if self.mover is None or self.source != "real":
            return ""
        if not self.arm.identity.controller_version or not self.mover.control_path:  # not connected
            return ""
        return not_accepted(read_acceptance(root), self.subject, self.speed_limit_m_s)

    @property
    def speed_limit_m_s(self) -> float:
        """Highest speed of any modelled point: what the stops have to be accepted for."""
        return min(self.config.limits.speed_m_s, SPEED_CAP_M_S)

    @property
    def config_sha256(self) -> str:
        return hashlib.sha256(self.config_yaml).hexdigest()

    @property
    def config_yaml(self) -> bytes:
        return self.config_text or msgspec.yaml.encode(self.config)

    @property
    def camera_model(self) -> CameraModel | None:
        """Known intrinsics; None where they are rough, or are to be estimated from the images."""
        return None if self.config.camera.model_is_rough else self.config.camera.model
