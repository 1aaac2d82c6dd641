"""Names of the frames in exported files, the comment in every export, and roll, pitch, yaw."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml

from calibrate.errors import CalibrationError
from calibrate.files.calibration import Calibration, source_stamp
from calibrate.files.validity import Validity, validity_text
from calibrate.geometry import Array, pose
from recordings.files import MAIN_CAMERA

BODY_FROM_OPTICAL: Array = pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
"""REP-103: a body frame looks along x with z up, an optical frame along z with y down."""


class ExportError(CalibrationError):
    """The format is unknown, or cannot hold this calibration."""

    code = "export-format"
    exit_code = 2


@dataclass(frozen=True)
class FrameNames:
    """Names of the frames in an exported file.

    Defaults of the UR ROS driver: its `base` is the controller's (base_link is turned by 180°), and its
    `tool0` is the controller's flange (its `flange` is turned).
    """

    base: str = "base"
    flange: str = "tool0"
    camera: str = "camera_optical_frame"
    body: str = "camera_link"
    validity: Validity | None = None
    """Validity of the installed calibration, for the comment; None: the export is of a file."""

    @classmethod
    def of_camera(cls, name: str) -> FrameNames:
        """Make the frame names of a cell's camera: its name is a prefix, except for `main`."""
        return cls() if name == MAIN_CAMERA else cls(camera=f"{name}_optical_frame", body=f"{name}_link")

    def parent(self, calibration: Calibration) -> str:
        return self.flange if calibration.mount == "eye-in-hand" else self.base

    @property
    def node(self) -> str:
        """Name of the camera's ROS node: letters, digits and underscores."""
        name = re.sub(r"\W", "_", self.body.removesuffix("_link"), flags=re.ASCII)
        return name if name[:1].isalpha() else f"camera{name}"


def comment(calibration: Calibration, frames: FrameNames, corrected: bool = False) -> str:
    """Make the comment on the origin of an export, with a warning for a calibration of no real cell.

    Always one line: a line break in a name must not become a line of a launch file or a script.
    """
    stamp = source_stamp(calibration.source)
    origin = f"{calibration.provenance.session}, solved {calibration.created}"
    held = "" if frames.validity is None else validity_text(frames.validity)
    two = ("the corrected arm", "the arm as it is")[:: 1 if corrected else -1]
    offered = calibration.arm_table is not None and calibration.arm_table.offered
    arm = f"Camera pose for {two[0]}, not for {two[1]}" if offered else ""
    return " ".join(". ".join(filter(None, (stamp, origin, arm, held))).split())


def commented_yaml(calibration: Calibration, frames: FrameNames, plain: dict[str, Any], **layout: Any) -> str:
    return f"# {comment(calibration, frames)}\n{yaml.safe_dump(plain, sort_keys=False, **layout)}"


def roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """Convert R (3, 3) to roll, pitch, yaw about fixed axes, radians.

    Yaw is computed after the roll, Rz(yaw) Ry(pitch) = R Rx(roll)ᵀ. So the three stay accurate together near
    a pitch of 90°, where SciPy's lose half the digits and where a camera that looks along the flange is.
    """
    roll = np.arctan2(R[2, 1], R[2, 2])
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    across = R[:, 1] * np.cos(roll) - R[:, 2] * np.sin(roll)
    yaw = np.arctan2(-across[0], across[1])
    return float(roll), float(pitch), float(yaw)
