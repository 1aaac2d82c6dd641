"""Views by hand: a person who follows the guidance, against as many random views in sight.

The person matches the outline of the wanted view within 3 cm and 8° (1σ of length and angle), or as near as
the joints get, 0.8 rad around home; gives it up after one try; ignores it in 15 of 100 moves and goes to a
random view in sight. Goes 8 % too far, waits 0.2 s, comes back. What hangs on the arm then swings by 2 mm,
dying away in 0.3 s; the hand drifts by 3 mm/s for another 0.5 to 1.5 s, then lets go. In one move of twenty
the board is touched and shakes by 1 mm for a second. Twelve views at least, and until the goal of 1 mm,
twenty at most. Lens, camera and board pose are unknown at first. Random: as many views, uniform in the same
joints, of those that show the whole board. Corners 0.15 px, robot 0.02 mm and 0.02 mrad. Kept while moving:
the board faster than 2 mm/s.

All numbers are assumed, none measured on people. Those for giving up, for what is out of reach and for the
motion of the picture were added after first trial runs.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from scipy.optimize import least_squares

from benchmarks.trials import Miss, rms, rows_of, table, trials
from calibrate.handeye.metrics import median_distance_m, point_error_m
from calibrate.handeye.solution import SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.lens.pnp import solve_pnp
from calibrate.views.projection import camera_matrix, distortion, project
from calibrate.views.view_set import ViewSet
from recordings.geometry import Array, pose, rotation_exp, transform_points
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel, Mount
from recordings.schema.stillness import WINDOW_S, scatter
from station.analysis.estimation import quick_covariance
from station.analysis.guidance import NextView, next_view, rim, way_to
from station.cell.config import CaptureConfig, StillnessConfig
from station.cell.status import FEWEST_BY_HAND
from tests.calibrate.chains import CAMERA, HOME, POINTS, ArmCell, arm_cell, boards, in_sight, shows, views_at

SESSIONS = 17
ARMS = ("ur", "spherical wrist", "seven joints")
MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
BOARD = BoardSpec(BoardKind.CHESSBOARD, columns=9, rows=7, square_m=0.025)
RIM = rim(BOARD)
HEADER = ("arm", "mount", "sessions", "ended with ≥ 12 views", "views", "moves", "kept while moving",
          "X rms mm", "random: X rms mm", "ratio")  # fmt: skip
OFF_M, OFF_RAD, IGNORES, TOO_FAR = 0.03, np.radians(8), 0.15, 0.08
SWING_M, SWING_S, SWING_HZ, DRIFT_M_S, TOUCHED, SHAKE_M = 0.002, 0.3, 4.0, 0.003, 0.05, 0.001
MOST_VIEWS, MOST_MOVES, REACH_RAD, RATE_HZ = 20, 80, 0.8, 50
MOVING_M_S = 0.002
"""Speed of the board before the camera above which a kept picture is one of something that moves."""


def run() -> str:
    sessions = list[tuple[float, ...]]()

    def row(case: tuple[str, str], some: list[tuple[float, ...]]) -> list[str]:
        sessions.extend(some)
        return line(case, some)

    rows = rows_of(session, [(arm, mount) for arm in ARMS for mount in MOUNTS], trials(SESSIONS), row)
    rows.append(line(("all", ""), sessions))
    return (__doc__ or "").partition("\n\n")[2] + "\n" + table(HEADER, rows)


def line(case: tuple[str, str], sessions: list[tuple[float, ...]]) -> list[str]:
    views, moves, moving, ours, random = np.array(sessions).T
    return [
        *case, str(len(views)), str(int((views >= FEWEST_BY_HAND).sum())), f"{views.mean():.1f}",
        f"{moves.mean():.1f}", f"{moving.sum():.0f}", f"{rms(ours):.3f}", f"{rms(random):.3f}",
        f"{rms(ours) / rms(random):.2f}",
    ]  # fmt: skip


def session(task: tuple[str, Mount, int]) -> tuple[float, ...]:
    """One session: views, moves, pictures kept of what moves, errors of X in mm, by hand and random."""
    name, mount, seed = task
    cell, rng = arm_cell(name, mount, 0.0, seed, views=4), np.random.default_rng([seed, *name.encode()])
    blank, taken = CameraModel(CAMERA.width, CAMERA.height), ViewSet(mount, (), CAMERA)
    given_up, moves, moving = list[Array](), 0, 0
    wanted, q = next_view(mount, BOARD, blank, False, []), anywhere(cell, rng, 1)[0]
    while len(taken) < MOST_VIEWS and moves < MOST_MOVES and not enough(taken, wanted):
        moves += 1
        path, shift_m = move(q, goal(cell, wanted, rng), rng)
        C = boards(cell.arm.forward(path), mount, cell.X, cell.Y @ pose(np.eye(3), shift_m))
        q, kept = path[-1], None
        speed_m_s = RATE_HZ * np.linalg.norm(np.gradient(C[:, :3, 3], axis=0), axis=1)
        for at in np.flatnonzero(still(cell, path, C) * shows(C)):
            Y = cell.Y @ pose(np.eye(3), shift_m[at])
            (view,) = views_at(cell.arm, mount, cell.X, Y, cell.link_errors, rng, path[at : at + 1])
            if way_to(wanted, view).new:
                kept, moving = replace(view, index=len(taken)), moving + int(speed_m_s[at] > MOVING_M_S)
                break
        given_up = [*given_up, wanted.camera_from_board] if kept is None else []
        taken = replace(taken, views=taken.views if kept is None else (*taken.views, kept))
        wanted = next_view(mount, BOARD, blank, False, taken.views, given_up)
    q = anywhere(cell, rng, len(taken))
    by_chance = views_at(cell.arm, mount, cell.X, cell.Y, cell.link_errors, rng, q)
    return float(len(taken)), float(moves), float(moving), error_mm(taken, cell), error_mm(by_chance, cell)


def enough(taken: ViewSet, wanted: NextView) -> bool:
    if len(taken) < FEWEST_BY_HAND or (found := wanted.found) is None:
        return False
    covariance = quick_covariance(found, BOARD, True)
    distance_m = median_distance_m(found.views.camera_from_board)
    return point_error_m(found.X, covariance, distance_m) <= CaptureConfig().goal_m


def error_mm(views: ViewSet, cell: ArmCell) -> float:
    """Error of X's translation, with the lens found in the same pictures."""
    views = replace(views, camera=calibrate_intrinsics(views).camera)
    options = SolveOptions(holdout=False, folds=False, intrinsics_from_same_pictures=True)
    return 1e3 * Miss.of(solve_views(solve_pnp(views), options), cell.X).shift_m


