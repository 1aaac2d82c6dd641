"""Ways to read a table of numbers as robot poses, each fitted to where the board was: the evidence decides.

They come before there is a recording. What `handeye.readings` tries are mistakes in a recording.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibrate.boards.model import has_markers
from calibrate.handeye.axxb.pairs import mount_poses
from calibrate.handeye.board_motion import BoardMotion, board_extent_m, boards_own_motion, pairs_moves_m
from calibrate.handeye.changes import ChangeSearch, errors_by_posture
from calibrate.handeye.pose_fit import (
    FREE,
    BoardPoses,
    PoseFit,
    PoseViews,
    agreed_start,
    fit_poses,
    pose_distances,
    pose_views,
)
from calibrate.handeye.readings import clear_gain, explain_recording, explain_text
from calibrate.handeye.solution import Explanation, Reading
from calibrate.imported.board import FEWEST, Key, Seen
from calibrate.lens.pnp import choose_candidates, with_poses
from calibrate.views.view_set import Places, ViewSet
from recordings.errors import ImportSourceError, StandingReading, several_readings
from recordings.geometry import Array, difference, inverse, rotation_angle
from recordings.importers.conventions import Convention, convention, possible, tells_direction
from recordings.importers.tables import Contents, Table
from recordings.schema.messages import Mount

_AS_TOLD = "as told"
_MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
_MOST = 12
"""Most readings of one table that are fitted: those by which the board seems to move least."""
_HOPELESS = 10.0
_STANDS_M = 0.001
"""Where another reading fits, one by which the board moves so many times as far as by the best, or as this
length, is not tried."""
_EXPLAINED = 4
"""Most readings of a refused folder that are tried with their rows shifted, mirrored and the like."""
_MOVES = 0.01
"""No arm's poses differ less, metres, radians or more: such a table is of what stands."""
_STAYS_M, _STAYS_RAD = 0.015, 0.05
"""Median distance of the board from its place above which no reading is believed."""
_SAME = 2e-3
"""Two results that differ less, metres and radians, are of one camera."""
_IMMATERIAL = 0.5
"""Share of the uncertainty of a fixed camera's X below which a difference is of no consequence."""
_SIZES = 0.01, 10.0
"""Factors of squares guessed that are still a board's."""
_FARTHEST_M = 20.0
_STARTS, _FEW, _STEPS = 20, 6, 4
"""Subsets of views from which those that agree are looked for, views in each, and steps from each."""
_FEWEST_SURE, _SURE, _LEAD = 8, 1 / 3, 4.0
"""Number and share of the views that must agree, and times the usual lead in evidence over any other reading,
where less than half of them agree."""


@dataclass(frozen=True, eq=False)
class TableReading:
    """One way to read a table of a folder, and how well the board agrees."""

    table: Table
    convention: Convention
    family: str
    """Images by folder and name, or the table of the board's poses."""
    pairs: dict[Key, int]
    """Image, or row of the board's table → row of the robot's."""
    seen: Seen
    mount: Mount
    views: ViewSet
    fit: PoseFit
    away_m: Array
    """(n,) of the board from its place, by view."""
    away_rad: Array
    """(n,)"""
    told: str
    """Evidence by the numbers alone."""
    inliers: NDArray[np.bool_] | None = None
    """(n,) views that agree, where many do not; None: by the fit."""
    same_result: tuple[str, ...] = ()
    """Other tables that fit as well and give the same X."""

    @property
    def text(self) -> str:
        return f"{self.table.name}: {self.mount}, {self.convention.name}"

    @property
    def stays_m(self) -> float:
        return float(np.median(self.away_m))

    @property
    def stays_rad(self) -> float:
        return float(np.median(self.away_rad))

    @property
    def agree(self) -> NDArray[np.bool_]:
        """(n,) views that are ordinary ones by this reading."""
        return np.asarray(self.fit.full > 0.5) if self.inliers is None else self.inliers

    @property
    def log_evidence(self) -> float:
        """Of the robot's numbers as they are written: a smaller unit makes no smaller errors."""
        return self.fit.log_evidence + 3 * len(self.agree) * math.log(self.convention.unit_m)


