"""The arm's table as a result: over the whole workspace, with it, without it, and planned for.

An own simulator of a UR10e: every error of its table that X and the board do not take, turns of the parallel
axes included, is drawn (mm and mrad); the robot states joints and the flange of the nominal table, misses by
0.05 mm and 0.003° per axis; corners 0.15 px; a board of 0.2 m, 0.4 to 0.62 m away, printed, bent (1 mm) and
seen through a lens as far off as their stated tolerances say. Workspace: rms over 400 random poses of points
0.5 m before the camera (eye-to-hand: of the board's middle), one rigid motion of all of them allowed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks.imperfect_cells import BOARD, LENSES, look, mounted
from benchmarks.scene import grid
from benchmarks.trials import Miss, in_processes, rms, share_spread, table, trials
from calibrate.chain import chain_of
from calibrate.gates import GateInputs, GateLimits, judge
from calibrate.geometry import (
    Array,
    difference,
    inverse,
    perturb,
    pose,
    random_rotation,
    rotation_exp,
    transform_points,
)
from calibrate.handeye.axxb.pairs import mount_poses
from calibrate.handeye.axxb.peer_methods import HAND_EYE, opencv_hand_eye
from calibrate.handeye.information import MeasurementNoise, prior_information, view_information
from calibrate.handeye.priors import BoardTolerance, LensPrior
from calibrate.handeye.solve import Solution, SolveOptions, solve_views
from calibrate.handeye.workspace import Workspace, sample_workspace
from calibrate.kinematics import MODELS, forward, inverse_many
from calibrate.lens.pnp import solve_pnp
from calibrate.projection import intrinsics_names, intrinsics_vector, project_pixels, with_intrinsics_vector
from calibrate.views import BoardView, ViewSet
from recordings.schema.messages import Mount
from station.cell.pose_plan import Criterion
from station.plan.choose import LINK_ERROR_MM, Objective, choose

ARM = MODELS["UR10e"]
CHAIN = chain_of(ARM)
LENS, POINTS = LENSES["plumb_bob"], grid(9, 7, 0.025)
CORNER_PX, ROBOT_M, ROBOT_RAD = 0.15, 5e-5, float(np.radians(0.003))
POOL = 600
TRIALS = 100
_BENT_M, _AHEAD_M = 1e-3, 0.5


@dataclass(frozen=True)
class Tolerances:
    """1σ of what is stated, relative: the lens's focal length, the board's squares and print."""

    lens: float
    board: float


LOOSE, GOOD = Tolerances(2e-3, 3e-3), Tolerances(2e-4, 2e-4)


@dataclass(frozen=True, eq=False)
class Truth:
    """One cell, and what its pictures would show from anywhere."""

    mount: Mount
    X: Array
    Y: Array
    errors: Array
    """(5, 6): a, d, alpha, theta, beta."""
    points: Array
    """(k, 3) the board as it is."""
    told: Tolerances

    def flange(self, q: Array) -> Array:
        """True base_from_flange (n, 4, 4) of joints (n, 6): the chain once more, step by step."""
        T = np.tile(np.eye(4), (len(q), 1, 1))
        for i in range(6):
            a, d, alpha, theta, beta = self.errors[:, i]
            for axis, angle, shift in (
                (2, q[:, i] + theta, ARM.d_m[i] + d),
                (0, np.full(len(q), ARM.alpha_rad[i] + alpha), ARM.a_m[i] + a),
                (1, np.full(len(q), beta), 0.0),
            ):
                unit = np.eye(3)[axis]
                T = T @ pose(rotation_exp(angle[:, None] * unit), shift * unit)
        return np.asarray(T)

    def board_seen(self, flange: Array) -> Array:
        """camera_from_board (n, 4, 4)"""
        if self.mount == "eye-in-hand":
            return np.asarray(inverse(flange @ self.X) @ self.Y)
        return np.asarray(inverse(self.X) @ flange @ self.Y)


def draw_errors(rng: np.random.Generator, size: float) -> Array:
    """(5, 6) of all but the eight that X and the board's pose take."""
    errors = np.zeros((5, 6))
    errors[[0, 2], :5] = rng.normal(size=(2, 5))
    errors[1, 3:5] = rng.normal(size=2) * [3**0.5, 1.0]
    errors[3, 1:5], errors[4, 1:3] = rng.normal(size=4), rng.normal(size=2)
    return np.asarray(1e-3 * size * errors)


