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

from typing import TYPE_CHECKING

from recordings.door import open_door

if TYPE_CHECKING:
    from recordings.errors import BadImageError as BadImageError
    from recordings.errors import CodedError as CodedError
    from recordings.errors import CorruptRecordingError as CorruptRecordingError
    from recordings.errors import MissingSegmentError as MissingSegmentError
    from recordings.errors import RecordingError as RecordingError
    from recordings.errors import UnfinishedRecordingError as UnfinishedRecordingError
    from recordings.exporters.export import export_recording as export_recording
    from recordings.images import viewable as viewable
    from recordings.importers.bag import import_bag as import_bag
    from recordings.importers.folder import import_folder as import_folder
    from recordings.info import recording_info as recording_info
    from recordings.reader import Pictures as Pictures
    from recordings.reader import Recording as Recording
    from recordings.reader import RobotSamples as RobotSamples
    from recordings.reader import open_recording as open_recording
    from recordings.recorder import Recorder as Recorder
    from recordings.recover import recover_recording as recover_recording
    from recordings.schema.messages import BoardKind as BoardKind
    from recordings.schema.messages import BoardSpec as BoardSpec
    from recordings.schema.messages import CameraModel as CameraModel
    from recordings.schema.messages import Image as Image
    from recordings.schema.messages import RobotState as RobotState
    from recordings.schema.messages import SessionInfo as SessionInfo
    from recordings.schema.messages import Stamps as Stamps
    from recordings.schema.messages import View as View
    from recordings.writer import RecordingWriter as RecordingWriter

__getattr__, __all__ = open_door(__name__, __file__)
