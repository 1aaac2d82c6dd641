"""Ways to read a table of numbers as robot poses, each fitted to where the board was: the evidence decides.

They come before there is a recording. What `handeye.readings` tries are mistakes in a recording.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibrate.geometry import Array, inverse, rotation_angle, rotation_log
from calibrate.handeye.axxb.pairs import mount_poses
from calibrate.handeye.pose_fit import FREE, PoseFit, PoseViews, fit_poses, pose_views
from calibrate.handeye.readings import clear_gain, explain_recording, explain_text
from calibrate.handeye.solution import Reading
from calibrate.imported.board import FEWEST, Key, Seen
from calibrate.lens.pnp import choose_candidates, with_poses
from calibrate.views import ViewSet
from recordings.errors import ImportSourceError
from recordings.importers.conventions import Convention, convention, possible, tells_direction
from recordings.importers.tables import Contents, Table
from recordings.schema.messages import Mount

_AS_TOLD = "as told"
_MOUNTS: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
_MOST = 12
"""Most readings of one table that are fitted: those by which the board seems to move least."""
_EXPLAINED = 4
"""Most readings of a refused folder that are tried with their rows shifted, mirrored and the like."""
_MOVES = 0.01
"""No arm's poses differ less, metres, radians or more: such a table is of what stands."""
_STAYS_M, _STAYS_RAD = 0.015, 0.05
"""Median distance of the board from its place above which no reading is believed."""


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
    stays_m: float
    stays_rad: float
    told: str
    """Evidence by the numbers alone."""

    @property
    def text(self) -> str:
        return f"{self.table.name}: {self.mount}, {self.convention.name}"


def table_readings(
    table: Table, family: str, pairs: dict[Key, int], seens: list[Seen], named: str | None
) -> Iterator[TableReading]:
    """Yield the best readings that the views can judge; `named`: the convention that the user gives, beside
    which the others are tried all the same."""
    asked = None if named is None else convention(named)
    likely: list[tuple[float, Convention, str, Array, Seen, list[Key], Mount]] = []
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
    as_told = [each for each in likely if each[2] == _AS_TOLD][:_MOST]
    others = [each for each in likely if each[2] != _AS_TOLD][:_MOST]
    for _, how, evidence, flange, seen, keys, mount in as_told + others:
        fitted = _fitted(seen, keys, flange, mount)
        if fitted is not None:
            yield TableReading(table, how, family, pairs, seen, mount, *fitted, evidence)


def _moves(seen: Seen, keys: list[Key], flange: Array, mount: Mount) -> float:
    """How far the board moves, metres, radians at half a metre: median by the X of all pairs of near views.

    Rotation and translation apart: F. Park, B. Martin, "Robot sensor calibration: solving AX = XB on the
    Euclidean group" (1994).
    """
    options = [np.array([each.camera_from_board for each in seen.candidates[key]]) for key in keys]
    chosen = choose_candidates(options, flange, mount) if max(map(len, options)) > 1 else [0] * len(keys)
    C, H = np.array([each[k] for each, k in zip(options, chosen, strict=True)]), mount_poses(flange, mount)
    i, k = np.array([(i, i + step) for step in (1, 2, 3) for i in range(len(H) - step)]).T
    A, B = inverse(H[k]) @ H[i], C[k] @ inverse(C[i])
    alpha, beta = rotation_log(A[:, :3, :3]), rotation_log(B[:, :3, :3])
    U, _, Vt = np.linalg.svd(alpha.T @ beta)
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    shift = B[:, :3, 3] @ R.T
    J, right = A[:, :3, :3] - np.eye(3), shift - A[:, :3, 3]
    if not seen.square_known:
        J, right = np.concatenate([J, -shift[..., None]], axis=2), -A[:, :3, 3]
    t = np.linalg.lstsq(J.reshape(-1, J.shape[2]), right.ravel(), rcond=None)[0]
    moved = np.linalg.norm(J @ t - right, axis=1) + 0.5 * np.linalg.norm(alpha - beta @ R.T, axis=1)
    return float(np.median(moved))


