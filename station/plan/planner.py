"""From a rough idea of the cell to a plan: candidates, one arm branch, the best 25, a short safe order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import msgspec
import numpy as np

from calibrate.boards.model import board_points
from calibrate.geometry import Array
from calibrate.handeye.information import MeasurementNoise
from calibrate.kinematics import forward
from station.cell.config import StationConfig
from station.cell.errors import LimitError
from station.cell.limits import check_plan
from station.cell.plan import Plan
from station.cell.scene import Scene, require_kept_clear, scene_of
from station.plan.candidates import Pool, find_candidates
from station.plan.choose import Criterion, Objective, choose, informations, objective_for, sigma_of
from station.plan.describe import expected_view, planned_pose
from station.plan.explain import explain_shortage, looks_back
from station.plan.groups import best_group
from station.plan.order import BLOCKED, move_times, short_order, time_matrix
from station.plan.view_range import ViewRange, view_range
from station.plan.visibility import blind_share, visible

Progress = Callable[[str, float], None]
POOL_SIZE = 1200
"""Against 480, both errors are 4 to 6 % smaller (forecast on random cells)."""
_BLIND = 0.5
"""A move without the board in the picture counts as so much longer when the order is chosen."""
_TRIES = 12
"""Camera poses looked at per wanted member of the pool; most fall to the guess's uncertainty."""


@dataclass(frozen=True)
class PlanOptions:
    count: int = 25
    seed: int = 0
    criterion: Criterion = "A"
    noise: MeasurementNoise = field(default_factory=MeasurementNoise)
    free_intrinsics: bool = True
    """The lens is calibrated from the same pictures."""
    view: ViewRange | None = None
    """None = by the lens and the board's size."""
    pool: int = POOL_SIZE


def make_plan(
    config: StationConfig,
    *,
    start_joints_rad: Sequence[float] | None = None,
    seed: int = 0,
    count: int = 25,
    criterion: Criterion = "A",
    lens_known: bool = False,
    progress: Progress = lambda text, done: None,
) -> Plan:
    """A plan of `count` poses for the configured cell. Deterministic by seed; takes seconds.

    `lens_known`: the pictures need not tell the lens too, as when an installed calibration is checked.
    ConfigError when the configuration lacks what planning needs; LimitError when there is no such plan,
    saying which limit binds and what to change.
    """
    require_kept_clear(config)
    options = PlanOptions(count=count, seed=seed, criterion=criterion, free_intrinsics=not lens_known)
    return plan_scene(scene_of(config), options, start_joints_rad, progress)


def plan_scene(
    scene: Scene,
    options: PlanOptions,
    start_joints_rad: Sequence[float] | None = None,
    progress: Progress = lambda text, done: None,
    captured: Array | None = None,
) -> Plan:
    """The same, for a scene that is already known; `captured`: flange poses (n, 4, 4) that were taken."""
    rng = np.random.default_rng(options.seed)
    start = None if start_joints_rad is None else np.asarray(start_joints_rad, dtype=float)
    progress("looking for poses", 0.0)
    pool, notes = candidate_pool(scene, options, start, rng)
    plan = _choose_and_order(scene, options, pool, start, rng, progress, captured)
    progress("done", 1.0)
    return msgspec.structs.replace(plan, note="; ".join(notes))


def _relaxed(view: ViewRange, start_roll_rad: float | None) -> list[tuple[ViewRange, str]]:
    """The wanted range, then ever less particular ones, each with what is to be said about it."""
    rolls = [0.0, np.pi / 2, -np.pi / 2, np.pi] if start_roll_rad is None else [start_roll_rad, 0.0]
    views = [(replace(view, roll_centre_rad=roll), "") for roll in rolls]
    doubtful = replace(views[0][0], doubt=2.0, off_centre=0.2)
    rolled = replace(doubtful, roll_rad=np.pi, doubt=1.0, border_px=6.0)
    near, far = view.distance_m
    wide = replace(rolled, doubt=0.5, off_centre=0.1, distance_m=(0.85 * near, 1.3 * far))
    return [
        *views,
        (doubtful, "the guess is rough: some pictures may cut the board"),
        (rolled, "poses of any roll had to be used, and some pictures may cut the board"),
        (wide, "unusual distances had to be used; pictures may cut the board"),
    ]


def _start_roll(scene: Scene, start: Array | None) -> float | None:
    """Roll of the board as seen from the start, rad; None where the start does not look at it."""
    if start is None:
        return None
    flange = forward(scene.geometry.model, start)
    if not visible(scene.camera, scene.seen(flange[None], board_points(scene.board)), 0.0)[0]:
        return None
    return expected_view(scene, flange).roll_rad