def draw_cell(rng: np.random.Generator, mount: Mount, size: float, told: Tolerances) -> tuple[Truth, Array]:
    """A cell, and joints (POOL, 6) of one arm branch from where its camera sees the board."""
    while True:
        X, Y = mounted(rng, mount)
        C = np.array([look(rng, LENS, POINTS) for _ in range(POOL)])
        flange = Y @ inverse(C) @ inverse(X) if mount == "eye-in-hand" else X @ C @ inverse(Y)
        _, joints, branch = inverse_many(ARM, flange)
        joints = joints[branch == np.bincount(branch).argmax()]
        if len(joints) >= 0.5 * POOL:
            break
    half = POINTS[:, :2].max(axis=0) / 2
    u, v = (POINTS[:, :2] / half - 1).T
    s, unequal = told.board * rng.normal(size=2)
    scale = 1.0 + s + np.array([unequal, -unequal]) / 2
    about = rng.uniform(0, np.pi)
    bend = _BENT_M * rng.normal() * (1.0 - (np.cos(about) * u + np.sin(about) * v) ** 2)
    errors = draw_errors(rng, size)
    points = np.column_stack([POINTS[:, :2] * scale, bend])
    return Truth(mount, X, Y, errors, points, told), joints


def lens_sigma(told: Tolerances) -> Array:
    """(9,) the usual tolerance of a given lens, smaller with its focal length's."""
    return LensPrior.given(LENS).sigma * told.lens / 2e-3


def capture(rng: np.random.Generator, truth: Truth, joints: Array) -> ViewSet:
    n = len(joints)
    true = perturb(truth.flange(joints), rng.normal(size=(n, 6)) * np.repeat([ROBOT_M, ROBOT_RAD], 3))
    pixels = project_pixels(LENS, transform_points(truth.board_seen(true), truth.points))
    pixels = pixels + CORNER_PX * rng.normal(size=pixels.shape)
    said = forward(ARM, joints)
    views = tuple(BoardView(i, f"view {i}", said[i], POINTS, pixels[i], joints[i]) for i in range(n))
    off = lens_sigma(truth.told) * rng.normal(size=len(intrinsics_names(LENS)))
    off[1] = off[0]  # pixels are square
    told = with_intrinsics_vector(LENS, intrinsics_vector(LENS) + off)
    return solve_pnp(ViewSet(truth.mount, views, told, ARM.name), BOARD)


def planned(
    truth: Truth, pool: Array, count: int, rng: np.random.Generator, criterion: Criterion = "arm"
) -> Array:
    """Joints (count, 6) chosen as `station plan --for arm` does: from the nominal cell alone."""
    nominal = replace(truth, errors=np.zeros((5, 6)))
    flange = nominal.flange(pool)
    motion = CHAIN.by_links(pool)
    noise = MeasurementNoise(CORNER_PX, ROBOT_M, ROBOT_RAD)
    gains = view_information(truth.mount, LENS, flange, truth.X, truth.Y, POINTS, noise, motion)
    board = BoardTolerance(truth.told.board, _BENT_M)
    prior = prior_information(LENS, True, board, LINK_ERROR_MM, LensPrior.given(LENS, lens_sigma(truth.told)))
    room_q = sample_workspace(ARM, pool)
    room = Workspace.of(truth.mount, forward(ARM, room_q), CHAIN.by_links(room_q), truth.X, truth.Y, _AHEAD_M)
    objective = Objective(criterion, _AHEAD_M, prior, None, room.among(len(prior)))
    best = choose(gains, count, objective, rng, sweeps=2)
    return np.asarray(pool[best])


