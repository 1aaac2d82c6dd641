"""Delay, false alarms and named causes of `calibrate watch`.

The simulated cells know nothing of the test's own models: a UR10 whose table is wrong, a lens whose residual
is a sum of waves, blur as noise and shift, a camera that creeps and swings with the day.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from benchmarks.trials import in_processes, table, trials
from calibrate.boards.model import board_points
from calibrate.geometry import Array, inverse, perturb, pose, rotation_exp, transform_points
from calibrate.kinematics import MODELS, RobotModel, forward, inverse_many
from calibrate.projection import project_pixels
from calibrate.quality.movement.evidence import Moved
from calibrate.quality.movement.monitor import EventKind, MovementMonitor
from calibrate.quality.movement.pictures import CellModel, Picture
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel, Mount

_TAG = board_points(BoardSpec(BoardKind.APRIL_TAG, square_m=0.05))
_WIDTH, _HEIGHT, _PER_DAY = 1600, 1200, 1000
_ARM = MODELS["UR10"]
_BLURRED = 0.05
"""Share of blurred pictures."""
_MOUNTS: tuple[Mount, Mount] = ("eye-in-hand", "eye-to-hand")


@dataclass(frozen=True)
class Cell:
    seed: int
    mount: Mount
    repeated: bool
    """Few postures that come again and again in any order; else every posture is another."""
    narrow: bool = False
    """All views within ±5° of tilt and ±10° of roll."""
    creep_mm: float = 0.1
    """By which the camera creeps a day, from the first picture on."""


@dataclass(frozen=True)
class Happening:
    """Event after `_BEFORE` pictures."""

    part: str
    """camera, tag, joint-2 … joint-5, or noise"""
    mm: float = 0.0
    deg: float = 0.0


@dataclass(frozen=True)
class Outcome:
    happening: Happening
    delay: float
    """Pictures until it is noticed; infinite where it is not within `_AFTER`, NaN for an alarm before."""
    named: Moved | None
    worse: bool
    """Whether pictures were called worse."""


_BEFORE, _AFTER, _NULL = 600, 150, 1200
NOTICED = (
    Happening("camera", 0.5),
    Happening("camera", 0.0, 0.05),
    Happening("camera", 1.0),
    Happening("camera", 0.0, 0.1),
)
NAMED = (
    Happening("camera", 1.0, 0.1),
    Happening("tag", 1.0, 0.1),
    *(Happening(f"joint-{joint}", deg=0.1) for joint in (2, 3, 4, 5)),
)
WORSE = Happening("noise", 3.0)
_RIGHT = {
    "camera": (Moved.CAMERA, Moved.CAMERA_BASE),
    "tag": (Moved.TAG, Moved.TAG_GRIPPER),
    **{f"joint-{joint}": (Moved(f"joint-{joint}"),) for joint in (2, 3, 4, 5)},
}


def run() -> str:
    cells, nulls, fewer = trials(100), trials(60), trials(25)
    return text(cells, nulls, fewer, noticed_rows(cells, nulls), named_rows(fewer))


_KINDS = [(mount, repeated) for repeated in (True, False) for mount in _MOUNTS]


def noticed_rows(cells: int, nulls: int) -> list[tuple[str, ...]]:
    rows = []
    for mount, repeated in _KINDS:
        found = _outcomes([Cell(seed, mount, repeated) for seed in range(cells)], NOTICED)
        rate = _false_alarms([Cell(seed, mount, repeated) for seed in range(1000, 1000 + nulls)])
        rows.append((_says(repeated), mount, *(_delays(found, what) for what in NOTICED), rate))
        print(rows[-1], flush=True)
    return rows


def named_rows(cells: int) -> list[tuple[str, ...]]:
    rows = []
    for mount, repeated in _KINDS:
        for narrow in (False, True):
            seeds = range(3000, 3000 + cells)
            found = _outcomes([Cell(seed, mount, repeated, narrow) for seed in seeds], (*NAMED, WORSE))
            rows.append((_says(repeated), mount, "±5°" if narrow else "to 40°", *_names(found)))
            print(rows[-1], flush=True)
    return rows


_NAMED_HEADER = ("postures", "mounting", "tilt", "right", "wrong", "cannot tell", "not noticed",
                 "worse pictures", "alarm")  # fmt: skip


def text(
    cells: int,
    nulls: int,
    fewer: int,
    noticed: list[tuple[str, ...]],
    named: list[tuple[str, ...]],
) -> str:
    columns = [f"{what.mm:g} mm" if what.mm else f"{what.deg:g}°" for what in NOTICED]
    return (
        f"{cells} cells a row, one 50 mm tag at 0.4 to 0.8 m, f 1100 to "
        "1700 px, corners 0.1 to 0.3 px, 5 % of the pictures blurred, repeatability 0.03 to 0.1 mm and table "
        "errors 0.1 to 0.3 mm (rms lengths), lens residual 0.04 to 0.12 px, creep 0.1 mm a day, daily swing "
        f"±0.05 mm, 1000 pictures a day. The camera moves in a random direction after {_BEFORE} pictures. "
        f"Pictures until it is noticed, median / 95 % (> {_AFTER}: not within {_AFTER}). False alarms: in "
        f"all pictures of {nulls} other cells a row, and per 10,000.\n\n"
        + table(("postures", "mounting", *columns, "false alarms"), noticed)
        + f"\n\nWhat moved, {len(NAMED) * fewer} moves a row: camera or tag by 1 mm and 0.1°, joints 2 to 5 "
        f"by 0.1°; shares of those that were noticed. Then {fewer} cells whose corners become three times as "
        "noisy: share in which worse pictures are said, and share with an alarm.\n\n"
        + table(_NAMED_HEADER, named)
    )


def _false_alarms(cells: Sequence[Cell]) -> str:
    """False alarms in cells in which nothing moves: 'n of tested pictures (per 10,000)'."""
    found = list(in_processes(_run_null, list(cells)))
    pictures, alarms = sum(pictures for pictures, _ in found), sum(alarm for _, alarm in found)
    return f"{alarms} of {pictures} ({1e4 * alarms / pictures:.2f})"


def _says(repeated: bool) -> str:
    return "repeated" if repeated else "any"


def _delays(found: list[Outcome], what: Happening) -> str:
    delays = [o.delay for o in found if o.happening == what and not np.isnan(o.delay)]
    middle, late = np.percentile(delays, [50, 95], method="higher")
    return " / ".join(f"> {_AFTER}" if np.isinf(each) else f"{each:.0f}" for each in (middle, late))


def _names(found: list[Outcome]) -> list[str]:
    """Right, wrong, open, not noticed; noise said to be noise, and taken for a move."""
    moves = [o for o in found if o.happening.part != "noise"]
    named = [o.named for o in moves if o.named is not None]
    right = sum(o.named in _RIGHT[o.happening.part] for o in moves if o.named is not None)
    open_ = named.count(Moved.CANNOT_TELL)
    noise = [o for o in found if o.happening.part == "noise"]
    shares = [
        *(count / max(len(named), 1) for count in (right, len(named) - right - open_, open_)),
        float(np.mean(np.isinf([o.delay for o in moves]))),
        float(np.mean([o.worse for o in noise])),
        float(np.mean([np.isfinite(o.delay) for o in noise])),
    ]
    return [f"{100 * share:.1f} %" for share in shares]


def _outcomes(cells: Sequence[Cell], happenings: Sequence[Happening]) -> list[Outcome]:
    tasks = [(cell, tuple(happenings)) for cell in cells]
    return [outcome for outcomes in in_processes(_run_cell, tasks) for outcome in outcomes]


def _run_cell(task: tuple[Cell, tuple[Happening, ...]]) -> list[Outcome]:
    """Each happening in the same cell, whose pictures before it are the same."""
    cell, happenings = task
    found = []
    watched: MovementMonitor | None = None
    for what in happenings:
        model, pictures = simulate(cell, _BEFORE + _AFTER, what)
        if watched is None:
            watched = MovementMonitor(model)
            list(watched.add(pictures[:_BEFORE]))
        monitor = copy.deepcopy(watched)
        events = list(monitor.add(pictures[_BEFORE:]))
        alarm = next((e.pictures - _BEFORE for e in events if e.kind is EventKind.ALARM), np.inf)
        named = next((e.moved for e in events if e.kind is EventKind.NAMED), None)
        worse = any(e.kind is EventKind.PICTURES_WORSE for e in events)
        found.append(Outcome(what, np.nan if watched.alarmed else alarm, named, worse))
    return found


def _run_null(cell: Cell) -> tuple[int, bool]:
    model, pictures = simulate(cell, _NULL, None)
    monitor = MovementMonitor(model)
    events = list(monitor.add(pictures))
    begun = next(e.pictures for e in events if e.kind is EventKind.TESTING)
    ended = next((e.pictures for e in events if e.kind is EventKind.ALARM), _NULL)
    return ended - begun, monitor.alarmed


# --- the cell ---
@dataclass(frozen=True, eq=False)
class _Still:
    """A cell in which nothing happens, and everything in it that is random."""

    model: CellModel
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


def simulate(cell: Cell, count: int, what: Happening | None) -> tuple[CellModel, list[Picture]]:
    """Simulate a cell's facts for the monitor, and its pictures; all are the same until something happens."""
    still = _still(cell, count)
    later = (np.arange(count) >= _BEFORE) & (what is not None)
    X, P, joints, noise_px = still.X.copy(), still.P.copy(), still.true_joints.copy(), still.noise_px.copy()
    if what is not None:
        move = np.concatenate([still.ways[0] * what.mm * 1e-3, still.ways[1] * np.radians(what.deg)])
        if what.part == "camera":
            X[later] = perturb(X[later], move)
        elif what.part == "tag":
            P[later] = perturb(P[later], move)
        elif what.part == "noise":
            noise_px[later] *= what.mm
        else:
            joints[later, int(what.part[-1]) - 1] += np.radians(what.deg) * np.sign(still.ways[0, 0])
    F = forward(still.arm, joints)
    C = inverse(F @ X) @ P if cell.mount == "eye-in-hand" else inverse(X) @ F @ P
    pixels = still.seen_by(transform_points(C, still.tag)) + noise_px + still.blur_px
    recorded = forward(_ARM, still.joints)
    return still.model, [
        Picture(str(i), recorded[i], still.joints[i], (0, 1, 2, 3), _TAG, pixels[i]) for i in range(count)
    ]


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
    known = perturb(X, np.r_[rng.normal(size=3) * 0.15e-3, rng.normal(size=3) * np.radians(0.02)])
    covariance = np.diag(np.repeat([0.15e-3, np.radians(0.02)], 3) ** 2)
    return _Still(
        CellModel(cell.mount, lens, known, covariance, _ARM),
        seen_by,
        arm,
        joints,
        joints + _repeating(rng, joints),
        _with_day(rng, X, days, 0.05, cell.creep_mm),
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
    tilt, roll = (5.0, 10.0) if cell.narrow else (40.0, 180.0)
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