def candidate_pool(
    scene: Scene, options: PlanOptions, start: Array | None, rng: np.random.Generator
) -> tuple[Pool, list[str]]:
    """Candidates of the best branch. LimitError with the reason when the widest range has too few."""
    best: tuple[Pool, Pool, str] | None = None
    for view, note in _relaxed(options.view or view_range(scene), _start_roll(scene, start)):
        found = find_candidates(scene, view, 2 * options.pool, rng, start, _TRIES * options.pool)
        group = best_group(scene, found, start, options.pool, 3 * options.count)
        if best is None or len(group) > len(best[0]):
            best = group, found, note
        if len(group) >= 3 * options.count:
            break
    assert best is not None
    group, found, note = best
    if len(group) < options.count or looks_back(scene, found):
        raise LimitError(explain_shortage(scene, options.count, group, found, start))
    return group, [note] if note else []


def _choose_and_order(
    scene: Scene,
    options: PlanOptions,
    pool: Pool,
    start: Array | None,
    rng: np.random.Generator,
    progress: Progress,
    captured: Array | None,
) -> Plan:
    """The checked plan. Poses that no free way leads to leave the pool, and the choice is made again."""
    objective = objective_for(scene, options.criterion, options.free_intrinsics)
    information = informations(scene, pool.base_from_flange, options.noise)
    known: Array | None = None
    if captured is not None:
        known = informations(scene, captured, options.noise).sum(axis=0)
    left = np.arange(len(pool))
    picked: list[int] = []
    while len(left) >= options.count:
        # The first choice is polished; when poses without a free way leave, only their places are filled.
        kept = tuple(int(k) for k in np.flatnonzero(np.isin(left, picked)))
        chosen = _chosen(
            information[left],
            known,
            options.count,
            objective,
            rng,
            keep=kept,
            sweeps=0 if kept else 6,
            progress=lambda done: progress("choosing", 0.3 + 0.5 * done),
        )
        progress("ordering", 0.85)
        places = left[chosen]
        order, blocked = _ordered(scene, pool.joints_rad[places], start, options.seed)
        if not blocked:
            places = places[order]
            plan = _describe(scene, options, pool.joints_rad[places], information[places], objective, known)
            progress("checking", 0.95)
            blocked = _failing(plan, start, scene)
            if not blocked:
                return plan
        gone = places[blocked]
        left, picked = np.setdiff1d(left, gone), [p for p in places if p not in gone]
    raise LimitError(explain_shortage(scene, options.count, pool.take(left), pool, start))


def _chosen(
    pool: Array,
    known: Array | None,
    count: int,
    objective: Objective,
    rng: np.random.Generator,
    keep: tuple[int, ...],
    sweeps: int,
    progress: Callable[[float], None],
) -> list[int]:
    """`choose`, beside what is `known` (p, p): that counts as one more member, which stays in."""
    if known is None:
        return choose(pool, count, objective, rng, keep, sweeps, progress)
    stays = (0, *(place + 1 for place in keep))
    chosen = choose(np.concatenate([known[None], pool]), count + 1, objective, rng, stays, sweeps, progress)
    return [place - 1 for place in chosen[1:]]


def _ordered(scene: Scene, joints: Array, start: Array | None, seed: int) -> tuple[list[int], list[int]]:
    """A short order of joints (n, 6), in which moves that lose the board count as longer; unfree members."""
    times = time_matrix(scene.geometry, joints)
    i, j = np.triu_indices(len(joints), 1)
    blind = np.zeros_like(times)
    blind[i, j] = blind[j, i] = blind_share(scene, joints[i], joints[j])
    lead = np.zeros(len(joints))
    if start is not None:
        lead = move_times(scene.geometry, np.repeat(start[None], len(joints), axis=0), joints)
    order = short_order(times * (1 + _BLIND * blind), lead, seed)
    if lead[order[0]] == BLOCKED:
        return order, [order[0]]
    free = np.isfinite(times).sum(axis=1)
    return order, [min(legs, key=lambda m: free[m]) for legs in pairwise(order) if times[legs] == BLOCKED]


def _failing(plan: Plan, start: Array | None, scene: Scene) -> list[int]:
    """Places of poses whose move does not pass the dense check. LimitError when the plan as such is wrong."""
    check = check_plan(plan, start, scene.geometry)
    failing = [place for place, move in enumerate(check.moves) if move.problems]
    if check.problems and not failing:
        raise LimitError("\n".join(map(str, check.problems)))
    return failing


def _describe(
    scene: Scene,
    options: PlanOptions,
    joints: Array,
    gained: Array,
    objective: Objective,
    before: Array | None,
) -> Plan:
    flange = forward(scene.geometry.model, joints)
    known = gained.cumsum(axis=0) + (0.0 if before is None else before)
    poses = tuple(
        planned_pose(scene, number, joints[number], flange[number], sigma_of(known[number], objective)[0])
        for number in range(len(joints))
    )
    limits = scene.geometry.limits
    return Plan(
        robot=scene.geometry.model.name,
        mount=scene.mount,
        poses=poses,
        joint_speed_rad_s=limits.joint_speed_rad_s,
        joint_acceleration_rad_s2=limits.joint_acceleration_rad_s2,
        seed=options.seed,
    )
