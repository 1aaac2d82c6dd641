"""What our frames are called elsewhere."""

from __future__ import annotations

from dataclasses import dataclass

from calibrate.files.calibration import Calibration
from calibrate.files.summary import source_stamp
from calibrate.geometry import Array, inverse, pose

BODY_FROM_OPTICAL: Array = pose([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0, 0, 0])
"""REP-103: a body frame looks along x with z up, an optical frame looks along z with y down."""


@dataclass(frozen=True)
class FrameNames:
    """Defaults of the UR ROS driver: its `base` is the controller's (base_link is turned by 180°), and its
    `tool0` is the controller's flange (its `flange` is turned)."""

    base: str = "base"
    flange: str = "tool0"
    camera: str = "camera_optical_frame"
    body: str = "camera_link"

    def parent(self, calibration: Calibration) -> str:
        return self.flange if calibration.mount == "eye-in-hand" else self.base


def parent_from_body(calibration: Calibration) -> Array:
    """(4, 4) of the camera's body frame, whose origin is the optical one's."""
    return calibration.transform.matrix @ inverse(BODY_FROM_OPTICAL)


def comment(calibration: Calibration) -> str:
    """One line on where this comes from, stamped where it must be.

    One line whatever the file says: the rest of a name must not become a line of a launch file or a script.
    """
    stamp = source_stamp(calibration)
    origin = " ".join(f"{calibration.provenance.session}, solved {calibration.created}".split())
    return f"{stamp}. {origin}" if stamp else origin


def number(value: float) -> str:
    """Shortest text that reads back to the same double."""
    return repr(float(value))