_Likely = tuple[float, Convention, str, Array, Seen, list[Key], Mount]
"""How far the board moves, the convention, its evidence, base_from_flange, the board, keys and mounting."""


def table_readings(
    table: Table, family: str, pairs: dict[Key, int], seens: list[Seen], named: str | None
) -> Iterator[TableReading]:
    """Yield the best readings that the views can judge; `named`: the convention that the user gives, beside
    which the others are tried all the same."""
    asked = None if named is None else convention(named)
    likely: list[_Likely] = []
    for seen in seens:
        keys = [key for key in seen.views if key in pairs]
        if len(keys) < FEWEST:
            continue
        numbers = table.numbers[[pairs[key] for key in keys]]
        if np.ptp(numbers, axis=0).max() < _MOVES:
            continue
        ways = possible(numbers)
        spelt = [way for way in ways if table.rotation and way[0].rotation == table.rotation]
        ways = [way for way in spelt or ways if way[0] != asked]
        for how, evidence in ways if asked is None else [(asked, _AS_TOLD), *ways]:
            flange = how.poses(numbers)
            moves = [(_moves(seen, keys, flange, mount), mount) for mount in _MOUNTS]
            likely += [(moved, how, evidence, flange, seen, keys, mount) for moved, mount in moves]
    likely.sort(key=lambda each: each[0])
    farthest = _HOPELESS * max(likely[0][0], _STANDS_M) if likely else 0.0
    as_told = [each for each in likely if each[2] == _AS_TOLD][:_MOST]
    others = list(_once([each for each in likely if each[2] != _AS_TOLD]))[:_MOST]
    any_fits = False
    for moved, how, evidence, flange, seen, keys, mount in as_told + others:
        if any_fits and evidence != _AS_TOLD and moved > farthest:
            continue
        fitted = _fitted(seen, keys, flange, mount)
        if fitted is not None:
            any_fits = True
            yield TableReading(table, how, family, pairs, seen, mount, *fitted, evidence)


def _once(likely: list[_Likely]) -> Iterator[_Likely]:
    """Leave out what differs from an earlier one by the unit of all lengths alone."""
    met = set[object]()
    for each in likely:
        _, how, _, _, seen, _, mount = each
        board = seen.convention
        ratio = 0.0 if board is None else round(math.log(board.unit_m / how.unit_m), 3)
        free = board is not None or not seen.square_known
        alike = (
            replace(how, unit_m=1.0 if free else how.unit_m),
            board and replace(board, unit_m=1.0),
            ratio,
            mount,
        )
        if alike not in met:
            met.add(alike)
            yield each


def is_as_told(reading: TableReading) -> bool:
    """Tell whether the convention is the one that the user names."""
    return reading.told == _AS_TOLD


def fitted_again(reading: TableReading, how: Convention, seen: Seen) -> TableReading:
    """The same tables read another way that fits as well."""
    keys = [key for key in seen.views if key in reading.pairs]
    numbers = reading.table.numbers[[reading.pairs[key] for key in keys]]
    fitted = _fitted(seen, keys, how.poses(numbers), reading.mount)
    told = next((told for each, told in possible(numbers) if each == how), reading.told)
    assert fitted is not None
    return TableReading(reading.table, how, reading.family, reading.pairs, seen, reading.mount, *fitted, told)


def _moves(seen: Seen, keys: list[Key], flange: Array, mount: Mount) -> float:
    """How far the board moves, metres, radians at half a metre: median of all pairs of near views."""
    options = [np.array([each.camera_from_board for each in seen.candidates[key]]) for key in keys]
    chosen = choose_candidates(options, flange, mount) if max(map(len, options)) > 1 else [0] * len(keys)
    C = np.array([each[k] for each, k in zip(options, chosen, strict=True)])
    moved_m = pairs_moves_m(mount_poses(flange, mount), C, seen.square_known)
    return float(np.median(moved_m))


