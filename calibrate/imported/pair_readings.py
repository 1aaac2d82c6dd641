"""Which way round, and in which unit, two tables of poses are meant: of the robot, and of the board.

The motion alone cannot tell. With robot poses H and board poses G as they stand, H X G is the same for all
rows as well if X and Y change places and both tables are inverted. So four readings fit equally: either table
may be inverted, and the mounting follows from both. Their units are known by their ratio only. What tells are
the user's options, joints, names, and that a camera with optical axes has the board before it. The distances
of camera and board from flange and base support one of two, and never decide among four. Where more than one
reading is left, a person is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibrate.imported.board import GUESSED_M
from calibrate.imported.directions import Told, directions, unit_named
from calibrate.imported.mounting import OTHER_MOUNT, inverted_by_distances, mount_named
from calibrate.imported.table_readings import TableReading, fitted_again, is_as_told
from calibrate.lens.pnp import Candidate
from recordings.errors import SeveralReadingsError, StandingReading, several_readings
from recordings.geometry import Array, inverse
from recordings.importers.conventions import (
    OPTICAL_FROM_AXES,
    UNITS,
    Convention,
)
from recordings.importers.tables import Contents
from recordings.schema.messages import BoardPose, CameraAxes, Mount

_AHEAD = 0.9
"""Share of the rows that have the board before the camera, where its axes are optical."""
_WIDER, _WIDE_RAD = 1.5, 0.15
"""A person keeps the board in the picture, and looks at it from many sides: what is seen in directions that
differ by so much, and so many times more than those of the inverse, is rather the camera in the board."""
_LEAST_REACH_M, _MOST_REACH_M = 0.1, 5.0
"""No arm ends at 80 mm, and none of those that are calibrated reaches further."""
_SMALL_REACH_M = 0.15
"""Below it millimetres may be centimetres or inches."""
_NEAREST_BOARD_M = 0.03
_SQUARES_M = (0.004, 0.2)
"""Sides of squares that are printed."""


@dataclass(frozen=True)
class PairsRead:
    """How two tables are read."""

    reading: TableReading
    """In the unit that is meant."""
    mount: Mount
    robot_inverted: bool
    board_inverted: bool
    why: str
    """What told."""
    ahead: bool
    """The board is before the camera: its axes are optical, or were told."""


@dataclass(frozen=True)
class _Way:
    robot_inverted: bool
    board_inverted: bool
    mount: Mount


@dataclass(frozen=True)
class _Told:
    """What the user's options tell, and joints; None: nothing."""

    mount: Mount | None
    robot_inverted: bool | None
    board_inverted: bool | None
    joints: bool | None

    def allows(self, way: _Way) -> bool:
        return (
            self.mount in (None, way.mount)
            and self.robot_inverted in (None, way.robot_inverted)
            and self.board_inverted in (None, way.board_inverted)
            and self.joints in (None, way.robot_inverted)
        )


def read_pairs(
    held: Contents,
    best: TableReading,
    mount: Mount | None,
    board_pose: BoardPose | None,
    axes: CameraAxes | None,
    robot_inverted: bool | None,
    joints: bool | None,
) -> PairsRead:
    """Find the one reading that stands of a pair of tables whose motions agree as `best` says.

    `robot_inverted`: whether by the user's convention the robot's poses are inverted beyond what it names;
    `joints`: the same by recorded joints. Raises SeveralReadingsError.
    """
    factors = scales(held, best)
    boards = np.array([each[0].camera_from_board for each in best.seen.candidates.values()])
    ahead = _is_ahead(boards, axes)
    ahead_inverted = _is_ahead(inverse(boards), axes)
    board_inverted = None if board_pose is None else board_pose == "board-from-camera"
    if board_inverted is None and axes is not None and ahead != ahead_inverted:
        board_inverted = ahead_inverted
    told = _Told(mount, robot_inverted, board_inverted, joints)
    names = directions(best.table.name, best.family)
    words = mount_named(held, best)
    turned, distances = inverted_by_distances(best)
    straight = ahead and not ahead_inverted and not _is_wider(boards)

    allowed = [way for way in _ways(best.mount) if told.allows(way)]
    named = [way for way in allowed if _agrees(way, told, names, words)]
    left = [way for way in named if _seems(way, told, names, straight, turned)]
    robot_known = robot_inverted is not None or joints is not None or names.robot_inverted is not None
    is_settled = mount is not None or bool(words) or robot_known or names.same is not None
    if len(allowed) == 1:
        left = allowed
    elif not is_settled or len(left) != 1:
        several = next((ways for ways in (left, named, allowed) if len(ways) > 1), _ways(best.mount))
        raise _question(held, best, several, factors, _decides(told, several, distances))
    (way,) = left
    if len(factors) > 1:
        raise _question(held, best, left, factors, _BY_UNIT)
    evidence = {
        "options": mount or board_pose or axes or robot_inverted is not None,
        "joints": joints is not None,
        "names": words or names != Told(),
        distances: turned is not None,
    }
    why = ", ".join(what for what, says in evidence.items() if says)
    return PairsRead(
        rescaled(best, factors[0]),
        way.mount,
        way.robot_inverted,
        way.board_inverted,
        f"by {why}; {best.table.name}",
        ahead_inverted if way.board_inverted else ahead,
    )


