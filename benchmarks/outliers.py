"""Effect of wrong views, and of changes half-way, on X. Ours against an oracle that knows which to use."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.imperfect_cells import BOARD, ImperfectCell, Known, imperfect_cell
from benchmarks.scene import MID
from benchmarks.trials import Miss, rows_of, table, trials
from calibrate.errors import CalibrationError
from calibrate.handeye.solution import Reading, Solution, SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.lens.pnp import solve_pnp
from calibrate.pipeline.gates import judge
from calibrate.pipeline.job import single_threaded_opencv
from calibrate.views.view_set import BoardView, Places, ViewSet
from recordings.geometry import Array, inverse, perturb, pose, rotation_exp, transform_points
from recordings.schema.messages import Mount

TRIALS = 60
_VIEWS = 25
_OPTIONS = SolveOptions(holdout=False)
_ORACLE = SolveOptions(holdout=False, folds=False)
_SINGLE, _CHANGES = (0.1, 0.2, 0.4), (0.2, 0.35, 0.5)
MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
HEADER = ("what is wrong", "views", "mount", "pass %", "refused, a reading named %", "ours rms mm",
          "oracle rms mm", "ours / oracle", "rotation ours / oracle", "coverage %", "named truly %",
          "named falsely %")  # fmt: skip


@dataclass(frozen=True, eq=False)
class Spoilt:
    views: ViewSet
    X: Array
    """(4, 4) the true one of the last view."""
    good: list[int]
    """Views that the oracle uses: those that are right, or those on the longer side of a change."""
    reading: Reading = Reading.AS_RECORDED
    kind: str = ""
    """True cause of each bad view."""
    X_oracle: Array | None = None
    """The true one of the oracle's views, where it is another one."""


@dataclass(frozen=True)
class OutlierTrial:
    passed: bool
    reading: str
    """Cause that was named; where nothing was solved, the error's own name."""
    oracle: Miss
    truly: bool
    falsely: bool
    ours: Miss | None = None
    """None where nothing was solved."""


Spoil = Callable[[ImperfectCell, Places, np.random.Generator], Spoilt]


def run() -> str:
    count = trials(TRIALS)
    cases = [
        (name, share, mount)
        for shares, kinds in ((_SINGLE, _VIEWS_WRONG), (_CHANGES, _CHANGED))
        for name in kinds
        for share in shares
        for mount in MOUNTS
    ]
    rows = rows_of(measure, cases, count, line)
    text = (
        f"{count} cells per row (`imperfect_cells`, the lens given, nothing else wrong), {_VIEWS} views. "
        "Shuffled: the poses of all bad views exchanged; turned: "
        "corners in the order of the board turned by 180°; far: robot pose off by 10 … 60 robot sigmas in "
        "each component. Board, TCP, focus: changed for so many of the views (the last or, in every other "
        "cell, the first ones): board by 10 … 50 mm and 1 … 5°, TCP by 20 … 120 mm, focal length by "
        "2 … 6 %. Oracle: the same estimate of the right views, or of the longer part. Ours and ratios: over "
        "the cells in which no other reading of the recording was named. Truly: the reading, or the cause of "
        "every bad view and of no other. Falsely: another reading, a good view rejected, or a wrong cause."
    )
    return text + "\n\n" + table(HEADER, rows)


def measure(task: tuple[str, float, Mount, int]) -> OutlierTrial:
    name, share, mount, seed = task
    rng = np.random.default_rng([43, seed, MOUNTS.index(mount), int(100 * share), *name.encode()])
    with single_threaded_opencv():
        cell = imperfect_cell(rng, mount, known=Known(lens=True))
        bad = _bad_views(name, share, seed, rng)
        spoilt = (_VIEWS_WRONG | _CHANGED)[name](cell, bad, rng)
        X_oracle = spoilt.X if spoilt.X_oracle is None else spoilt.X_oracle
        oracle = Miss.of(solve_views(spoilt.views.select(spoilt.good), _ORACLE), X_oracle)
        try:
            solution = solve_views(spoilt.views, _OPTIONS)
        except CalibrationError as problem:
            named = str(problem.values.get("hypothesis", type(problem).__name__))
            truly = named == spoilt.reading.value
            falsely = "hypothesis" in problem.values and not truly
            return OutlierTrial(False, named, oracle, truly, falsely)
        reading = solution.judgement.session.reading
    passed = all(gate.passed for gate in judge(solution))
    truly, falsely = _named(solution, spoilt, set(bad.tolist()))
    return OutlierTrial(passed, reading.value, oracle, truly, falsely, Miss.of(solution, spoilt.X))


