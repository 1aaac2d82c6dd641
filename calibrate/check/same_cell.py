"""Whether views are of the cell, robot and camera that a calibration is of."""

from __future__ import annotations

import msgspec

from calibrate.errors import UsageError
from calibrate.files.calibration import Calibration
from recordings.schema.messages import Mount, SessionInfo, Source


class OtherCellError(UsageError):
    """The views are of another cell, robot or camera than the calibration."""

    code = "views-of-another-cell"

    @property
    def device(self) -> str:
        """Which device differs first, "robot" or "camera"; empty when something else does."""
        differs = str(self.values.get("differs", ""))
        return differs if differs in ("robot", "camera") else ""


class CellIdentity(msgspec.Struct, frozen=True):
    """Mounting, source, robot and camera of a recording, as compared with those of a calibration."""

    mount: Mount
    source: Source
    robot_serial: str
    camera_serial: str

    @classmethod
    def of(cls, info: SessionInfo) -> CellIdentity:
        """Read the facts of a recording."""
        return cls(info.mount, info.source, info.robot.serial, info.camera_identity.serial)


def require_same_cell(where: str, calibration: Calibration, seen: CellIdentity) -> None:
    """Raise OtherCellError for views of another mounting, robot or camera, or simulated and real ones."""
    simulated = calibration.source == "simulated"
    for name, new, known, same in (
        ("mounting", seen.mount, calibration.mount, seen.mount == calibration.mount),
        ("source", seen.source, calibration.source, (seen.source == "simulated") == simulated),
        ("robot", *_serials(seen.robot_serial, calibration.robot.serial)),
        ("camera", *_serials(seen.camera_serial, calibration.camera.serial)),
    ):
        if not same:
            raise OtherCellError(where=where, differs=name, found=str(new), calibrated=str(known))


def _serials(new: str, known: str) -> tuple[str, str, bool]:
    return new, known, not new or not known or new == known
