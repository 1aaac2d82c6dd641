"""Hand-eye calibration of a robot's camera: solve a recording, judge, install and load the result.

    from pathlib import Path
    from calibrate import JobOptions, install, load_installed, solve_recording, write_calibration

    job = solve_recording(Path("session.mcap"), JobOptions(seed=1))
    for gate in job.gates:
        print(gate.name, gate.passed, gate.value, gate.limit, gate.unit)
    write_calibration(job.calibration, Path("cell.yaml"))
    install(Path("cell.yaml"), Path("state"), cell="simulated")
    calibration = load_installed(Path("state"), allow_simulated=True)  # refused when it is in doubt
    print(calibration.validity.state, calibration.validity.since)
    flange_from_camera = calibration.transform.matrix  # (4, 4), metres

In a notebook, from a folder of images and poses, or from arrays:

    solved = calibrate.solve(*calibrate.read_folder("FOLDER"))
    solved = calibrate.solve(images, poses, "9x6 25", "eye-in-hand", convention="ur-rotvec")
    print(solved.X, solved.covariance(), [gate.text for gate in solved.gates if not gate.passed])
    solved.plot()

Errors are `CalibrationError`s and `recordings.RecordingError`s with `code`, `values` and `remedy`. Where a
remedy names an option of the commands, such as `--board`, it is the argument `board` here. Names are loaded
at their first use. The solver without files is `calibrate.handeye`. Everything else is private.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from calibrate.errors import CalibrationError as CalibrationError
    from calibrate.files.calibration import Calibration as Calibration
    from calibrate.files.calibration import read_calibration as read_calibration
    from calibrate.files.calibration import write_calibration as write_calibration
    from calibrate.files.exports import FrameNames as FrameNames
    from calibrate.files.exports import export as export
    from calibrate.files.install import install as install
    from calibrate.files.install import rollback as rollback
    from calibrate.files.install import set_validity as set_validity
    from calibrate.files.loader import InstallationChange as InstallationChange
    from calibrate.files.loader import InstalledCalibration as InstalledCalibration
    from calibrate.files.loader import load_installed as load_installed
    from calibrate.files.loader import watch as watch
    from calibrate.files.validity import Validity as Validity
    from calibrate.files.validity import ValidityReason as ValidityReason
    from calibrate.files.validity import ValidityState as ValidityState
    from calibrate.gates import GateLimits as GateLimits
    from calibrate.geometry import Transform as Transform
    from calibrate.job import JobOptions as JobOptions
    from calibrate.job import Solved as Solved
    from calibrate.job import SolvedRecording as SolvedRecording
    from calibrate.pictures import SolvedPictures as SolvedPictures
    from calibrate.pictures import read_folder as read_folder
    from calibrate.pictures import solve as solve
    from calibrate.pipeline import solve_recording as solve_recording
    from calibrate.results import Gate as Gate

_MODULES = {
    "errors": "CalibrationError",
    "files.calibration": "Calibration read_calibration write_calibration",
    "files.exports": "FrameNames export",
    "files.install": "install rollback set_validity",
    "files.loader": "InstallationChange InstalledCalibration load_installed watch",
    "files.validity": "Validity ValidityReason ValidityState",
    "geometry": "Transform",
    "job": "JobOptions Solved SolvedRecording",
    "pictures": "SolvedPictures read_folder solve",
    "pipeline": "solve_recording",
    "gates": "GateLimits",
    "results": "Gate",
}
"""Module → names that it gives."""
_HOME = {name: module for module, names in _MODULES.items() for name in names.split()}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
