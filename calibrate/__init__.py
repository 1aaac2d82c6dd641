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

from typing import TYPE_CHECKING

from recordings.door import open_door

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
    from calibrate.job import SolvedRecording as SolvedRecording
    from calibrate.job import solve_recording as solve_recording
    from calibrate.pictures import SolvedPictures as SolvedPictures
    from calibrate.pictures import read_folder as read_folder
    from calibrate.pictures import solve as solve
    from calibrate.results import Gate as Gate
    from calibrate.solved import Solved as Solved

__getattr__, __all__ = open_door(__name__, __file__)