def _bad_views(name: str, share: float, seed: int, rng: np.random.Generator) -> Places:
    count = round(_VIEWS * share)
    if name in _CHANGED:
        return np.arange(_VIEWS)[-count:] if seed % 2 else np.arange(count)
    return np.asarray(rng.choice(_VIEWS, count, replace=False))


def _named(solution: Solution, spoilt: Spoilt, bad: set[int]) -> tuple[bool, bool]:
    """Truly, falsely."""
    reading = solution.judgement.session.reading
    if spoilt.reading is not Reading.AS_RECORDED:
        return reading is spoilt.reading, reading not in (spoilt.reading, Reading.AS_RECORDED)
    kinds = {view.index: view.kind for view in solution.evidence.views.rejected}
    right = {index for index, kind in kinds.items() if index in bad and kind == spoilt.kind}
    found = set(solution.evidence.views.turned) if spoilt.kind == "" else right
    falsely = reading is not Reading.AS_RECORDED or bool(set(kinds) - right)
    return found == bad and not falsely, falsely


def line(case: tuple[str, float, Mount], found: list[OutlierTrial]) -> list[str]:
    name, share, mount = case
    plain = Reading.AS_RECORDED.value
    taken = [(t.ours, t.oracle) for t in found if t.ours is not None and t.reading == plain]

    def percent(count: int, of: Sequence[object] = found) -> str:
        return f"{100 * count / len(of):.0f}" if of else "-"

    numbers = ["-"] * 4
    if taken:
        errors = np.array([[(miss.shift_m, miss.turn_rad) for miss in both] for both in taken])
        own, best = np.sqrt(np.mean(np.square(errors), axis=0))
        numbers = [f"{1e3 * a[0]:.3f}" for a in (own, best)] + [f"{r:.3f}" for r in own / best]
    return [
        name,
        f"{100 * share:.0f} %",
        mount,
        percent(sum(t.passed for t in found)),
        percent(sum(t.reading != plain for t in found)),
        *numbers,
        percent(sum(ours.covered for ours, _ in taken), taken),
        percent(sum(t.truly for t in found)),
        percent(sum(t.falsely for t in found)),
    ]


def _views_wrong(cell: ImperfectCell, bad: Places, changed: Sequence[BoardView], kind: str) -> Spoilt:
    views = _with(cell.views, bad, changed)
    good = np.setdiff1d(np.arange(_VIEWS), bad).tolist()
    return Spoilt(views, cell.X, good, kind=kind)


def _with(views: ViewSet, places: Places, changed: Iterable[BoardView]) -> ViewSet:
    """The views, those at these places replaced."""
    found = list(views.views)
    for place, view in zip(places, changed, strict=True):
        found[place] = view
    return replace(views, views=tuple(found))


def _exchange(cell: ImperfectCell, bad: Places, other: Places) -> Spoilt:
    views = cell.views.views
    changed = [
        replace(views[i], base_from_flange=views[j].base_from_flange) for i, j in zip(bad, other, strict=True)
    ]
    return _views_wrong(cell, bad, changed, "wrong-pose")


def _shuffle(cell: ImperfectCell, bad: Places, rng: np.random.Generator) -> Spoilt:
    return _exchange(cell, bad, np.roll(bad, 1))


