"""Delay and false alarms of `calibrate drift-check FOLDER` on production pictures.

The simulated cells know nothing of the test's own models: a UR10 whose table is wrong, a lens whose residual
is a sum of waves, blur as noise and shift, a camera that creeps and swings with the day.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from benchmarks.trials import in_processes, table, trials
from calibrate.boards.model import board_points
from calibrate.chain import chain_of
from calibrate.check.production import EARLIER, MOST_EARLIER, NEWEST, EarlierPictures
from calibrate.geometry import Array, inverse, perturb, pose, rotation_exp, transform_points
from calibrate.handeye.cell_state import CellState
from calibrate.handeye.mixture import SHARE_COUNTS
from calibrate.handeye.noise_scales import Scales
from calibrate.handeye.posterior import KnownCell
from calibrate.handeye.priors import BoardTolerance, LensPrior
from calibrate.kinematics import MODELS, RobotModel, forward, inverse_many, with_near_axes
from calibrate.lens.pnp import solve_pnp
from calibrate.projection import project_pixels
from calibrate.views import BoardView, ViewSet, extent_of
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel, Mount

_BOARD = BoardSpec(BoardKind.APRIL_TAG, square_m=0.05)
_TAG = board_points(_BOARD)
_WIDTH, _HEIGHT, _PER_DAY = 1600, 1200, 1000
_ARM = MODELS["UR10"]
_BLURRED = 0.05
"""Share of blurred pictures."""
_MOUNTS: tuple[Mount, Mount] = ("eye-in-hand", "eye-to-hand")
_BEFORE, _AFTER, _NULL, _CREEP_MM = 600, 150, 1200, 0.1  # creep of the camera in a day
_MOVES = ((0.5, 0.0), (0.0, 0.05), (1.0, 0.0), (0.0, 0.1))
"""Shifts, mm, and turns, degrees, of the camera after `_BEFORE` pictures."""


@dataclass(frozen=True)
class Cell:
    seed: int
    mount: Mount
    repeated: bool
    """Few postures that come again and again in any order; else every posture is another."""


def run() -> str:
    cells, nulls = trials(100), trials(60)
    rows = []
    for mount in _MOUNTS:
        for repeated in (True, False):
            found = list(in_processes(_delays, [Cell(seed, mount, repeated) for seed in range(cells)]))
            still = list(in_processes(_alarms, [Cell(1000 + seed, mount, repeated) for seed in range(nulls)]))
            tested = nulls * (_NULL - EARLIER)
            rate = f"{sum(still)} of {tested} ({1e4 * sum(still) / tested:.2f})"
            delays = (_percentiles([each[k] for each in found]) for k in range(len(_MOVES)))
            rows.append(("repeated" if repeated else "any", mount, *delays, rate))
            print(rows[-1], flush=True)
    columns = [f"{mm:g} mm" if mm else f"{deg:g}°" for mm, deg in _MOVES]
    return (
        f"{cells} cells a row, one 50 mm tag at 0.4 to 0.8 m, f 1100 to "
        "1700 px, corners 0.1 to 0.3 px, 5 % of the pictures blurred, repeatability 0.03 to 0.1 mm and table "
        "errors 0.1 to 0.3 mm (rms lengths), lens residual 0.04 to 0.12 px, creep 0.1 mm a day, daily swing "
        f"±0.05 mm, 1000 pictures a day. The camera moves in a random direction after {_BEFORE} pictures. "
        f"Pictures until it is noticed, median / 95 % (> {_AFTER}: not within {_AFTER}). False alarms: in "
        f"all pictures of {nulls} other cells a row, and per 10,000.\n\n"
        + table(("postures", "mounting", *columns, "false alarms"), rows)
    )


def _percentiles(delays: Sequence[float]) -> str:
    middle, late = np.percentile(delays, [50, 95], method="higher")
    return " / ".join(f"> {_AFTER}" if np.isinf(each) else f"{each:.0f}" for each in (middle, late))


def _delays(cell: Cell) -> list[float]:
    """Pictures until each move is noticed; infinite where it is not within `_AFTER`."""
    found = []
    for mm, deg in _MOVES:
        known, views = simulate(cell, _BEFORE + _AFTER, mm, deg)
        found.append(next((n - _BEFORE for n in _alarmed(known, views, _BEFORE)), np.inf))
    return found


def _alarms(cell: Cell) -> int:
    return len(list(_alarmed(*simulate(cell, _NULL), EARLIER)))


def _alarmed(known: KnownCell, views: ViewSet, begin: int) -> Iterator[int]:
    """Yield the numbers of pictures after which an alarm is given, looked at after each.

    The earlier pictures are solved again after every ten.
    """
    for count in range(begin, len(views)):
        if count % 10 == begin % 10:
            last = max(EARLIER, count - 20)
            earlier = EarlierPictures.of(views.select(list(range(max(0, last - MOST_EARLIER), last))), known)
        newest = list(range(max(last, count + 1 - NEWEST[-1]), count + 1))
        if len(newest) >= NEWEST[0] and not earlier.test(views.select(newest)).passed:
            yield count + 1


# --- the cell ---
@dataclass(frozen=True, eq=False)
class _Still:
    """A cell in which nothing happens, and everything in it that is random."""

    known: KnownCell
    seen_by: Callable[[Array], Array]
    arm: RobotModel
    joints: Array
    true_joints: Array
    X: Array
    P: Array
    tag: Array
    ways: Array
    noise_px: Array
    blur_px: Array


def simulate(cell: Cell, count: int, mm: float = 0.0, deg: float = 0.0) -> tuple[KnownCell, ViewSet]:
    """Simulate what a calibration left known of a cell, and its pictures, in which the camera may move."""
    still = _still(cell, count)
    later, X = np.arange(count) >= _BEFORE, still.X.copy()
    move = np.concatenate([still.ways[0] * mm * 1e-3, still.ways[1] * np.radians(deg)])
    X[later] = perturb(X[later], move)
    F = forward(still.arm, still.true_joints)
    C = inverse(F @ X) @ still.P if cell.mount == "eye-in-hand" else inverse(X) @ F @ still.P
    pixels = still.seen_by(transform_points(C, still.tag)) + still.noise_px + still.blur_px
    recorded = forward(_ARM, still.joints)
    views = (BoardView(i, str(i), recorded[i], _TAG, pixels[i], still.joints[i]) for i in range(count))
    return still.known, solve_pnp(ViewSet(cell.mount, tuple(views), still.known.mean.camera))


def _known(lens: CameraModel, X: Array, sigma: Array) -> KnownCell:
    """What a calibration leaves: X, a lens and a tag within their usual tolerances, links within 0.3 mm."""
    chain = chain_of(with_near_axes(_ARM))
    links = np.full(len(chain.link_errors), 0.3e-3)
    state = CellState(X, np.eye(4), np.zeros((0, 4, 4)), lens, np.zeros(5), np.zeros(len(links)))
    each = [*sigma, *LensPrior.given(lens).sigma, *BoardTolerance().sigma, *links]
    scales = Scales(np.array([1e-4, 2e-4]), 0.2, 0.2, 0.2, SHARE_COUNTS / SHARE_COUNTS.sum())
    return KnownCell(state, np.diag(each) ** 2, scales, 69.0, extent_of(_TAG), chain, None)


@lru_cache(maxsize=1)
def _still(cell: Cell, count: int) -> _Still:
    rng = np.random.default_rng([cell.seed, _MOUNTS.index(cell.mount), cell.repeated])
    lens, seen_by = _lens(rng)
    X, P = _poses(rng, cell.mount == "eye-in-hand")
    joints = _postures(rng, lens, X, P, cell, int(rng.integers(6, 21)) if cell.repeated else count)
    if cell.repeated:
        joints = joints[rng.integers(len(joints), size=count)]
    arm = _wrong_arm(rng, joints)
    days = np.arange(count) / _PER_DAY
    ways = rng.normal(size=(2, 3))
    blurred = (rng.random(count) < _BLURRED)[:, None, None]
    spread_px = rng.normal(size=(count, 4, 2)) * rng.uniform(0.5, 3, size=(count, 1, 1))
    sigma = np.repeat([0.15e-3, np.radians(0.02)], 3)
    return _Still(
        _known(lens, perturb(X, rng.normal(size=6) * sigma), sigma),
        seen_by,
        arm,
        joints,
        joints + _repeating(rng, joints),
        _with_day(rng, X, days, 0.05, _CREEP_MM),
        _with_day(rng, P, days, 0.02, 0.0),
        _TAG * (1 + 0.003 * rng.normal()),
        ways / np.linalg.norm(ways, axis=1, keepdims=True),
        rng.normal(size=(count, 4, 2)) * rng.uniform(0.1, 0.3),
        blurred * (rng.normal(size=(count, 1, 2)) * 2.0 + spread_px),
    )


def _lens(rng: np.random.Generator) -> tuple[CameraModel, Callable[[Array], Array]]:
    """The calibrated lens, and what the true one shows of points in the camera."""
    f = rng.uniform(1100, 1700)
    centre = np.array([799.5, 599.5]) + rng.normal(size=2) * 10
    distortion = (-0.1 + 0.03 * rng.normal(), 0.05 * rng.normal(), 0.0, 0.0, 0.0)

    def model(f: float, centre: Array) -> CameraModel:
        matrix = ((float(f), 0.0, float(centre[0])), (0.0, float(f), float(centre[1])), (0.0, 0.0, 1.0))
        return CameraModel(_WIDTH, _HEIGHT, matrix, distortion, "plumb_bob")

    true = model(f * (1 + 5e-4 * rng.normal()), centre + 0.7 * rng.normal(size=2))
    waves = rng.normal(size=(12, 2)) / rng.uniform(150, 500, size=(12, 1))
    phases, ways = rng.uniform(0, 2 * np.pi, 12), rng.normal(size=(12, 2))
    ways *= rng.uniform(0.04, 0.12) / np.sqrt((ways**2).sum() / 4)

    def seen_by(points: Array) -> Array:
        pixels = project_pixels(true, points)
        return np.asarray(pixels + np.sin(pixels @ waves.T + phases) @ ways)

    return model(f, centre), seen_by


def _poses(rng: np.random.Generator, in_hand: bool) -> tuple[Array, Array]:
    """X and P."""
    turned = rotation_exp(rng.normal(size=3) * 0.15)
    down = rotation_exp([np.pi, 0.0, 0.0])
    if in_hand:
        X = pose(turned, np.array([0.0, 0.07, 0.05]) + rng.normal(size=3) * 0.02)
        return X, pose(rotation_exp(rng.normal(size=3) * 0.1) @ down, [0.75, rng.uniform(-0.2, 0.2), 0.0])
    X = pose(turned @ rotation_exp([np.pi / 2, 0.0, 0.0]), [rng.uniform(-0.1, 0.1), 1.3, 0.6])
    return X, pose(rotation_exp(rng.normal(size=3) * 0.1) @ down, np.array([0.0, 0.05, 0.1]))


def _postures(
    rng: np.random.Generator, lens: CameraModel, X: Array, P: Array, cell: Cell, count: int
) -> Array:
    """Joints (count, 6) from which the whole tag is seen."""
    tilt, roll = 40.0, 180.0
    wanted = 8 * count + 400
    away = rng.uniform(0.4, 0.8, wanted)
    about = rng.uniform(0, 2 * np.pi, wanted)
    by = np.radians(tilt) * np.sqrt(rng.random(wanted))
    axes = np.stack([by * np.cos(about), by * np.sin(about), np.zeros(wanted)], axis=1)
    rolls = np.zeros((wanted, 3))
    rolls[:, 2] = np.radians(rng.uniform(-roll, roll, wanted))
    assert lens.matrix is not None
    f = lens.matrix[0][0]
    at = np.stack(
        [(rng.random(wanted) - 0.5) * 1300 / f * away, (rng.random(wanted) - 0.5) * 900 / f * away, away],
        axis=1,
    )
    R = rotation_exp(axes) @ rotation_exp(rolls)
    C = pose(R, at - R @ _TAG.mean(axis=0))
    pixels = project_pixels(lens, transform_points(C, _TAG))
    inside = ((pixels > 5) & (pixels < [_WIDTH - 5, _HEIGHT - 5])).all(axis=(1, 2))
    C = C[inside]
    F = P @ inverse(X @ C) if cell.mount == "eye-in-hand" else X @ C @ inverse(P)
    _, joints, branch = inverse_many(_ARM, F)
    best = np.bincount(branch, minlength=8).argmax()
    found = joints[branch == best][:count]
    if len(found) < count:
        raise RuntimeError(f"{cell}: {len(found)} of {count} postures are reachable")
    return np.asarray(found)


def _wrong_arm(rng: np.random.Generator, joints: Array) -> RobotModel:
    """A table whose flange errors scatter by 0.1 to 0.3 mm (root mean square) over the postures."""
    errors = rng.normal(size=(5, 6))

    def arm(size: float) -> RobotModel:
        a, d, alpha, theta, _ = (row * size for row in errors)
        return replace(
            _ARM,
            a_m=tuple((_ARM.a_m + a).tolist()),
            d_m=tuple((_ARM.d_m + d).tolist()),
            alpha_rad=tuple((_ARM.alpha_rad + alpha).tolist()),
            theta_rad=tuple((_ARM.theta_rad + theta).tolist()),
        )

    scatter = (forward(arm(1e-4), joints) - forward(_ARM, joints))[:, :3, 3].std(axis=0)
    return arm(1e-4 * rng.uniform(0.1e-3, 0.3e-3) / float(np.linalg.norm(scatter)))


def _repeating(rng: np.random.Generator, joints: Array) -> Array:
    """Joint errors by which the flange comes back to 0.03 to 0.1 mm (root mean square)."""
    noise = rng.normal(size=joints.shape) * 1e-5
    apart = (forward(_ARM, joints + noise) - forward(_ARM, joints))[:, :3, 3]
    return np.asarray(noise * rng.uniform(0.03e-3, 0.1e-3) / np.sqrt(np.mean((apart**2).sum(axis=1))))


def _with_day(rng: np.random.Generator, T: Array, days: Array, swing_mm: float, creep_mm: float) -> Array:
    """A pose that swings with the day and creeps, (n, 4, 4)."""
    ways = rng.normal(size=(3, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    wave = np.sin(2 * np.pi * (days + rng.random()))[:, None]
    shift = 1e-3 * (swing_mm * wave * ways[0] + creep_mm * days[:, None] * ways[1])
    turn = np.radians(0.003 * swing_mm / 0.05) * wave * ways[2]
    return perturb(T, np.concatenate([shift, turn], axis=1))