def _fitted(
    seen: Seen, keys: list[Key], flange: Array, mount: Mount
) -> tuple[ViewSet, PoseFit, Array, Array] | None:
    views = tuple(replace(seen.views[key], base_from_flange=F) for key, F in zip(keys, flange, strict=True))
    candidates = [seen.candidates[key] for key in keys]
    viewed = with_poses(ViewSet(mount, views, seen.camera), candidates, seen.board)
    poses = _pose_views(viewed, seen)
    try:
        fit = fit_poses(poses)
    except np.linalg.LinAlgError:
        return None
    return viewed, fit, *_away(fit, mount_poses(flange, mount), poses)


def _pose_views(views: ViewSet, seen: Seen) -> PoseViews:
    return pose_views(views, 0.02, 0.003 if seen.square_known else FREE)


def guessed_size(reading: TableReading) -> tuple[float, float]:
    """(true over assumed size of the board, 1σ) by the arm's motion, errors of the arm included."""
    poses = _pose_views(reading.views, reading.seen)
    return ChangeSearch(poses, errors_by_posture(poses.flange), reading.fit).board_size()


def without_boards_own(held: Contents, readings: list[TableReading]) -> list[TableReading]:
    """Leave out tables that tell the board's own motion. ImportSourceError (`boards-own-poses`) where none is
    left."""
    own: dict[str, BoardMotion] = {}
    for reading in readings:
        if reading.table.name not in own and reading.stays_m < _STAYS_M:
            boards = reading.views.camera_from_board
            extent_m = board_extent_m(reading.views)
            if near := boards_own_motion(reading.views.base_from_flange, boards, extent_m):
                own[reading.table.name] = near
    left = [reading for reading in readings if reading.table.name not in own]
    if own and not any(map(is_good, left)):
        (name, near), *_ = own.items()
        away_m, away_rad = near.away_m, near.away_rad
        raise ImportSourceError(
            "boards-own-poses", source=held.root, table=name, away_m=away_m, away_rad=away_rad
        )
    return left


def is_good(reading: TableReading) -> bool:
    """Tell whether the board stays put by a reading, but for few views."""
    stays = reading.stays_m < _STAYS_M and reading.stays_rad < _STAYS_RAD
    return stays and float(reading.agree.mean()) > 0.5 and _is_possible(reading)


def _is_possible(reading: TableReading) -> bool:
    away_m, factor = np.linalg.norm(reading.fit.X[0][:3, 3]), float(reading.fit.factors[0])
    return _SIZES[0] < factor < _SIZES[1] and bool(away_m < _FARTHEST_M)


def _leading(one: TableReading, readings: list[TableReading]) -> TableReading | None:
    """A reading that is right for many views, and that no other one comes near, by those views alone: the
    rest are outliers. None: it is not so."""
    lead = _LEAD * clear_gain(len(one.agree))
    if any(one.log_evidence - other.log_evidence <= lead and not _same(one, other) for other in readings):
        return None
    poses = _pose_views(one.views, one.seen)
    H = mount_poses(one.views.base_from_flange, one.mount)
    needed = max(_FEWEST_SURE, round(_SURE * len(H)))
    if len(H) < needed:
        return None
    rng = np.random.default_rng(0)
    best = np.zeros(len(H), dtype=bool)
    for _ in range(_STARTS):
        alike = _alike(H, poses.boards, rng.permutation(len(H))[:_FEW], needed)
        best = alike if alike.sum() > best.sum() else best
    if best.sum() < needed:
        return None
    try:
        fit = fit_poses(poses.part(np.flatnonzero(best)))
    except np.linalg.LinAlgError:
        return None
    away_m, away_rad = _away(fit, H, poses)
    inliers = (away_m < _STAYS_M) & (away_rad < _STAYS_RAD)
    found = replace(one, fit=fit, away_m=away_m[inliers], away_rad=away_rad[inliers], inliers=inliers)
    return found if _is_possible(found) and inliers.sum() >= _FEWEST_SURE else None