def _turn(cell: ImperfectCell, bad: Places, rng: np.random.Generator) -> Spoilt:
    changed = []
    for view in (cell.views.views[i] for i in bad):
        turn = pose(rotation_exp([0, 0, np.pi]), [*view.corners.points[:, :2].max(axis=0), 0.0])
        seen = np.asarray(view.camera_from_board) @ inverse(turn)
        corners = replace(view.corners, points=transform_points(turn, view.corners.points))
        changed.append(replace(view, corners=corners, camera_from_board=seen))
    return _views_wrong(cell, bad, changed, "")


def _far(cell: ImperfectCell, bad: Places, rng: np.random.Generator) -> Spoilt:
    sigma = np.repeat([MID.robot_m, MID.robot_rad], 3)
    sizes = rng.uniform(10, 60, (len(bad), 6)) * rng.choice([-1, 1], (len(bad), 6))
    changed = []
    for place, size in zip(bad, sizes, strict=True):
        view = cell.views.views[place]
        changed.append(replace(view, base_from_flange=perturb(view.base_from_flange, size * sigma)))
    return _views_wrong(cell, bad, changed, "inconsistent")


def _longer(bad: Places) -> list[int]:
    """The longer part of the session."""
    rest = np.setdiff1d(np.arange(_VIEWS), bad)
    return [int(i) for i in (rest if len(rest) >= len(bad) else bad)]


def _move(cell: ImperfectCell, bad: Places, D: Array, in_base: bool, reading: Reading) -> Spoilt:
    """Flange poses of the bad views, all D (4, 4) off, in base or in the flange."""
    flanges = (cell.views.views[i].base_from_flange for i in bad)
    moved = (D @ F if in_base else F @ D for F in flanges)
    changed = (replace(cell.views.views[i], base_from_flange=F) for i, F in zip(bad, moved, strict=True))
    camera = in_base == (cell.views.mount == "eye-to-hand")
    other = (D @ cell.X if in_base else inverse(D) @ cell.X) if camera else cell.X
    good = _longer(bad)
    X = {True: other, False: cell.X}
    views = _with(cell.views, bad, changed)
    return Spoilt(views, X[_VIEWS - 1 in bad], good, reading, X_oracle=X[good[0] in bad])


def _move_board(cell: ImperfectCell, bad: Places, rng: np.random.Generator) -> Spoilt:
    shift, turn = rng.normal(size=(2, 3))
    shift *= rng.uniform(0.01, 0.05) / np.linalg.norm(shift)
    turn *= np.radians(rng.uniform(1, 5)) / np.linalg.norm(turn)
    in_hand = cell.views.mount == "eye-in-hand"
    return _move(cell, bad, pose(rotation_exp(turn), shift), in_hand, Reading.BOARD_MOVED)


def _change_tcp(cell: ImperfectCell, bad: Places, rng: np.random.Generator) -> Spoilt:
    """Move what the flange holds, camera or board."""
    in_hand = cell.views.mount == "eye-in-hand"
    D = pose(np.eye(3), [0.0, 0.0, rng.uniform(0.02, 0.12)])
    return _move(cell, bad, D, False, Reading.CAMERA_MOVED if in_hand else Reading.BOARD_MOVED)


def _refocus(cell: ImperfectCell, bad: Places, rng: np.random.Generator) -> Spoilt:
    factor = 1 + rng.choice([-1, 1]) * rng.uniform(0.02, 0.06)
    centre = np.array(cell.lens.matrix)[:2, 2]
    changed = []
    for view in (cell.views.views[i] for i in bad):
        pixels = centre + factor * (view.corners.pixels - centre)
        changed.append(replace(view, corners=replace(view.corners, pixels=pixels)))
    spoilt = solve_pnp(_with(cell.views, bad, changed), BOARD)
    return Spoilt(spoilt, cell.X, _longer(bad), Reading.REFOCUSED)


_VIEWS_WRONG: dict[str, Spoil] = {"shuffled": _shuffle, "turned": _turn, "far": _far}
_CHANGED: dict[str, Spoil] = {"board moved": _move_board, "TCP changed": _change_tcp, "refocused": _refocus}
