"""The time offset between camera and robot, from a sweep: an arm in slow motion before a free-running camera.

Whatever the calibration, flange and camera (or the board on the flange) turn alike: the rotations of the
robot, taken later or earlier until they fit those of the images, give the offset with no calibration at hand.
The arm must turn to and fro: at constant speed every offset fits.

What is tested is the very time that a pose uses: each frame's own, `Image.time`. Robot states are placed by
the controller's clock, tied to the host's by its quickest messages: a busy computer delays arrivals, never
advances one. Recordings of earlier versions have no frame times: their pictures are placed by the camera's
clock, tied likewise, and the offset holds the exposure, readout and transport of the quickest picture.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation, Slerp

from calibrate.boards.detect import detect
from calibrate.boards.model import board_points
from calibrate.errors import BadViewsError, DegenerateMotionError, TooFewViewsError
from calibrate.geometry import Array, inverse, pose_from_rotvec, rotation_angle
from calibrate.lens.pnp import candidate_poses
from calibrate.views import BoardView, ViewSet
from recordings.errors import BadImageError
from recordings.images import viewable
from recordings.reader import Recording
from recordings.schema.frame_time import derived_again
from recordings.schema.messages import CameraModel, Image, TimeSource

FEWEST_PICTURES = 12
LIMIT_S = 0.2
"""Offsets beyond it are not looked for."""
_STEPS = 81
"""Steps of the first search, 5 ms apart."""
_ITERATIONS = 20
_DIFFERENCE_S = 1e-3
"""Half the distance of the two values that give a slope."""
_HUBER = 1.345
"""Sigmas; 95 % efficient (Huber 1964): a picture with a wrong pose must not shift the time."""
_LAGS = 6
"""Neighbours whose scores count together in the sigma."""
UNSEEN_DELAY_S = 1e-4
"""1 sigma of the controller's shortest delay: no arrival shows it, so it stays in the offset."""

_LARGEST_STAMP_S = 1e12
_STILL_RAD_S = math.radians(0.5)
"""A sweep turns ten times faster and more."""
_MOMENT_S = 0.05


@dataclass(frozen=True)
class TimeOffset:
    offset_s: float
    """A frame of time t was taken at t + offset on the robot's clock."""
    sigma_s: float
    rms_rad: float
    """Residual of the compared angles."""
    pairs: int
    lost: tuple[str, ...] = ()
    """Pictures that could not be used, each in words"""
    source: TimeSource | None = None
    """Source of most frames' times; None in recordings without frame times"""
    bound_s: float | None = None
    """Largest 95 % bound of those times"""
    derived_s: float | None = None
    """Largest difference to times derived again from the raw readings of the camera's clock"""

    @property
    def agrees(self) -> bool:
        """The frame times are right as far as this sweep can tell, at 95 %."""
        return abs(self.offset_s) <= 1.96 * self.sigma_s


def sweep_time_offset(recording: Recording, camera: CameraModel | None = None) -> TimeOffset:
    """Estimate the time offset by every image, whether it belongs to a stop of the arm or not.

    An image that cannot be decoded is skipped and listed in `lost`.
    `camera`: the lens, needed where the recording does not know it. Raises CalibrationError.
    """
    camera = camera or recording.info.camera
    if camera.matrix is None:
        raise BadViewsError(
            f"{recording.path} holds no intrinsics, and a sweep cannot estimate them.",
            code="intrinsics-missing",
            remedy="Give a calibration of this camera: calibrate sweep --calibration FILE.",
        )
    robot_s, flange = _robot(recording)
    told = [facts.time for part in recording.segments for facts in part.image_facts() if facts.time]
    lost: list[str] = []
    seen = list(_seen(recording, camera, lost))
    if len(robot_s) < 2 or len(seen) < FEWEST_PICTURES:
        raise TooFewViewsError(
            f"{recording.path}: {len(seen)} images with the board and {len(robot_s)} robot states are too "
            f"few for a time offset ({FEWEST_PICTURES} images needed).",
            views=len(seen),
            needed=FEWEST_PICTURES,
        )
    times, poses = (np.array(column) for column in zip(*seen, strict=True))
    if _median_turning_rad_s(robot_s, flange, times) < _STILL_RAD_S:
        raise BadViewsError(
            f"{recording.path} is no sweep: the arm stood still at most of its images.",
            code="no-sweep",
            remedy="Capture one: station capture --sweep.",
        )
    found = estimate_time_offset(robot_s, flange, times, poses)
    sources = Counter(time.source for time in told).most_common(1)
    return replace(
        found,
        sigma_s=math.hypot(found.sigma_s, UNSEEN_DELAY_S),
        lost=tuple(lost),
        source=sources[0][0] if sources else None,
        bound_s=max((time.bound_s for time in told), default=None),
        derived_s=max(_derived_differences_s(recording), default=None),
    )


