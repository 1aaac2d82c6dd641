"""Anyone's folder as it is believed: which images or board poses go with which robot poses, read how."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from calibrate.boards.model import describe_board
from calibrate.imported.board import FEWEST, GUESSED_M, Key, Seen, see_board, told_boards
from calibrate.imported.mounting import joints_of, joints_rad, mounting
from calibrate.imported.table_readings import TableReading, decide, is_good, table_readings
from recordings.errors import ImportSourceError
from recordings.importers.conventions import Convention, convention, tells_direction
from recordings.importers.dataset import DATASET_FILE, POSES_FILE, Dataset, PoseRow, PosesTold
from recordings.importers.messages import Progress
from recordings.importers.tables import Contents, Table, natural
from recordings.schema.messages import LARGEST_TOLERANCE, BoardSpec, CameraModel, Matrix4, Mount

LEAST_GUESSED_TOLERANCE = 0.003
"""Relative: no guess from some images is nearer than what a board is printed to."""
_MADE = re.compile(r"draw|calibrated|overlay|visual|detect|result|undist|depth|corner|IR\b|axes", re.I)
"""Names of images that a program painted on, or that another camera took."""


@dataclass(frozen=True)
class Given:
    """What the user says; None: find it."""

    convention: str | None = None
    mount: Mount | None = None
    board: BoardSpec | None = None


@dataclass(frozen=True, eq=False)
class Believed:
    """A folder as it is read."""

    dataset: Dataset
    rows: list[PoseRow]
    facts: dict[str, tuple[str, str]] = field(default_factory=dict)
    """What → (what is believed, its evidence), for people."""


def is_described(folder: Path, *given: object) -> bool:
    """Tell whether dataset.yaml and poses.csv say it all. ImportSourceError where more is given."""
    described = all((folder / name).is_file() for name in (DATASET_FILE, POSES_FILE))
    if described and any(given):
        raise ImportSourceError("described", folder=folder)
    return described


def believe(
    held: Contents,
    given: Given = Given(),
    told: Dataset | None = None,
    progress: Progress = lambda done, total, text: None,
) -> Believed:
    """Decide how a folder is to be read. ImportSourceError names the nearest reading and the flag.

    `told`: a description of before; where it names table and convention it is taken as it is, unless more is
    given.
    """
    if told is not None:
        if told.poses is not None and given == Given():
            return _as_before(held, told, told.poses)
        given = Given(given.convention, given.mount or told.mount, given.board or told.board)
    named, unnamed = ([t for t in held.tables if t.whose == whose] for whose in ("robot", ""))
    robots = named or unnamed
    if held.told is not None:  # a file that is told may hold the board's poses, too
        robots = [table for table in held.told if table.whose != "board"] or held.told
    boards = [
        (robot, board, pairs)
        for robot in robots
        for board in held.tables
        if (board.whose == "board" or (held.told and board in unnamed)) and board not in robots
        if len(pairs := _pairs(robot, board)) >= FEWEST
    ]
    tried: list[TableReading] = []
    families: list[str] = []
    seen: Seen | None = None
    for family in sorted(held.images, key=lambda name: (bool(_MADE.search(name)), name)):
        paired = [(table, _pairs(table, held.images[family])) for table in robots]
        paths = {path for _, pairs in paired if len(pairs) >= FEWEST for path in pairs}
        if not paths:
            continue
        families.append(family)
        images = sorted((path for path in paths if isinstance(path, Path)), key=natural)
        if (seen := see_board(held, given.board, images, progress)) is not None:
            for table, pairs in paired:
                tried += table_readings(table, family, pairs, [seen], given.convention)
        if any(map(is_good, tried)):
            break
    else:
        for n, (robot, board, pairs) in enumerate(boards):
            progress(n, len(boards), "comparing tables of poses")
            tried += table_readings(robot, board.name, pairs, list(told_boards(board)), given.convention)
    if not tried and (seen or not families):
        there = [f"{name}, {todo}" for name, todo in held.unread.items()]
        there += [f"{len(paths)} {name}" for name, paths in held.images.items()]
        tables = [f"{len(table.numbers)} {table.name}" for table in held.tables]
        said = [", ".join(each[:8]) or "none" for each in (there, tables)]
        raise ImportSourceError("no-pairs", source=held.root, images=said[0], tables=said[1])
    if not tried:
        sought = "board" if given.board is None else describe_board(given.board)
        raise ImportSourceError("no-board-found", source=held.root, board=sought, images=", ".join(families))
    return _believed(held, given, decide(held, tried, given.convention, given.mount))


def _as_before(held: Contents, told: Dataset, poses: PosesTold) -> Believed:
    tables = {table.name: table for table in held.tables}
    table, board = tables.get(poses.table), tables.get(poses.images) if poses.board_convention else None
    if table is None or not (pairs := _pairs(table, board or held.images.get(poses.images, []))):
        raise ImportSourceError("no-pairs", source=held.root, images=poses.images, tables=poses.table)
    seen = None if board is None else (board, convention(poses.board_convention))
    joints = tables.get(poses.joints)
    if poses.joints and (joints is None or len(joints.numbers) != len(table.numbers)):
        raise ImportSourceError("joints-rows", source=held.root, joints=poses.joints, poses=poses.table)
    return Believed(told, _rows(held, table, convention(poses.convention), pairs, seen, joints))


def _pairs(table: Table, paths: list[Path] | Table) -> dict[Key, int]:
    """Image → row: by the names told beside the rows, by the numbers in both names, or by order.

    Row of a table of the board's poses → row of the robot's: by order.
    """
    if isinstance(paths, Table):
        return {row: row for row in range(len(paths.numbers)) if len(paths.numbers) == len(table.numbers)}
    named = {Path(name).name: row for row, name in enumerate(table.images) if name}
    by_name: dict[Key, int] = {path: named[path.name] for path in paths if path.name in named}
    if by_name:
        return by_name
    ordered = sorted(paths, key=natural)
    if len(paths) == len(table.numbers):
        return {path: row for row, path in enumerate(ordered)}
    numbers = {path: int(found[-1]) for path in paths if (found := re.findall(r"\d+", path.stem))}
    rows = {place[-1]: row for row, place in enumerate(table.places) if place}
    if "#" not in table.name:  # some images are gone, neither the first nor the last
        first, last = min(numbers.values(), default=0), max(numbers.values(), default=0)
        counted = first in (0, 1) and last - first + 1 == len(table.numbers)
        rows = {first + row: row for row in range(len(table.numbers))} if counted else {}
    shared: dict[Key, int] = {path: rows[number] for path, number in numbers.items() if number in rows}
    unique = len(rows) == len(table.numbers) and len(set(numbers.values())) == len(numbers)
    return shared if unique and len(shared) > 0.8 * max(len(rows), len(paths)) else {}


def _believed(held: Contents, given: Given, best: TableReading) -> Believed:
    seen, pairs = best.seen, best.pairs
    joints, by_joints = joints_of(held, best) or (None, None)
    as_told = tells_direction(given.convention)
    mount, inverted, board_inverted, why = mounting(held, given.mount, best, as_told, by_joints)
    how = replace(best.convention, inverse=best.convention.inverse != inverted)
    board, square = _board(best)
    facts = {
        "images": (f"{len(pairs)} {best.family}", f"board in {len(seen.views)} of {seen.looked} looked at"),
        "poses": (f"{len(pairs)} rows of {best.table.name}", best.told),
        "convention": (
            how.name,
            f"board stays within {1e3 * best.stays_m:.1f} mm, {np.degrees(best.stays_rad):.2f}°",
        ),
        "mount": (mount, why),
        "board": (f"{board.kind.value} {board.columns}×{board.rows}, {1e3 * board.square_m:g} mm", square),
        "camera": ("matrix as told" if seen.camera_known else "to be estimated", ""),
    }
    camera = seen.camera if seen.camera_known else CameraModel(seen.camera.width, seen.camera.height)
    if joints:
        facts["joints"] = f"{len(joints.numbers)} rows of {joints.name}", "they move as the poses do"
    saw = None
    if seen.convention is not None:
        how_board = replace(seen.convention, inverse=seen.convention.inverse != board_inverted)
        saw = next(t for t in held.tables if t.name == best.family), how_board
        del facts["images"], facts["camera"]
        facts["board"] = f"{len(pairs)} rows of {best.family}", f"{how_board.name}; {seen.told}"
    seen_how, moved_by = saw[1].name if saw else "", joints.name if joints else ""
    told = PosesTold(best.table.name, best.family, how.name, seen_how, moved_by, str(held.root.resolve()))
    dataset = Dataset(mount, board, camera, held.root.resolve().name, poses=told)
    return Believed(dataset, _rows(held, best.table, how, pairs, saw, joints), facts)


_USUAL_SQUARES_MM = (
    *(5, 6, 8, 10, 12, 15, 16, 18, 20, 22, 24, 25, 28, 30, 32, 35, 36, 40, 45, 50),
    *(60, 70, 75, 80, 90, 100, 120, 150, 200),
)
"""Sides of squares that people print."""
_FITS_SIGMAS = 2.0
"""A usual size nearer to the guess than so many of its sigmas fits it."""


def _board(best: TableReading) -> tuple[BoardSpec, str]:
    """(the board, how its size is known); where nothing tells the squares, the arm's motion does.

    The guess keeps its own value and uncertainty. ImportSourceError where two sizes that people print fit it.
    """
    board = best.seen.board
    if best.seen.square_known:
        return board, "as described"
    factor = float(best.fit.factors[0])
    share = float(np.sqrt(np.linalg.inv(best.fit.solved.precision)[-2, -2])) / factor
    square_mm = 1e3 * factor * GUESSED_M
    sigma_mm = share * square_mm
    usual = [size for size in _USUAL_SQUARES_MM if abs(size - square_mm) < _FITS_SIGMAS * sigma_mm]
    if len(usual) > 1:
        raise ImportSourceError(
            "square-unclear",
            square_mm=square_mm,
            sigma_mm=sigma_mm,
            usual=" or ".join(map(str, usual)),
            board=f"{board.columns}x{board.rows} {usual[0]}",
        )
    # The solve sees the same motion again: what it was guessed from must not count twice.
    tolerance = float(np.clip(3 * share, LEAST_GUESSED_TOLERANCE, LARGEST_TOLERANCE))
    guessed = msgspec.structs.replace(
        board,
        square_m=round(1e-3 * square_mm, 6),
        square_tolerance=round(tolerance, 4),
        square_guessed=True,
    )
    return guessed, f"square by the arm's motion: {square_mm:.2f} ± {sigma_mm:.2f} mm; measure it"


def _rows(
    held: Contents,
    table: Table,
    how: Convention,
    pairs: dict[Key, int],
    saw: tuple[Table, Convention] | None,
    joints: Table | None,
) -> list[PoseRow]:
    """Rows in the order of the robot's table; `saw`: where the board was, instead of images."""
    keys = sorted(pairs, key=lambda key: pairs[key])
    flanges = how.poses(table.numbers[[pairs[key] for key in keys]])
    boards = None if saw is None else saw[1].poses(saw[0].numbers[np.array(keys)])
    return [
        PoseRow(
            n + 1,
            f"row {key + 1}" if isinstance(key, int) else str(key.relative_to(held.root)),
            _matrix(flanges[n]),
            None if joints is None else tuple(joints_rad(joints)[pairs[key]].tolist()),
            None if boards is None else _matrix(boards[n]),
        )
        for n, key in enumerate(keys)
    ]


def _matrix(T: np.ndarray) -> Matrix4:
    return msgspec.convert(T.tolist(), Matrix4)