def anywhere(cell: ArmCell, rng: np.random.Generator, views: int) -> Array:
    return in_sight(cell.arm, cell.views.mount, cell.X, cell.Y, rng, views, REACH_RAD)


def goal(cell: ArmCell, wanted: NextView, rng: np.random.Generator) -> Array:
    """Joints to which the person goes."""
    if rng.uniform() < IGNORES:
        return np.asarray(anywhere(cell, rng, 1)[0])
    _, r, t = cv2.solvePnP(RIM, wanted.outline, camera_matrix(CAMERA), distortion(CAMERA))
    off = np.repeat([OFF_M, OFF_RAD], 3) / np.sqrt(3) * rng.normal(size=6)
    middle = transform_points(C := pose(cv2.Rodrigues(r)[0], t.ravel()), POINTS.mean(axis=0))
    R = rotation_exp(off[3:])
    C = pose(R, middle + off[:3] - R @ middle) @ C
    home, wanted_px = np.array(HOME[cell.arm.name]), project(CAMERA, transform_points(C, RIM)).pixels
    reached = least_squares(
        lambda q: (placed_px(cell, q) - wanted_px).ravel(), home, bounds=(home - REACH_RAD, home + REACH_RAD)
    )
    return np.asarray(reached.x)


def placed_px(cell: ArmCell, q: Array) -> Array:
    (C,) = boards(cell.arm.forward(q[None]), cell.views.mount, cell.X, cell.Y)
    points = transform_points(C, RIM)
    return project(CAMERA, np.maximum(points, [-np.inf, -np.inf, 0.05])).pixels


def move(q: Array, there: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Joints (n, k) and shift of the board (n, 3), m, `RATE_HZ` a second, until the hand has let go."""
    too_far = there + TOO_FAR * (there - q)
    rest, letting = round(1.5 * RATE_HZ), int(rng.uniform(0.5, 1.5) * RATE_HZ)
    ease = [0.5 - 0.5 * np.cos(np.linspace(0, np.pi, n))[:, None] for n in (RATE_HZ, RATE_HZ // 2)]
    drift = np.linspace(0, letting / RATE_HZ, letting)[:, None] * DRIFT_M_S * rng.normal(size=len(q))
    parts = [q + ease[0] * (too_far - q), np.repeat(too_far[None], RATE_HZ // 5, axis=0)]
    parts += [too_far + ease[1] * (there - too_far), there + drift]
    path = np.concatenate([*parts, np.repeat(parts[-1][-1:], rest, axis=0)])
    since_s = (np.arange(len(path)) - sum(map(len, parts[:3]))) / RATE_HZ
    swing = SWING_M * np.exp(-np.maximum(since_s, 0) / SWING_S) * np.sin(2 * np.pi * SWING_HZ * since_s)
    if rng.uniform() < TOUCHED:
        begin_s = rng.uniform(0, since_s[-1] - 1)
        shaken = (since_s >= begin_s) & (since_s < begin_s + 1)
        swing += SHAKE_M * shaken * np.sin(2 * np.pi * SWING_HZ * since_s)
    return path, np.outer(swing, [0.6, 0.8, 0.0])


def still(cell: ArmCell, path: Array, C: Array) -> Array:
    """Tell (n,) where the station's rule holds: flange over its window, corners over as long."""
    limits, window = StillnessConfig(), round(WINDOW_S * RATE_HZ)
    flange, rests = cell.arm.forward(path), np.zeros(len(path), dtype=bool)
    pixels = np.array([project(CAMERA, transform_points(each, POINTS)).pixels for each in C])
    for at in range(window, len(path)):
        place_m, turn_rad = scatter(flange[at - window : at + 1])
        motion_px = max(np.linalg.norm(pixels[at] - pixels[at - k], axis=1).max() for k in (2, 5, 10, 15))
        rests[at] = place_m <= limits.position_m and turn_rad <= limits.rotation_rad
        rests[at] &= motion_px <= limits.image_motion_px
    return rests