def _alike(H: Array, boards: BoardPoses, few: Places, needed: int) -> NDArray[np.bool_]:
    """Find the views (n,) whose boards lie at one place by an X that begins with those at the places `few`.

    In each step X is found anew by the `needed` views whose boards lie nearest together, until these lie at
    one place or fix no X.
    """
    alike = np.zeros(len(H), dtype=bool)
    views = few
    for _ in range(_STEPS):
        try:
            start = agreed_start(H[views], boards.part(views), 0)
        except np.linalg.LinAlgError:
            break
        places = H @ start.X @ boards.at(start.factors)
        away = pose_distances(places, places)
        middle = away[np.sort(away, axis=1)[:, needed - 1].argmin()]
        views = np.argsort(middle)[:needed]
        alike = middle < _STAYS_M
        if alike[views[-1]]:
            break
    return alike


def _away(fit: PoseFit, H: Array, poses: PoseViews) -> tuple[Array, Array]:
    """How far the board is from its place in every view: (n,) metres, (n,) radians."""
    away = inverse(fit.Y[0]) @ H @ fit.X[0] @ poses.boards.at(fit.factors)
    return np.linalg.norm(away[:, :3, 3], axis=1), np.asarray(rotation_angle(away[:, :3, :3]))


def decide(
    held: Contents, readings: list[TableReading], named: str | None, mount: Mount | None
) -> TableReading:
    """The reading that is clearly best. What the user names is refused where another one is clearly better;
    whose mounting, convention and square are told needs not agree well: the solve judges it."""
    ranked = sorted(readings, key=lambda r: (not is_good(r), -r.log_evidence))
    mine = [reading for reading in ranked if named is None or reading.told == _AS_TOLD]
    if mount and tells_direction(named):
        mine = [reading for reading in mine if reading.mount == mount or reading.seen.convention]
    impossible = mine and is_good(ranked[0]) and not _is_possible(mine[0])
    beaten = mine and (_beats(ranked[0], mine[0]) or impossible)
    if beaten and is_good(ranked[0]):
        fits = replace(ranked[0].convention, inverse=mount not in (None, ranked[0].mount)).name
        raise ImportSourceError("other-convention", source=held.root, told=named, fits=fits)
    if not mine or beaten or not is_good(mine[0]):
        nearest = _nearest(held, [*dict.fromkeys(ranked[:_EXPLAINED] + mine[:_EXPLAINED])], named, mount)
        as_told = named and mount and mine and mine[0].seen.square_known
        # That positions disagree says that something is wrong, not how to read it: outliers do the same.
        read_otherwise = nearest["cause"] not in ("", Reading.POSITIONS_DISAGREE.value)
        leading = _leading(mine[0], readings) if mine and not beaten and not read_otherwise else None
        if leading is not None:
            return leading
        if beaten or not as_told or read_otherwise:
            raise ImportSourceError("no-reading", source=held.root, **nearest)
    best = mine[0]
    same_result: list[str] = []
    for other in mine[1:]:
        if _beats(best, other) or is_good(other) != is_good(best):
            break
        if _of_same_camera(best, other):
            same_result.append(other.table.name)
        elif not _same(best, other):
            raise several_readings(held.root, [_as_asked(best), _as_asked(other)], _BY_WRITER)
    return replace(best, same_result=tuple(dict.fromkeys(same_result)))


def _of_same_camera(one: TableReading, other: TableReading) -> bool:
    """Tell whether two tables give one X: a fixed camera's is the same by any part of the arm that carries
    the board, and that of a camera in hand is the same in any base."""
    if one.table is other.table or one.mount != other.mount:
        return False
    try:
        sigma = np.sqrt(np.diag(np.linalg.inv(one.fit.solved.precision)))[:6]
    except np.linalg.LinAlgError:
        return False
    apart = np.abs(difference(one.fit.X[0], other.fit.X[0]))
    immaterial = _IMMATERIAL * sigma if one.mount == "eye-to-hand" else 0.0 * sigma
    return bool((apart < np.maximum(_SAME, immaterial)).all())