@dataclass(frozen=True, eq=False)
class Judge:
    """Points over the workspace and near the board, their true places, and how far an answer is off."""

    truth: Truth
    joints: Array

    @classmethod
    def everywhere(cls, truth: Truth, like: Array, rng: np.random.Generator) -> Judge:
        """400 poses, any way up, 0.35 to 0.9 of the reach about the shoulder and above it, in one branch."""
        _, solutions, branches = inverse_many(ARM, forward(ARM, like[:1]))
        own = branches[np.abs(np.exp(1j * solutions) - np.exp(1j * like[0])).max(axis=1).argmin()]
        reach, joints = abs(ARM.a_m[1]) + abs(ARM.a_m[2]), np.zeros((0, 6))
        while len(joints) < 400:
            at = rng.uniform(-1, 1, (3000, 3)) * [1, 1, 0.5] + [0, 0, 0.5]
            at = at[(np.linalg.norm(at, axis=1) > 0.35) & (np.linalg.norm(at, axis=1) < 0.9)]
            R = np.array([random_rotation(rng) for _ in at])
            _, q, branch = inverse_many(ARM, pose(R, reach * at + [0, 0, ARM.d_m[0]]))
            joints = np.concatenate([joints, q[branch == own]])
        return cls(truth, joints[:400])

    @classmethod
    def near(cls, truth: Truth, pool: Array) -> Judge:
        return cls(truth, pool[:200])

    def error_mm(self, X: Array, flange: Callable[[Array], Array]) -> float:
        """rms, one rigid motion of all points taken out."""
        true = self.truth.flange(self.joints)
        said = flange(self.joints)
        if self.truth.mount == "eye-in-hand":
            at, told = ((way @ [0.0, 0.0, _AHEAD_M, 1.0])[:, :3] for way in (true @ self.truth.X, said @ X))
            return float(1e3 * rms_fitted(told, at))
        held = (self.truth.Y @ np.append(POINTS.mean(axis=0), 1.0))[:3]
        at = transform_points(X @ inverse(self.truth.X), true[:, :3, :3] @ held + true[:, :3, 3])
        # The point that the flange carries is free: at = said (R p + t).
        A, b = said[:, :3, :3].reshape(-1, 3), (at - said[:, :3, 3]).reshape(-1)
        off = b - A @ np.linalg.lstsq(A, b, rcond=None)[0]
        return float(1e3 * np.sqrt(3 * (off**2).mean()))


def rms_fitted(told: Array, at: Array) -> float:
    """rms distance after the best rigid motion (Kabsch)."""
    a, b = told - told.mean(axis=0), at - at.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = (U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt).T
    return float(np.sqrt(((a @ R.T - b) ** 2).sum(axis=1).mean()))


def solved(views: ViewSet, told: Tolerances, model_arm: bool = True, folds: bool = False) -> Solution:
    options = SolveOptions(
        holdout=False,
        folds=folds,
        model_arm=model_arm,
        lens_sigma=tuple(lens_sigma(told).tolist()),
        board=BoardTolerance(told.board, _BENT_M),
    )
    return solve_views(views, options)


def measure(
    seed: int, mount: Mount, size: float, told: Tolerances, count: int, plan: bool
) -> dict[str, float]:
    """Figures of one cell; the same seed gives the same cell to every way."""
    rng = np.random.default_rng([77, seed, int(1e3 * size), mount == "eye-in-hand"])
    truth, pool = draw_cell(rng, mount, size, told)
    everywhere, near = Judge.everywhere(truth, pool, rng), Judge.near(truth, pool)
    chosen = planned(truth, pool, count, rng) if plan else pool[rng.permutation(len(pool))[:count]]
    views = capture(rng, truth, chosen)
    found: dict[str, float] = {}
    nominal = partial(forward, ARM)
    H, C = mount_poses(views.base_from_flange, mount), views.camera_from_board
    park = opencv_hand_eye(H, C, HAND_EYE["Park-Martin"])
    plain = solved(views, told, model_arm=False)
    with_table = solved(views, told, folds=True)
    arm = with_table.arm
    assert arm is not None and arm.result is not None and arm.uncorrected is not None
    result = arm.result
    corrected = result.corrected.forward
    for name, judge_ in (("everywhere", everywhere), ("near", near)):
        for way, X, flange in (
            ("park", park, nominal),
            ("plain", plain.matrix, nominal),
            ("bare", with_table.matrix, nominal),
            ("compromise", arm.uncorrected.X, nominal),
            ("table", with_table.matrix, corrected),
        ):
            found[f"{name} {way}"] = judge_.error_mm(X, flange)
    found["claimed"] = 1e3 * result.error_m
    found["claimed without"] = 1e3 * arm.uncorrected.error_m
    for way, solution in (("plain", plain), ("table", with_table)):
        miss = Miss.of(solution, truth.X)
        found |= {f"X {way}": 1e3 * miss.shift_m, f"inside {way}": float(miss.covered)}
    q = everywhere.joints[:100]
    delta = difference(corrected(q), truth.flange(q))
    S = (T := CHAIN.by_links(q)) @ result.covariance[6:, 6:] @ np.swapaxes(T, 1, 2)
    square = np.einsum("ni,nij,nj->n", delta, np.linalg.inv(S), delta)
    found["inside flange"] = float((square <= with_table.confidence_threshold).mean())
    gates = judge(with_table, GateInputs(None, None), GateLimits())
    found["refused"] = float(not all(gate.passed for gate in gates))
    found["offered"] = float(result.offered)
    return found