def _ways(fits: Mount) -> list[_Way]:
    """The four readings that fit equally, if a camera mounted so fits the tables as they stand."""
    return [
        _Way(robot, board, fits if robot == board else OTHER_MOUNT[fits])
        for robot in (False, True)
        for board in (False, True)
    ]


def _agrees(way: _Way, told: _Told, names: Told, words: set[Mount]) -> bool:
    """Tell whether names agree with a reading, where the user told nothing."""
    robot_told = told.robot_inverted is not None or told.joints is not None
    board_told = told.board_inverted is not None
    return bool(
        (robot_told or names.robot_inverted in (None, way.robot_inverted))
        and (board_told or names.board_inverted in (None, way.board_inverted))
        and (names.same is None or names.same == (way.robot_inverted == way.board_inverted))
        and (told.mount or not words or way.mount in words)
    )


def _seems(way: _Way, told: _Told, names: Told, straight: bool, turned: bool | None) -> bool:
    """Tell whether a reading is what it would usually be: the board before the camera, and what the arm
    carries near to its flange."""
    board_known = told.board_inverted is not None or names.board_inverted is not None
    robot_told = told.robot_inverted is not None or told.joints is not None
    return (board_known or not (straight and way.board_inverted)) and (
        robot_told or turned in (None, way.robot_inverted)
    )


def _is_ahead(boards: Array, axes: CameraAxes | None) -> bool:
    """Tell whether poses (n, 4, 4) place the board before a camera with these axes, optical if not told."""
    places = boards[:, :3, 3] @ np.array(OPTICAL_FROM_AXES[axes or "optical"]).T
    return bool(np.mean(places[:, 2] > 0) > _AHEAD)


def _is_wider(boards: Array) -> bool:
    """Tell whether the board is seen in clearly more directions than the camera from the board."""
    seen, from_board = (_spread(each[:, :3, 3]) for each in (boards, inverse(boards)))
    return seen > _WIDE_RAD and seen > _WIDER * from_board


def _spread(places: Array) -> float:
    """Median angle of directions (n, 3) to their mean, radians."""
    directions_to = places / np.linalg.norm(places, axis=1)[:, None]
    mean = directions_to.mean(axis=0)
    cosine = directions_to @ mean / max(float(np.linalg.norm(mean)), 1e-9)
    return float(np.median(np.arccos(np.clip(cosine, -1, 1))))


def scales(held: Contents, best: TableReading) -> list[float]:
    """Factors by which lengths of a reading may be meant: more than one where its unit is not told.

    The motions of robot and board tell the ratio of their units alone.
    """
    unit_m = best.convention.unit_m
    places = np.linalg.norm(best.convention.poses(best.table.numbers)[:, :3, 3], axis=1)
    reach_m, middle_m = float(places.max()), float(np.median(places))
    boards_m = np.array([each[0].camera_from_board[:3, 3] for each in best.seen.candidates.values()])
    board_m = float(np.median(np.linalg.norm(boards_m, axis=1)))
    if is_as_told(best) or unit_m == 1.0 or reach_m / unit_m * UNITS["mm"] > _SMALL_REACH_M:
        return [1.0]
    if best.seen.convention is None and best.seen.square_known:
        return [1.0]
    found: dict[str, float] = {}
    for unit, meant_m in UNITS.items():
        factor = meant_m / unit_m
        stands = reach_m * factor >= _LEAST_REACH_M and middle_m * factor <= _MOST_REACH_M
        if best.seen.convention is not None:
            board_unit_m = best.seen.convention.unit_m * factor
            same_unit = any(np.isclose(board_unit_m, each) for each in (1.0, *UNITS.values()))
            stands = stands and same_unit and _NEAREST_BOARD_M <= board_m * factor <= _MOST_REACH_M
        else:
            square_m = GUESSED_M * float(best.fit.factors[0]) * factor
            stands = stands and _SQUARES_M[0] <= square_m <= _SQUARES_M[1]
        if stands:
            found[unit] = factor
    named = unit_named(held.words)
    if named in found:
        return [found[named]]
    if best.seen.convention is None and found.keys() in ({"cm"}, {"inch"}):
        return [meant_m / unit_m for meant_m in UNITS.values()]  # so rare that a reach alone tells it not
    return [*found.values()] or [1.0]