def _fitted(
    seen: Seen, keys: list[Key], flange: Array, mount: Mount
) -> tuple[ViewSet, PoseFit, float, float] | None:
    views = tuple(replace(seen.views[key], base_from_flange=F) for key, F in zip(keys, flange, strict=True))
    candidates = [seen.candidates[key] for key in keys]
    viewed = with_poses(ViewSet(mount, views, seen.camera), candidates, seen.board)
    poses = _pose_views(viewed, seen)
    try:
        fit = fit_poses(poses)
    except np.linalg.LinAlgError:
        return None
    places = mount_poses(flange, mount) @ fit.X[0] @ poses.boards.at(fit.factors)
    away = inverse(fit.Y[0]) @ places
    stays_m = float(np.median(np.linalg.norm(away[:, :3, 3], axis=1)))
    return viewed, fit, stays_m, float(np.median(rotation_angle(away[:, :3, :3])))


def _pose_views(views: ViewSet, seen: Seen) -> PoseViews:
    return pose_views(views, 0.02, 0.003 if seen.square_known else FREE)


def is_good(reading: TableReading) -> bool:
    X, factor = reading.fit.X[0], float(reading.fit.factors[0])
    itself = np.linalg.norm(X[:3, 3]) < 1e-3 and rotation_angle(X[:3, :3]) < 0.01
    return (
        reading.stays_m < _STAYS_M
        and reading.stays_rad < _STAYS_RAD
        and float((reading.fit.full > 0.5).mean()) > 0.5
        and not itself
        and 0.1 < factor < 10
        and bool(np.linalg.norm(X[:3, 3]) < 20)
    )


def decide(
    held: Contents, readings: list[TableReading], named: str | None, mount: Mount | None
) -> TableReading:
    """The reading that is clearly best. What the user names is refused where another one is clearly better;
    whose mounting, convention and square are told needs not agree well: the solve judges it."""
    ranked = sorted(readings, key=lambda r: (not is_good(r), -r.fit.log_evidence))
    mine = [reading for reading in ranked if named is None or reading.told == _AS_TOLD]
    if mount and tells_direction(named):
        mine = [reading for reading in mine if reading.mount == mount or reading.seen.convention]
    beaten = mine and _beats(ranked[0], mine[0])
    if beaten and is_good(ranked[0]):
        fits = replace(ranked[0].convention, inverse=mount not in (None, ranked[0].mount)).name
        raise ImportSourceError("other-convention", source=held.root, told=named, fits=fits)
    if not mine or beaten or not is_good(mine[0]):
        nearest = _nearest([*dict.fromkeys(ranked[:_EXPLAINED] + mine[:_EXPLAINED])])
        as_told = named and mount and mine and mine[0].seen.square_known
        if beaten or not as_told or nearest["cause"]:
            raise ImportSourceError("no-reading", source=held.root, **nearest)
    best = mine[0]
    for other in mine[1:]:
        if _beats(best, other) or is_good(other) != is_good(best):
            break
        if not _same(best, other):
            both = {"first": best.text, "second": other.text}
            raise ImportSourceError("two-readings", source=held.root, **both)
    return best


def _beats(one: TableReading, other: TableReading) -> bool:
    return one.fit.log_evidence - other.fit.log_evidence > clear_gain(len(one.fit.full))


def _nearest(readings: list[TableReading]) -> dict[str, Any]:
    """The reading nearest to right, and what would make it right, as a solve names it."""
    explained = [explain_recording(_pose_views(reading.views, reading.seen)) for reading in readings]
    gains = [found.log_evidence_gain if found.reading in _CAUSES else 0.0 for found in explained]
    evidence = [reading.fit.log_evidence + gain for reading, gain in zip(readings, gains, strict=True)]
    best, found = readings[at := int(np.argmax(evidence))], explained[at]
    cause = found.reading.value if found.reading in _CAUSES else ""
    text = f". {explain_text(found, best.views)}".rstrip(".") if cause else ""
    near = {"nearest": best.text, "stays_m": best.stays_m, "stays_rad": best.stays_rad}
    return {**near, "cause": cause, "text": text}


_CAUSES = (Reading.SHIFTED, Reading.MIRRORED, Reading.BOARD_MOVED, Reading.CAMERA_MOVED)
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
