"""Planner: candidates by the initial camera and board poses, one arm branch, the best set, a short order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from calibrate.arms.chain import chain_of
from calibrate.arms.kinematics import forward
from calibrate.boards.model import board_points
from calibrate.handeye.information import USUAL_NOISE, predicted_error_m
from calibrate.handeye.metrics import median_distance_m
from calibrate.handeye.noise_scales import MeasurementNoise
from calibrate.handeye.placed_point import PointPrediction
from calibrate.handeye.priors import BoardTolerance
from calibrate.handeye.unlearned_arm import UnlearnedArm
from recordings.geometry import Array
from station.cell.config import StationConfig
from station.cell.errors import LimitError
from station.cell.layout import CellLayout, layout_of, require_kept_clear
from station.cell.limits import check_plan
from station.cell.pose_plan import Criterion, Plan
from station.plan.candidates import (
    ARM_IN_SIGHT,
    NOT_IN_PICTURE,
    OUT_OF_REACH,
    CandidateSet,
    best_group,
    find_candidates,
)
from station.plan.choose import Objective, arm_objective, camera_objective, choose, informations
from station.plan.order import ordered
from station.plan.visibility import ViewRange, expected_view, planned_pose, view_range, visible

Progress = Callable[[str, float], None]
POOL_SIZE = 1200
"""Size of the pool. Compared with 480, both placed-point errors are 4 to 6 % smaller (random cells)."""
_TRIES = 12
"""Views drawn per wanted member of the pool; most are rejected for the uncertainty of the initial poses."""
_LOOKS_BACK = "the camera looks back at the arm, which hides the board"
_CUT_OFF = "free direct moves from where the arm stands"
_REMEDIES = {
    _LOOKS_BACK: "Turn camera_guess by 180° about its x or y axis: z points out of the lens.",
    _CUT_OFF: "Bring the arm to where the camera looks at the board from the middle of the arm's room.",
    OUT_OF_REACH: "Bring the board (eye-to-hand: the camera) nearer, or correct its guess.",
    NOT_IN_PICTURE: "Measure camera_guess and board_guess better, use a smaller board or a wider lens.",
    "the joint range": "Widen limits.joints_min_rad and joints_max_rad, or turn the board.",
    "singular postures": "Move the board sideways, so that the arm need not stretch or fold.",
    ARM_IN_SIGHT: "Turn the board to face the camera, mount the camera so that it looks away from the arm, "
    "or correct camera_guess.",
    "the workspace box": "Widen limits.workspace_min_m and workspace_max_m, or move the board to its middle.",
    "the arm touching itself or its tool": "Check limits.solids, or move the board further from the base.",
    "the board": "Lower limits.board_clearance_m, measure board_guess better (its sigma counts), or turn it.",
    "the camera": "Work further from the camera, or measure camera_guess better (its sigma counts).",
}
_KEPT_CLEAR = (
    "Move the board away from what the arm would touch, or correct limits.planes and board_guess (the "
    "board's z axis points into the board)."
)

_BACKWARDS = -0.3
"""Cosine between the flange's axis and the line of sight of a camera that looks back at the arm."""
_KEYHOLE = 10
"""Ratio of views hidden by the arm to free ones above which the camera is taken to look back at the arm."""


def explain_shortage(
    layout: CellLayout, wanted: int, group: CandidateSet, found: CandidateSet, start: Array | None
) -> LimitError:
    """Make the error that says why there is no plan. `group`: usable candidates; `found`: all."""
    lost, alone = found.lost, found.alone
    ranked = (alone if alone.total() else lost).most_common(2)
    limiting = [limit for limit, count in ranked if count and limit not in (NOT_IN_PICTURE, OUT_OF_REACH)]
    if looks_back(layout, found):
        limiting = [_LOOKS_BACK]
    elif start is not None and len(group) < wanted <= len(found):
        limiting = [_CUT_OFF]
    elif lost[OUT_OF_REACH] > 2 * len(found) and lost[OUT_OF_REACH] >= alone.total():
        limiting = [OUT_OF_REACH]
    elif not alone.total() and lost[NOT_IN_PICTURE] > max(lost.values(), default=0) / 2:
        limiting.insert(0, NOT_IN_PICTURE)
    return LimitError(
        "too-few-poses",
        possible=len(group),
        wanted=wanted,
        limiting=", ".join(limiting) or "none alone",
        advice=" ".join(dict.fromkeys(_REMEDIES.get(limit, _KEPT_CLEAR) for limit in limiting)),
    )


def looks_back(layout: CellLayout, found: CandidateSet) -> bool:
    """Tell whether the configured camera looks back at the arm, which then hides the board in most views."""
    backwards = layout.mount == "eye-in-hand" and layout.X[2, 2] < _BACKWARDS
    return bool(backwards and found.alone[ARM_IN_SIGHT] > _KEYHOLE * len(found))


