"""A sweep: the arm moved slowly while the camera ran freely. What was the time between the two?

Pictures are placed by the camera's own clock, with the host's time of the first picture as its origin; the
offset that is found therefore holds the exposure, readout and transport of that picture.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calibrate.board import board_points
from calibrate.detect import detect
from calibrate.errors import BadViewsError, TooFewViewsError
from calibrate.geometry import Array, pose_from_rotvec
from calibrate.pnp import candidate_poses
from calibrate.time_offset import FEWEST_PICTURES, LIMIT_S, TimeOffset, estimate_time_offset
from calibrate.views import ImageView
from recordings.messages import CameraModel, Picture
from recordings.reader import Recording


def sweep_time_offset(
    recording: Recording, camera: CameraModel | None = None, limit_s: float = LIMIT_S
) -> TimeOffset:
    """Of every picture in the recording, whether it belongs to a stop of the arm or not.

    `camera`: the lens, needed where the recording does not know it. Raises CalibrationError.
    """
    camera = camera or recording.info.camera
    if camera.matrix is None:
        raise BadViewsError(
            f"{recording.path} does not know its lens, and a sweep cannot find it: calibrate from stops "
            "first, and give that calibration's intrinsics"
        )
    robot_s, flange = _robot(recording)
    seen = list(_seen(recording, camera))
    if len(robot_s) < 2 or len(seen) < FEWEST_PICTURES:
        raise TooFewViewsError(
            f"{recording.path}: {len(seen)} pictures with the board and {len(robot_s)} robot states are too "
            f"few for a time offset; {FEWEST_PICTURES} pictures are needed"
        )
    times, poses = (np.array(column) for column in zip(*seen, strict=True))
    return estimate_time_offset(robot_s, flange, times, poses, limit_s)


def _robot(recording: Recording) -> tuple[Array, Array]:
    """Host times (n,) s and base_from_tcp (n, 4, 4): any frame on the flange turns as the flange does."""
    states = list(recording.robot_states())
    times = np.array([s.stamps.host_monotonic_ns for s in states]) / 1e9
    tcp = np.array([s.tcp_pose for s in states]).reshape(-1, 6)
    # Arrivals may coincide when the host was late; the first of them is the one on time.
    fresh = np.diff(times, prepend=-np.inf) > 0
    return times[fresh], pose_from_rotvec(tcp[fresh, :3], tcp[fresh, 3:])


def _seen(recording: Recording, camera: CameraModel) -> Iterator[tuple[float, Array]]:
    """Time of the start of exposure and camera_from_board of each picture that shows the board."""
    board = recording.info.board
    origin: tuple[int, int] | None = None
    for picture in _pictures(recording):
        stamps = picture.stamps
        if origin is None:
            origin = stamps.host_monotonic_ns, stamps.device_ns
        found = detect(picture.image, board, thorough=False)
        if not found.found:
            continue
        view = ImageView(
            picture.sequence,
            str(picture.sequence),
            np.eye(4),
            board_points(board)[found.indices],
            found.pixels,
        )
        taken_s = (origin[0] + stamps.device_ns - origin[1]) / 1e9
        yield taken_s, candidate_poses(view, camera, None)[0].camera_from_board


def _pictures(recording: Recording) -> Iterator[Picture]:
    for part in recording.parts:
        for sequence in part.picture_sequences():
            yield part.picture(sequence)