def rescaled(best: TableReading, factor: float) -> TableReading:
    """The same reading in another unit of both tables, fitted anew."""
    if factor == 1.0:
        return best
    seen = best.seen
    if seen.convention is not None:
        how = _in_unit(seen.convention, factor)
        table_numbers = {
            key: _times(each[0].camera_from_board, factor) for key, each in seen.candidates.items()
        }
        seen = replace(
            seen,
            convention=how,
            views={
                key: replace(view, camera_from_board=table_numbers[key]) for key, view in seen.views.items()
            },
            candidates={key: [Candidate(T, 0)] for key, T in table_numbers.items()},
        )
    return fitted_again(best, _in_unit(best.convention, factor), seen)


def _in_unit(how: Convention, factor: float) -> Convention:
    meant_m = how.unit_m * factor
    return replace(how, unit_m=min((1.0, *UNITS.values()), key=lambda unit_m: abs(unit_m - meant_m)))


def _times(T: Array, factor: float) -> Array:
    scaled = T.copy()
    scaled[:3, 3] *= factor
    return scaled


def ask_unit(held: Contents, best: TableReading, factors: list[float], mount: Mount) -> SeveralReadingsError:
    """Make the question which unit images and poses of a board of unknown size are meant in."""
    return _question(held, best, [_Way(mount != best.mount, False, mount)], factors, _BY_SQUARE)


def _question(
    held: Contents, best: TableReading, ways: Sequence[_Way], factors: Sequence[float], decides: str
) -> SeveralReadingsError:
    readings = []
    for factor in factors:
        for way in ways:
            X = best.fit.Y[0] if way.board_inverted else best.fit.X[0]
            x_mm, y_mm, z_mm = (float(each) for each in 1e3 * factor * X[:3, 3])
            how = replace(
                _in_unit(best.convention, factor), inverse=best.convention.inverse != way.robot_inverted
            )
            words: list[str] = [way.mount]
            options: dict[str, str] = {"mount": way.mount}
            if best.seen.convention is not None:
                options["board_pose"] = "board-from-camera" if way.board_inverted else "camera-from-board"
                words.append(options["board_pose"])
            words.append("base in the tool" if how.inverse else "tool in the base")
            if len(factors) > 1:
                options["convention"] = how.name
                unit = next((unit for unit, unit_m in UNITS.items() if unit_m == how.unit_m), "m")
                reach_m = factor * float(
                    np.linalg.norm(best.convention.poses(best.table.numbers)[:, :3, 3], axis=1).max()
                )
                words.append(f"lengths in {unit}: the arm reaches {reach_m:.2f} m")
            readings.append(StandingReading(", ".join(words), options, (x_mm, y_mm, z_mm)))
    return several_readings(held.root, readings, decides)


_BY_UNIT = "The unit in which the program wrote its lengths decides."
_BY_SQUARE = "Measured squares of the board decide, too: --board '9x6 25' (inner corners, mm)."


def _decides(told: _Told, several: Sequence[_Way], distances: str) -> str:
    """What would decide among readings, for a person."""
    what = []
    if len({way.mount for way in several}) > 1:
        what.append("how the camera is mounted")
    if len({way.board_inverted for way in several}) > 1:
        what.append("whether the board's table tells the board in the camera (OpenCV, tf) or its inverse")
    if len({way.robot_inverted for way in several}) > 1:
        what.append("whether the robot's table tells the tool in the base")
    against = f" What is told contradicts names or distances ({distances})." if told.mount else ""
    return f"It decides {', and '.join(what)}.{against}"