@dataclass(frozen=True)
class PlanOptions:
    count: int = 25
    seed: int = 0
    criterion: Criterion = "A"
    noise: MeasurementNoise = USUAL_NOISE
    free_intrinsics: bool = True
    """True: the intrinsics are estimated from the same images."""
    view: ViewRange | None = None
    """Range of views; None: chosen by lens and board size."""
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
    """Make a plan of `count` poses for the configured cell. Deterministic by seed; takes seconds.

    `lens_known`: intrinsics are not to be estimated, as in a drift check. ConfigError when the configuration
    lacks what planning needs; LimitError, with the limiting constraint and the remedy, when there is no plan.
    """
    require_kept_clear(config)
    options = PlanOptions(count=count, seed=seed, criterion=criterion, free_intrinsics=not lens_known)
    return plan_layout(layout_of(config), options, start_joints_rad, progress)


def plan_layout(
    layout: CellLayout,
    options: PlanOptions,
    start_joints_rad: Sequence[float] | None = None,
    progress: Progress = lambda text, done: None,
) -> Plan:
    """Make a plan for a layout, as `make_plan`."""
    rng = np.random.default_rng(options.seed)
    start = None if start_joints_rad is None else np.asarray(start_joints_rad, dtype=float)
    progress("looking for poses", 0.0)
    pool, notes = candidate_pool(layout, options, start, rng)
    plan = _choose_and_order(layout, options, pool, start, rng, progress)
    progress("done", 1.0)
    return msgspec.structs.replace(plan, note="; ".join(notes))


def _relaxed(view: ViewRange, start_roll_rad: float | None) -> list[tuple[ViewRange, str]]:
    """List the wanted range of views and ever wider ones, each with the note for the plan."""
    rolls = [0.0, np.pi / 2, -np.pi / 2, np.pi] if start_roll_rad is None else [start_roll_rad, 0.0]
    views = [(replace(view, roll_centre_rad=roll), "") for roll in rolls]
    doubtful = replace(views[0][0], doubt=2.0, off_centre=0.2)
    rolled = replace(doubtful, roll_rad=np.pi, doubt=1.0, border_px=6.0)
    near, far = view.distance_m
    wide = replace(rolled, doubt=0.5, off_centre=0.1, distance_m=(0.85 * near, 1.3 * far))
    return [
        *views,
        (doubtful, "the initial poses are rough: some images may cut the board"),
        (rolled, "poses of any roll had to be used, and some images may cut the board"),
        (wide, "unusual distances had to be used; images may cut the board"),
    ]


def _start_roll(layout: CellLayout, start: Array | None) -> float | None:
    """Compute the board's roll in the view from the start, rad; None where it is not seen from there."""
    if start is None:
        return None
    flange = forward(layout.geometry.model, start)
    if not visible(layout.camera, layout.seen(flange[None], board_points(layout.board)), 0.0)[0]:
        return None
    return expected_view(layout, flange).roll_rad


def candidate_pool(
    layout: CellLayout, options: PlanOptions, start: Array | None, rng: np.random.Generator
) -> tuple[CandidateSet, list[str]]:
    """Find the candidates of the best branch, and notes. LimitError where the widest range has too few."""
    best: tuple[CandidateSet, CandidateSet, str] | None = None
    for view, note in _relaxed(options.view or view_range(layout), _start_roll(layout, start)):
        found = find_candidates(layout, view, 2 * options.pool, rng, start, _TRIES * options.pool)
        group = best_group(layout, found, start, options.pool, 3 * options.count)
        if best is None or len(group) > len(best[0]):
            best = group, found, note
        if len(group) >= 3 * options.count:
            break
    assert best is not None
    group, found, note = best
    if len(group) < options.count or looks_back(layout, found):
        raise explain_shortage(layout, options.count, group, found, start)
    return group, [note] if note else []


def _choose_and_order(
    layout: CellLayout,
    options: PlanOptions,
    pool: CandidateSet,
    start: Array | None,
    rng: np.random.Generator,
    progress: Progress,
) -> Plan:
    """Choose and order poses, and check the plan; repeat without poses that no free path leads to."""
    free, joints = options.free_intrinsics, None
    if options.criterion == "arm":
        joints = pool.joints_rad
        objective = arm_objective(layout, free, joints)
    else:
        objective = camera_objective(layout.camera, layout.board, layout.working_distance_m, free)
    information = informations(layout, pool.base_from_flange, joints, options.noise)
    left = np.arange(len(pool))
    picked: list[int] = []
    while len(left) >= options.count:
        # After the first choice only the poses without a free path are replaced.
        kept = tuple(int(k) for k in np.flatnonzero(np.isin(left, picked)))
        chosen = choose(
            information[left],
            options.count,
            objective,
            rng,
            keep=kept,
            progress=lambda done: progress("choosing", 0.3 + 0.5 * done),
        )
        progress("ordering", 0.85)
        places = left[chosen]
        order, blocked = ordered(layout.geometry, pool.joints_rad[places], start, options.seed)
        if not blocked:
            places = places[order]
            plan = _describe(layout, options, pool.joints_rad[places], information[places], objective)
            progress("checking", 0.95)
            blocked = _failing(plan, start, layout)
            if not blocked:
                return plan
        gone = places[blocked]
        left, picked = np.setdiff1d(left, gone), [p for p in places if p not in gone]
    raise explain_shortage(layout, options.count, pool.take(left), pool, start)