@dataclass(frozen=True)
class Row:
    name: str
    mount: Mount
    size: float
    told: Tolerances
    views: int
    planned: bool = False
    cells: int = TRIALS


PLACES: tuple[tuple[Mount, str], ...] = (("eye-in-hand", ""), ("eye-to-hand", ", to hand"))
ROWS = (
    Row("0.3 mm, measured, 50 planned", "eye-in-hand", 0.3, GOOD, 50, planned=True),
    Row("0.3 mm, measured, 50 random", "eye-in-hand", 0.3, GOOD, 50),
    Row("0.3 mm, usual, 50 planned", "eye-in-hand", 0.3, LOOSE, 50, planned=True),
    *(
        Row(f"{size:g} mm, usual, 25 random{place}", mount, size, LOOSE, 25, cells=cells)
        for cells, sizes in ((TRIALS, (0.0, 0.3)), (40, (0.1, 0.5)))
        for mount, place in PLACES
        for size in sizes
    ),
)


def run() -> str:
    tasks = [(row, seed) for row in ROWS for seed in range(trials(row.cells))]
    found: dict[str, list[dict[str, float]]] = {row.name: [] for row in ROWS}
    for (row, _), cell in zip(tasks, in_processes(_measured, tasks), strict=True):
        found[row.name].append(cell)
    return described(found)


def _measured(task: tuple[Row, int]) -> dict[str, float]:
    row, seed = task
    return measure(seed, row.mount, row.size, row.told, row.views, row.planned)


def described(found: dict[str, list[dict[str, float]]]) -> str:
    """Tables of figures by row and cell."""

    def of(cells: list[dict[str, float]], key: str) -> Array:
        return np.array([cell[key] for cell in cells])

    def root(cells: list[dict[str, float]], key: str) -> str:
        return f"{rms(of(cells, key)):.2f}"

    def share(cells: list[dict[str, float]], key: str) -> str:
        part = float(of(cells, key).mean())
        return f"{100 * part:.0f} ± {100 * share_spread(part, len(cells)):.0f}"

    def against(cells: list[dict[str, float]], way: str, place: str) -> str:
        ratio = of(cells, f"{place} {way}") / of(cells, f"{place} park")
        return f"{np.median(ratio):.2f}, {100 * (ratio > 1.03).mean():.0f}"

    errors = [
        (
            name,
            len(cells),
            *(root(cells, f"everywhere {way}") for way in ("park", "plain", "compromise", "table", "bare")),
            root(cells, "claimed"),
            against(cells, "compromise", "everywhere"),
            against(cells, "compromise", "near"),
            against(cells, "bare", "near"),
        )
        for name, cells in found.items()
    ]
    known = [
        (
            name,
            f"{rms(of(cells, 'X plain')):.3f} → {rms(of(cells, 'X table')):.3f}",
            f"{share(cells, 'inside plain')} → {share(cells, 'inside table')}",
            share(cells, "inside flange"),
            share(cells, "offered"),
            share(cells, "refused"),
        )
        for name, cells in found.items()
    ]
    text = (
        "Measured: board and lens known to 0.02 %; usual: 0.3 % and 0.2 %. Over the workspace, rms mm: Park "
        "(lens as given), the estimate without a table, the X installed for the arm as it is, X with its "
        "table, and that X on the arm as it is. Against Park: median ratio, % of cells with more than 1.03."
    )
    first = table(
        ("arm, board and lens, views", "cells", "Park", "no table", "installed", "with table", "its X bare",
         "claimed with table", "installed / Park, %", "near the board", "bare, near"),
        errors,
    )  # fmt: skip
    second = table(
        ("arm, board and lens, views", "X mm, plain → table", "X covered %", "new flanges covered %",
         "offered %", "refused %"),
        known,
    )  # fmt: skip
    return f"{text}\n\n{first}\n\n{second}"