def _as_asked(reading: TableReading) -> StandingReading:
    x_mm, y_mm, z_mm = (float(each) for each in 1e3 * reading.fit.X[0][:3, 3])
    options: dict[str, str] = {"convention": reading.convention.name, "mount": reading.mount}
    return StandingReading(reading.text, {"poses": reading.table.name} | options, (x_mm, y_mm, z_mm))


_BY_WRITER = "The program or pendant that wrote the table decides."


def _beats(one: TableReading, other: TableReading) -> bool:
    return one.log_evidence - other.log_evidence > clear_gain(len(one.fit.full))


def _left_to_tell(held: Contents, nearest: TableReading, named: str | None, mount: Mount | None) -> list[str]:
    """Options not given that would say how this reading is meant: no error asks for what was told."""
    given = {
        "--poses": held.told is not None,
        "--board": nearest.seen.square_known,
        "--convention": named is not None,
        "--mount": mount is not None,
    }
    return [option for option, is_given in given.items() if not is_given]


def _advice(is_pairs: bool, options: list[str]) -> str:
    """What to check, and the options that are left to tell."""
    if is_pairs:
        check = (
            "Check that both tables were written at the same stops in the same order, and that the robot's "
            "holds the flange's poses, not joints."
        )
    else:
        check = "Check that the rows are the flange's poses, not joints, and belong to these images."
    if not options:
        return check
    return f"{check} A reading that is told whole is taken, and the solve judges it: add {_and(options)}."


def _and(options: list[str]) -> str:
    *others, last = options
    return f"{', '.join(others)} and {last}" if others else last


def _nearest(
    held: Contents, readings: list[TableReading], named: str | None, mount: Mount | None
) -> dict[str, Any]:
    """The reading nearest to right, and what would make it right, as a solve names it."""
    explained = [_explained(reading) for reading in readings]
    gains = [found.log_evidence_gain if found.reading in _CAUSES else 0.0 for found in explained]
    evidence = [reading.log_evidence + gain for reading, gain in zip(readings, gains, strict=True)]
    best, found = readings[at := int(np.argmax(evidence))], explained[at]
    cause = found.reading.value if found.reading in _CAUSES else ""
    text = f". {explain_text(found, best.views)}".rstrip(".") if cause else ""
    pairs = best.seen.convention is not None
    options = _left_to_tell(held, best, named, mount)
    near = {
        "nearest": best.text,
        "stays_m": best.stays_m,
        "stays_rad": best.stays_rad,
        "seen": f"the board's poses, {best.family}" if pairs else "the board in the images",
        "advice": _advice(pairs, options),
        "options": options,
    }
    return {**near, "cause": cause, "text": text}


def _explained(reading: TableReading) -> Explanation:
    seen = reading.seen
    pictured = reading.views if seen.camera_known and seen.convention is None else None
    return explain_recording(
        _pose_views(reading.views, seen), unmirrored=has_markers(seen.board), pictured=pictured
    )


_CAUSES = (
    Reading.SHIFTED,
    Reading.MIRRORED,
    Reading.LEFT_HANDED,
    Reading.OTHER_BASE,
    Reading.POSITIONS_DISAGREE,
    Reading.OTHER_RESOLUTION,
    Reading.BOARD_MOVED,
    Reading.CAMERA_MOVED,
)
"""What no convention of numbers mends."""


def _same(one: TableReading, other: TableReading) -> bool:
    """Tell whether two readings are the same poses, in other words; of boards perhaps told the other way."""
    a, b = (reading.convention.poses(reading.table.numbers) for reading in (one, other))
    if a.shape != b.shape or np.abs(a - b).max() > 1e-3:
        return False
    turned, c, d = one.mount != other.mount, one.seen.candidates, other.seen.candidates
    keys = c.keys() & d.keys()
    if one.seen is other.seen or not keys:
        return not turned
    ours, theirs = (np.array([each[key][0].camera_from_board for key in keys]) for each in (c, d))
    return bool(np.abs(ours - (inverse(theirs) if turned else theirs)).max() < 1e-3)