def _failing(plan: Plan, start: Array | None, layout: CellLayout) -> list[int]:
    """List the poses whose move fails the dense check. LimitError when the plan itself violates a limit."""
    check = check_plan(plan, start, layout.geometry)
    failing = [place for place, move in enumerate(check.moves) if move.problems]
    if check.problems and not failing:
        raise LimitError("plan-breaks-limits", listed="\n".join(map(str, check.problems)))
    return failing


def _describe(
    layout: CellLayout,
    options: PlanOptions,
    joints: Array,
    gained: Array,
    objective: Objective,
) -> Plan:
    model = layout.geometry.model
    distance_m = median_distance_m(layout.camera_from_board(forward(model, joints)))
    predicted = _predict(layout, options, joints, distance_m, gained, objective)
    poses = tuple(
        planned_pose(layout, number, q, error_m)
        for number, (q, error_m) in enumerate(zip(joints, predicted.errors_m, strict=True))
    )
    limits = layout.geometry.limits
    return Plan(
        robot=model.name,
        mount=layout.mount,
        poses=poses,
        joint_speed_rad_s=limits.joint_speed_rad_s,
        joint_acceleration_rad_s2=limits.joint_acceleration_rad_s2,
        seed=options.seed,
        criterion=options.criterion,
        working_distance_m=round(distance_m, 4),
        floor_m=round(predicted.floor_m, 9),
    )


@dataclass(frozen=True)
class _Predicted:
    """The error of a placed point, metres."""

    errors_m: list[float]
    """After each of the poses."""
    floor_m: float
    """Part of the last one by the arm: no pose more lowers it."""


def _predict(
    layout: CellLayout,
    options: PlanOptions,
    joints: Array,
    distance_m: float,
    gained: Array,
    objective: Objective,
) -> _Predicted:
    """Predict for a point so far from the camera, at postures (n, 6), by what each gains (n, p, p)."""
    model = layout.geometry.model
    learns_arm = options.criterion == "arm"
    by_links = chain_of(model).by_links(joints) if learns_arm else None
    flange = forward(model, joints)
    point = PointPrediction.of(layout.mount, layout.X, flange, distance_m, options.noise, by_links)
    known_m = np.array([predicted_error_m(known, objective.prior, point) for known in gained.cumsum(axis=0)])
    # What a plan for the arm gains holds the errors of its links already.
    arm_m = np.zeros(len(joints)) if learns_arm else _arm_parts_m(layout, options, flange, distance_m)
    return _Predicted(np.hypot(known_m, arm_m).tolist(), float(np.hypot(point.floor_m, arm_m[-1])))


def _arm_parts_m(layout: CellLayout, options: PlanOptions, flange: Array, distance_m: float) -> Array:
    """Compute the part of the error by the arm's own errors after each of the flanges (n, 4, 4): (n,) metres.

    As while capturing (`UnlearnedArm`); none where no typical arm reaches all flanges.
    """
    count = len(flange)
    if layout.of_class is None:
        return np.zeros(count)
    arm = UnlearnedArm.of(
        layout.mount,
        layout.camera,
        flange,
        layout.X,
        layout.Y,
        board_points(layout.board),
        options.noise,
        BoardTolerance.of(layout.board),
        not options.free_intrinsics,
        layout.of_class,
        distance_m,
    )
    if arm is None:
        return np.zeros(count)
    taken = np.tri(count)
    return np.array([arm.part_m(weights) for weights in taken])


def predicted_errors_m(
    config: StationConfig, plan: Plan, taken: Sequence[int], *, lens_known: bool = False
) -> list[float]:
    """Predict the placed-point error (m) after each of the poses `taken`, where others of the plan are not.

    taken: numbers of poses, in order. At the plan's working distance; with all poses as the plan itself says.
    ConfigError when the configuration lacks what planning needs.
    """
    if not taken:
        return []
    layout = layout_of(config)
    options = PlanOptions(criterion=plan.criterion or "A", free_intrinsics=not lens_known)
    joints = np.array([plan.poses[index].joints_rad for index in taken], dtype=float)
    flange = forward(layout.geometry.model, joints)
    free = options.free_intrinsics
    if options.criterion == "arm":
        gained = informations(layout, flange, joints, options.noise)
        objective = arm_objective(layout, free, joints)
    else:
        gained = informations(layout, flange, None, options.noise)
        objective = camera_objective(layout.camera, layout.board, layout.working_distance_m, free)
    distance_m = plan.working_distance_m or median_distance_m(layout.camera_from_board(flange))
    return _predict(layout, options, joints, distance_m, gained, objective).errors_m