def _derived_differences_s(recording: Recording) -> Iterator[float]:
    for part in recording.segments:
        frames = ((f.stamps.device_ns, f.exposure_us, f.time) for f in part.image_facts() if f.time)
        for recorded, derived in derived_again(frames, list(part.clock_readings())):
            yield abs(derived.host_monotonic_ns - recorded.host_monotonic_ns) / 1e9


def at_time_offset(recording: Recording, views: ViewSet, offset_s: float) -> ViewSet:
    """Views with the flange poses that the robot states show `offset_s` later.

    A view without a host time keeps its pose: nothing tells when it was taken. Raises BadViewsError for a
    recording without robot states.
    """
    robot_s, tcp = _robot(recording)
    if len(robot_s) < 2:
        raise BadViewsError(
            f"{recording.path} holds no robot states: its poses cannot be moved in time.", code="no-states"
        )
    rotations, tool = Slerp(robot_s, Rotation.from_matrix(tcp[:, :3, :3])), recording.info.robot.tcp_offset
    flange_from_tcp = pose_from_rotvec(tool[:3], tool[3:])
    taken = {view.index: view.stamps.host_monotonic_ns / 1e9 for view in recording.views()}
    moved = []
    for view in views.views:
        at_s = taken[view.index] + offset_s
        if taken[view.index] and robot_s[0] <= at_s <= robot_s[-1]:
            pose = np.eye(4)
            pose[:3, :3] = rotations(at_s).as_matrix()
            pose[:3, 3] = [np.interp(at_s, robot_s, axis) for axis in tcp[:, :3, 3].T]
            view = replace(view, base_from_flange=pose @ inverse(flange_from_tcp))
        moved.append(view)
    return replace(views, views=tuple(moved))


def _robot(recording: Recording) -> tuple[Array, Array]:
    """Host times (n,) s and base_from_tcp (n, 4, 4): any frame on the flange turns as the flange does."""
    states = list(recording.robot_states())
    if not states:
        return np.zeros(0), np.zeros((0, 4, 4))
    arrivals = np.array([s.stamps.host_monotonic_ns for s in states]) / 1e9
    times = on_host(np.array([s.stamps.controller_s for s in states]), arrivals)
    tcp = np.array([s.tcp_pose for s in states]).reshape(-1, 6)
    # Arrivals may coincide where there is no controller clock; the first of them is the one on time.
    fresh = np.diff(times, prepend=-np.inf) > 0
    return times[fresh], pose_from_rotvec(tcp[fresh, :3], tcp[fresh, 3:])


def _median_turning_rad_s(robot_s: Array, poses: Array, times: Array) -> float:
    """Median rotation speed of the arm at the images; about 0 in a capture with stops."""
    last = len(robot_s) - 1
    before = np.clip(np.searchsorted(robot_s, times - _MOMENT_S), 0, last - 1)
    after = np.clip(np.searchsorted(robot_s, times + _MOMENT_S), before + 1, last)
    R = poses[:, :3, :3]
    turned = rotation_angle(np.swapaxes(R[before], -1, -2) @ R[after])
    return float(np.median(turned / (robot_s[after] - robot_s[before])))


def on_host(device_s: Array, arrivals_s: Array) -> Array:
    """Host times of device times, both (n,) s: the nearest straight line that lies under all arrivals.

    A linear program in offset and drift. The arrivals themselves where the device has no clock. Raises
    BadViewsError for what is no time.
    """
    if not (np.abs(device_s) < _LARGEST_STAMP_S).all():
        raise BadViewsError(
            "A clock of this recording gives invalid times.",
            code="bad-clock",
            remedy="Capture the sweep again.",
        )
    if len(device_s) < 2 or np.ptp(device_s) == 0:
        return arrivals_s
    since_s = device_s - device_s[0]
    gap_s = arrivals_s - arrivals_s[0] - since_s
    under = np.column_stack([np.ones_like(since_s), since_s])
    line = linprog(-under.mean(axis=0), under, gap_s, bounds=(None, None), method="highs").x
    return np.asarray(arrivals_s[0] + since_s + under @ line)


