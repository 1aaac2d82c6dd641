"""Recordings of calibration sessions: write, open, look into, rescue, import and export them.

    from pathlib import Path
    import numpy as np
    from recordings import RecordingError, open_recording

    try:
        recording = open_recording(Path("session.mcap"))
    except RecordingError as error:
        print(error.code, error.values, error.remedy)
        raise
    for view, image in recording.images():
        print(view.index, view.base_from_flange, image.pixels.shape, image.stamps.host_monotonic_ns)
    images, base_from_flange, *_ = recording.pictures()
    robot = recording.robot_samples()
    at_ns = [view.stamps.host_monotonic_ns for view in recording.views()]
    joints_rad = [np.interp(at_ns, robot.stamps_ns, joint) for joint in robot.joints_rad.T]

Poses are `base_from_flange`, 4×4 in metres; angles are radians, stamps ns or s as their names end. Errors are
`RecordingError`s with `code`, `values` and `remedy`. Names are loaded at their first use. The file format is
docs/integrator/recording-format.md. Everything else is private.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
