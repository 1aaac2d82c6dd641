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

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