def _seen(recording: Recording, camera: CameraModel, lost: list[str]) -> Iterator[tuple[float, Array]]:
    """Time and camera_from_board of each picture that shows the board.

    `lost` takes what is said of pictures that cannot be decoded.
    """
    board = recording.info.board
    facts = [facts for part in recording.segments for facts in part.image_facts()]
    taken_s = np.array([f.time.host_monotonic_ns if f.time else np.nan for f in facts]) / 1e9
    if np.isnan(taken_s).any():
        stamps = [f.stamps for f in facts]
        arrivals_s = np.array([s.host_monotonic_ns for s in stamps]) / 1e9
        taken_s = on_host(np.array([s.device_ns for s in stamps]) / 1e9, arrivals_s)
    for picture, time_s in zip(_pictures(recording), taken_s, strict=True):
        if isinstance(picture, BadImageError):
            lost.append(str(picture))
            continue
        found = detect(viewable(picture.pixels, picture.pixel_format), board, thorough=False)
        if not found.found:
            continue
        view = BoardView(
            picture.sequence,
            str(picture.sequence),
            np.eye(4),
            board_points(board)[found.indices],
            found.pixels,
        )
        yield float(time_s), candidate_poses(view, camera, None)[0].camera_from_board


def _pictures(recording: Recording) -> Iterator[Image | BadImageError]:
    for part in recording.segments:
        for sequence in part.image_sequences():
            try:
                yield part.image(sequence)
            except BadImageError as problem:
                yield problem


def estimate_time_offset(
    robot_s: Array,
    base_from_flange: Array,
    camera_s: Array,
    camera_from_board: Array,
) -> TimeOffset:
    """Robot times (n,) and poses (n, 4, 4); picture times (m,) and PnP poses (m, 4, 4), in order; seconds.

    The start is the best of a grid by the angles between neighbours, equal for any mounting:
    ∠(F(t_i + τ)⁻¹ F(t_i+1 + τ)) = ∠(C_i⁻¹ C_i+1), F base_from_flange (slerp between the robot's times) and C
    camera_from_board. Then least squares with Huber's weights over τ and two rotations X and B in
    r_i = log(Xᵀ G(t_i + τ) B C_iᵀ), where G is F⁻¹ (eye-in-hand) or F (eye-to-hand), whichever fits: every
    picture tells by how fast the arm turned, not only by how its speed changed. Raises TooFewViewsError,
    BadViewsError for times out of order, DegenerateMotionError where the motion does not tell the offset.
    """
    for name, times in (("robot", robot_s), ("camera", camera_s)):
        if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise BadViewsError(
                f"The {name}'s times are not in order.", code="bad-clock", remedy="Capture the sweep again."
            )
    inside = (camera_s - LIMIT_S >= robot_s[0]) & (camera_s + LIMIT_S <= robot_s[-1])
    times, C = camera_s[inside], Rotation.from_matrix(camera_from_board[inside][:, :3, :3])
    if len(times) < FEWEST_PICTURES:
        raise TooFewViewsError(
            f"Only {len(times)} images lie within the robot's states ({FEWEST_PICTURES} needed).",
            remedy="Sweep longer, with the board in view.",
            views=len(times),
            needed=FEWEST_PICTURES,
        )
    flange = Slerp(robot_s, Rotation.from_matrix(base_from_flange[:, :3, :3]))
    start_s = _best_of_grid(flange, times, (C[:-1].inv() * C[1:]).magnitude())
    mountings = [lambda at: flange(at).inv(), lambda at: flange(at)]
    offset_s, sigma_s, rms_rad = min(
        (_by_rotations(turned, times, C, start_s) for turned in mountings), key=lambda found: found[2]
    )
    if not sigma_s <= LIMIT_S / 4 or abs(offset_s) >= LIMIT_S - 1e-9:
        raise DegenerateMotionError(
            f"The motion does not determine the time offset (1σ {1000 * sigma_s:.0f} ms within "
            f"± {1000 * LIMIT_S:.0f} ms).",
            remedy="The arm must rotate, speed up and slow down during the sweep.",
            sigma_s=sigma_s,
            limit_s=LIMIT_S,
        )
    return TimeOffset(offset_s, sigma_s, rms_rad, len(times) - 1)


