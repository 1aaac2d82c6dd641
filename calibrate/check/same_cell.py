"""Whether views are of the cell, robot and camera that a calibration is of."""

from __future__ import annotations

from calibrate.errors import UsageError
from calibrate.files.calibration import Calibration
from recordings.schema.messages import Mount, Source


class OtherCellError(UsageError):
    """The views are of another cell, robot or camera than the calibration."""

    code = "views-of-another-cell"

    @property
    def device(self) -> str:
        """Which device differs first, "robot" or "camera"; empty when something else does."""
        differs = str(self.values.get("differs", ""))
        return differs if differs in ("robot", "camera") else ""


def require_same_cell(
    where: str, calibration: Calibration, mount: Mount, source: Source, robot_serial: str, camera_serial: str
) -> None:
    """Raise OtherCellError for views of another mounting, robot or camera, or simulated and real ones.

    A device that tells no serial number counts as the same.
    """
    for name, found, calibrated in (
        ("mounting", mount, calibration.mount),
        ("source", source, calibration.source),
        ("robot", robot_serial, calibration.robot.serial),
        ("camera", camera_serial, calibration.camera.serial),
    ):
        if name == "source":  # whether real, imported or played back is no matter
            same = (found == "simulated") == (calibrated == "simulated")
        else:
            same = found == calibrated or "" in (found, calibrated)
        if not same:
            raise OtherCellError(where=where, differs=name, found=found, calibrated=calibrated)