def _best_of_grid(flange: Slerp, times: Array, seen_rad: Array) -> float:
    def misfit(offset_s: float) -> float:
        turned = flange(times + offset_s)
        return float(np.abs((turned[:-1].inv() * turned[1:]).magnitude() - seen_rad).sum())

    return float(min(np.linspace(-LIMIT_S, LIMIT_S, _STEPS), key=misfit))


def _by_rotations(
    turned: Callable[[Array], Rotation], times: Array, C: Rotation, offset_s: float
) -> tuple[float, float, float]:
    """(offset, sigma, robust RMS of the residuals in rad) by Gauss-Newton; NaN where nothing tells."""
    X, B = _first_rotations(turned(times + offset_s), C)
    n = len(times)

    def residual(at_s: float) -> Array:
        return np.asarray((X.inv() * turned(times + at_s) * B * C.inv()).as_rotvec())

    for _ in range(_ITERATIONS):
        r = residual(offset_s)
        low, high = max(offset_s - _DIFFERENCE_S, -LIMIT_S), min(offset_s + _DIFFERENCE_S, LIMIT_S)
        slope = (residual(high) - residual(low)) / (high - low)
        # A rotation about the optical axis is seen far better than a tilt: each has its own scale.
        scale = np.maximum(1.4826 * np.median(np.abs(r), axis=0), 1e-9)
        size = np.linalg.norm(r / scale, axis=1) / math.sqrt(3)
        weight = np.minimum(1.0, _HUBER / np.maximum(size, 1e-15))[:, None] / scale**2
        turns = (X.inv() * turned(times + offset_s)).as_matrix()
        J = np.concatenate([slope[:, :, None], -np.tile(np.eye(3), (n, 1, 1)), turns], axis=2)
        scores = np.einsum("nki,nk,nk->ni", J, weight, r)
        A = np.einsum("nki,nk,nkj->ij", J, weight, J)
        step = -np.linalg.pinv(A, rcond=1e-12, hermitian=True) @ scores.sum(axis=0)
        offset_s = float(np.clip(offset_s + step[0], -LIMIT_S, LIMIT_S))
        X, B = X * Rotation.from_rotvec(step[1:4]), Rotation.from_rotvec(step[4:]) * B
        if abs(step[0]) < 1e-8:
            break
    return offset_s, _sigma(A, scores), float(np.sqrt(np.mean(scale**2)))


def _first_rotations(G: Rotation, C: Rotation) -> tuple[Rotation, Rotation]:
    """X and B from the axes of turns over an eighth of the sweep, as Park and Martin (1994) do."""
    apart = max(1, len(C) // 8)
    robot, camera = ((each[apart:] * each[:-apart].inv()).as_rotvec() for each in (G, C))
    off = np.abs(np.linalg.norm(robot, axis=1) - np.linalg.norm(camera, axis=1))
    sound = off <= 4 * np.median(off) + 1e-9
    X, _ = Rotation.align_vectors(robot[sound], camera[sound])
    each = (G.inv() * X * C).as_matrix()
    u, _, vt = np.linalg.svd(np.median(each, axis=0))
    return X, Rotation.from_matrix(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def _sigma(A: Array, scores: Array) -> float:
    """Sandwich estimate of the first unknown's (Huber 1967), the larger one of with and without neighbours.

    Neighbours' scores belong together where detection errs alike in similar pictures (Newey and West 1987).
    NaN where the information is nothing but rounding.
    """
    information = A[0, 0] - A[0, 1:] @ np.linalg.pinv(A[1:, 1:], rcond=1e-12, hermitian=True) @ A[1:, 0]
    if not information > 1e-9 * A[0, 0]:
        return math.nan
    # What is left of each picture's score for the offset once the rotations have taken their part.
    own = scores[:, 0] - scores[:, 1:] @ np.linalg.pinv(A[1:, 1:], rcond=1e-12, hermitian=True) @ A[1:, 0]
    alone = spread = float(own @ own)
    for lag in range(1, _LAGS + 1):
        spread += 2 * (1 - lag / (_LAGS + 1)) * float(own[lag:] @ own[:-lag])
    return math.sqrt(max(alone, spread) * len(own) / (len(own) - A.shape[0])) / float(information)
