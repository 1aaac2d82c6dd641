"""Anyone's folder as it is believed: which images or board poses go with which robot poses, read how."""

from __future__ import annotations

from collections import Counter, defaultdict
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from calibrate.boards.model import describe_board
from calibrate.handeye.blas_threads import one_blas_thread
from calibrate.imported.board import FEWEST, GUESSED_M, Key, SeldomSeen, see_board, told_boards
from calibrate.imported.mounting import joints_of, joints_rad, mounting
from calibrate.imported.pair_readings import PairsRead, ask_unit, read_pairs, rescaled, scales
from calibrate.imported.sets import (
    ImageSet,
    PairSet,
    are_rivals,
    are_sessions,
    boards_named,
    cameras_apart,
    image_sets,
    pair_sets,
    pairs_of,
    same_pictures,
)
from calibrate.imported.table_readings import (
    TableReading,
    decide,
    guessed_size,
    is_good,
    table_readings,
    without_boards_own,
)
from recordings.errors import (
    ImportSourceError,
    SeveralReadingsError,
    StandingReading,
    several_readings,
)
from recordings.geometry import inverse, pose
from recordings.image_headers import ImageError, read_header
from recordings.importers.conventions import (
    OPTICAL_FROM_AXES,
    Convention,
    convention,
    possible,
    tells_direction,
)
from recordings.importers.dataset import DATASET_FILE, POSES_FILE, Dataset, PoseRow, PosesTold
from recordings.importers.image_files import header_bytes
from recordings.importers.messages import Progress
from recordings.importers.tables import Contents, Table
from recordings.importers.trees import DATA_SUFFIXES
from recordings.schema.messages import (
    LARGEST_TOLERANCE,
    BoardPose,
    BoardSpec,
    CameraAxes,
    CameraModel,
    Matrix4,
    Mount,
    RobotIdentity,
)

LEAST_GUESSED_TOLERANCE = 0.003
"""Relative: no guess from some images is nearer than what a board is printed to."""
_SAME = 2e-3
"""Two results that differ less, metres and radians, are of one camera."""
_SEVERAL = 2
_LISTED = 8
"""Most names of files and tables in an error."""


_NAMED = 8
"""Most outliers that are named."""


@dataclass(frozen=True)
class Given:
    """What the user says; None: find it."""

    convention: str | None = None
    mount: Mount | None = None
    board: BoardSpec | None = None
    images: str | None = None
    """A folder or file, the end of the images' name with digits as #, or the table of the board's poses."""
    board_pose: BoardPose | None = None
    """Of pairs: the board in the camera, or the camera in the board."""
    camera_axes: CameraAxes | None = None
    """Of pairs: those of the camera in whose frame the board is told."""
    robot: str | RobotIdentity = ""
    """The arm as dataset.yaml tells it; empty: nobody told which it is."""


@dataclass(frozen=True, eq=False)
class Believed:
    """A folder as it is read."""

    dataset: Dataset
    rows: list[PoseRow]
    facts: dict[str, tuple[str, str]] = field(default_factory=dict)
    """What → (what is believed, its evidence), for people."""
    unused: list[str] = field(default_factory=list)
    """Files that were seen and not used, one line a kind, for people."""


def is_described(folder: Path, *given: object) -> bool:
    """Tell whether dataset.yaml and poses.csv say it all. ImportSourceError where more is given."""
    described = all((folder / name).is_file() for name in (DATASET_FILE, POSES_FILE))
    if described and any(given):
        raise ImportSourceError("described", folder=folder)
    return described


@one_blas_thread()
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
    board_told = given.board is not None
    if told is not None:
        told = _without_folders_name(told)
        if told.poses is not None and given == Given() and held.told is None:
            return _as_before(cameras_apart(held, held.tables), told, told.poses)
        given = replace(
            given,
            mount=given.mount or told.mount,
            board=given.board or told.board,
            robot=given.robot or told.robot,
        )
    robots = _robots(held)
    held = cameras_apart(held, robots)
    sets = image_sets(held, robots, given.images)
    good: list[tuple[ImageSet, list[TableReading]]] = []
    tried: list[TableReading] = []
    of_sizes: ImportSourceError | None = None
    unreadable: ImportSourceError | None = None
    board_seen = False
    without_board: list[str] = []
    seldom: dict[str, SeldomSeen] = {}
    for each in sets:
        if good and each.is_made:
            break
        if any(same_pictures(each.paths, other.paths) for other, _ in good):
            continue
        if (sizes := _sizes(each.paths)) is not None:
            of_sizes = of_sizes or ImportSourceError(
                "image-sizes", source=held.root, images=each.family, sizes=sizes
            )
            continue
        readings: list[TableReading] = []
        try:
            seen = see_board(held, given.board, each.paths, progress)
        except ImportSourceError as error:  # others may be pictures: maps of depths lie beside them
            unreadable = unreadable or error
            continue
        if seen is None:
            without_board.append(each.family)
        elif isinstance(seen, SeldomSeen):
            without_board.append(each.family)
            seldom[each.family] = seen
        else:
            board_seen = True
            for table, pairs in each.rows:
                readings += table_readings(table, each.family, pairs, [seen], given.convention)
        tried += readings
        if any(map(is_good, readings)):
            good.append((each, readings))
        if len(good) > 1:
            rivals = [other for other in sets if not other.is_made]
            raise _several(held, [(other.family, _row_names(other)) for other in rivals])
    problem = of_sizes or (None if without_board else unreadable)
    if good:
        tried = good[0][1]
    elif problem is not None and not tried:
        raise problem
    elif not (sets and (given.board or given.images)):
        pair_readings = _pair_readings(held, robots, given, progress)
        if pair_readings and board_told:
            raise ImportSourceError("told-not-used", source=held.root, option="--board", instead="pairs")
        tried += pair_readings
    if not tried and (board_seen or not sets):
        raise _no_pairs(held, robots)
    if not tried:
        raise _no_board(held, given.board, without_board, seldom)
    tried = without_boards_own(held, tried)
    best = decide(held, tried, given.convention, given.mount)
    if best.seen.convention is None or not without_board:
        return _believed(held, given, best)
    return _believed_beside_images(held, given, best, _listed(without_board))


def _no_board(
    held: Contents, told: BoardSpec | None, families: list[str], seldom: dict[str, SeldomSeen]
) -> ImportSourceError:
    """Why images of `families` tell nothing of a board; `seldom`: those of them that show one too seldom."""
    if seldom:
        family, seen = max(seldom.items(), key=lambda each: each[1].views)
        return ImportSourceError(
            "board-seldom-seen",
            source=held.root,
            board=f"{seen.board.kind.value} {seen.board.columns}×{seen.board.rows}",
            images=family,
            seen=seen.views,
            looked=seen.looked,
            needed=FEWEST,
        )
    images = _listed(families)
    if told is None:
        return ImportSourceError("no-board-found", source=held.root, board="board", images=images)
    return ImportSourceError("told-board-unseen", source=held.root, board=describe_board(told), images=images)


def _believed_beside_images(held: Contents, given: Given, best: TableReading, images: str) -> Believed:
    """Pairs of poses where images lie beside them that show no board: a person is told so, or asked."""
    try:
        believed = _believed(held, given, best)
    except SeveralReadingsError as question:
        beside = f"No board was found in the images beside ({images}): with --board they may decide, too."
        decides = f"{question.values['decides']} {beside}"
        raise several_readings(held.root, question.readings, decides) from None
    seen = {"images": (f"none: no board was found in {images}", "with --board they are looked at again")}
    return replace(believed, facts=seen | believed.facts)


def _robots(held: Contents) -> list[Table]:
    """Tables that may be the robot's. ImportSourceError where those that the user names are not there."""
    named, unnamed = ([t for t in held.tables if t.whose == whose] for whose in ("robot", ""))
    if held.told is None:
        return named or unnamed
    if not held.told:
        if 0 < (pairs := _most_pairs(held, [])) < FEWEST:
            raise ImportSourceError("too-few-pairs", source=held.root, pairs=pairs, needed=FEWEST)
        there = _listed([f"{len(table.numbers)} {table.name}" for table in held.tables])
        told = {"option": "--poses", "told": held.told_as, "there": there}
        raise ImportSourceError("told-not-there", source=held.root, **told)
    # a file that is told may hold the board's poses, too
    return [table for table in held.told if table.whose != "board"] or held.told


def _pair_readings(
    held: Contents, robots: list[Table], given: Given, progress: Progress
) -> list[TableReading]:
    """Readings of the one set of tables that is good, else of all. ImportSourceError where several are."""
    boards = boards_named(held, given.images) or [
        table for table in held.tables if table.whose == "board" or (held.told and table.whose == "")
    ]
    sets = pair_sets(robots, boards)
    good: list[tuple[PairSet, list[TableReading]]] = []
    tried: list[TableReading] = []
    for n, each in enumerate(sets):
        progress(n, len(sets), "comparing tables of poses")
        seens = list(told_boards(each.board))
        readings = [*table_readings(each.robot, each.board.name, each.pairs, seens, given.convention)]
        tried += readings
        if any(map(is_good, readings)):
            good.append((each, readings))
    for (one, readings), (other, other_readings) in combinations(good, 2):
        differ = are_rivals(one, other) and not _same_cell(_best(readings), _best(other_readings))
        if differ or are_sessions(one, other):
            raise _several(held, [(each.board.name, each.robot.name) for each, _ in good])
    return tried


def _best(readings: list[TableReading]) -> TableReading:
    return max(filter(is_good, readings), key=lambda reading: reading.fit.log_evidence)


def _same_cell(one: TableReading, other: TableReading) -> bool:
    """Tell whether two readings find the same camera or board: of the same poses, or of their inverses."""
    places = [T for X in (one.fit.X[0], one.fit.Y[0]) for T in (X, inverse(X))]
    return any(np.abs(T - other.fit.X[0]).max() < _SAME for T in places)


def _several(held: Contents, sets: list[tuple[str, str]]) -> SeveralReadingsError:
    """Which of several sets is meant; `sets`: images, or poses of the board, and the robot's poses beside."""
    readings = [StandingReading(f"{seen} with {robot}", {"images": seen}) for seen, robot in sets]
    decides = "Or give the subfolder of one set as SOURCE, or the robot's poses of one by --poses."
    return several_readings(held.root, readings, decides, "several-sets")


def _row_names(images: ImageSet) -> str:
    return " or ".join(table.name for table, _ in images.rows)


def _no_pairs(held: Contents, robots: list[Table]) -> ImportSourceError:
    """Why nothing goes together."""
    there = [f"{name}, {todo}" for name, todo in held.unread.items()]
    there += [f"{len(paths)} {name}" for name, paths in held.images.items()]
    tables = [f"{len(table.numbers)} {table.name}" for table in held.tables]
    said = {"images": _listed(there), "tables": _listed(tables)}
    if 0 < (pairs := _most_pairs(held, robots)) < FEWEST:
        return ImportSourceError("too-few-pairs", source=held.root, pairs=pairs, needed=FEWEST)
    unnamed = [table for table in held.tables if table.whose == ""]
    alike = [table for table in unnamed if any(_as_long(table, other) for other in unnamed)]
    if held.told is not None:
        said["tables"] = _listed([f"{len(table.numbers)} {table.name}" for table in robots])
        return ImportSourceError("told-poses-unpaired", source=held.root, **said)
    if alike and not held.images:
        readings = [
            StandingReading(
                f"{len(table.numbers)} rows of {table.name} are the robot's", {"poses": table.name}
            )
            for table in alike
        ]
        decides = "The program that wrote the tables decides."
        return several_readings(held.root, readings, decides, "which-poses")
    if no_poses := _no_poses(held, robots):
        table, why = no_poses
        return ImportSourceError(
            "not-poses", source=held.root, table=table.name, cause=why, reason=_NO_POSES[why]
        )
    return ImportSourceError("no-pairs", source=held.root, **said)


def _most_pairs(held: Contents, robots: list[Table]) -> int:
    """The most rows of a table of the robot's that go with images, or with another table that may be the
    board's: also of those tables that are too short to be read."""
    found: list[int] = []
    for robot in robots:
        others: list[list[Path] | Table] = list(held.images.values())
        others += [
            table
            for table in held.tables
            if table is not robot and (table not in robots or robot.whose == "")
        ]
        found += [len(pairs_of(robot, other)) for other in others]
    short = Counter(each.rows for each in held.short if each.whose in ("robot", ""))
    counts = [len(paths) for paths in held.images.values()]
    counts += [each.rows for each in held.short if each.whose == "board"]
    found += [rows for rows, tables in short.items() if rows in counts or tables > 1]
    return max(found, default=0)


_NO_POSES = {
    "joints": "its name says joints",
    "quaternion": "of seven numbers a row no four are a quaternion (of length 1), as of the joints of an arm "
    "with seven axes",
    "matrix": "its rows are no rotation matrices beside positions",
    "numbers": "its numbers are poses in no known unit and order",
}
"""Cause → for people."""


def _no_poses(held: Contents, robots: list[Table]) -> tuple[Table, str] | None:
    """(table, why) of one that would go with the images or with the board's poses, if its rows were poses."""
    others: list[list[Path] | Table] = list(held.images.values())
    others += [table for table in held.tables if table.whose == "board"]
    joints = [table for table in held.tables if "joint" in table.name.lower()]
    for table in [*robots, *joints]:
        if not any(pairs_of(table, other) for other in others if other is not table):
            continue
        if table in joints:
            return table, "joints"
        if not possible(table.numbers):
            causes = {6: "numbers", 7: "quaternion"}
            return table, causes.get(table.numbers.shape[1], "matrix")
    return None


def _as_long(table: Table, other: Table) -> bool:
    return table is not other and len(table.numbers) == len(other.numbers) >= FEWEST


def _listed(names: list[str]) -> str:
    return ", ".join(names[:_LISTED]) or "none"


def _sizes(paths: list[Path]) -> str | None:
    """The sizes of images where they are several, the most frequent first, each with an image; None: one."""
    sizes = defaultdict[tuple[int, int], list[Path]](list)
    for path in paths:
        with suppress(OSError, ImageError):  # what is damaged is told where it is looked at
            header = read_header(header_bytes(path))
            sizes[header.width, header.height].append(path)
    if len(sizes) < _SEVERAL:
        return None
    ranked = sorted(sizes.items(), key=lambda each: -len(each[1]))
    return ", ".join(f"{len(each)} of {w}×{h} ({each[0].name})" for (w, h), each in ranked)


def _without_folders_name(told: Dataset) -> Dataset:
    """Earlier versions wrote the folder's name for a robot that nobody had named."""
    if told.poses is None or told.robot != Path(told.poses.source).name:
        return told
    return msgspec.structs.replace(told, robot="")


def _as_before(held: Contents, told: Dataset, poses: PosesTold) -> Believed:
    tables = {table.name: table for table in held.tables}
    table, board = tables.get(poses.table), tables.get(poses.images) if poses.board_convention else None
    if table is None or not (pairs := pairs_of(table, board or held.images.get(poses.images, []))):
        raise ImportSourceError("no-pairs", source=held.root, images=poses.images, tables=poses.table)
    seen = None if board is None else (board, convention(poses.board_convention))
    joints = tables.get(poses.joints)
    if poses.joints and (joints is None or len(joints.numbers) != len(table.numbers)):
        raise ImportSourceError("joints-rows", source=held.root, joints=poses.joints, poses=poses.table)
    how = convention(poses.convention)
    return Believed(told, _rows(held, table, how, pairs, seen, joints, poses.camera_axes))


def _believed(held: Contents, given: Given, best: TableReading) -> Believed:
    joints, by_joints = joints_of(held, best) or (None, None)
    as_told = tells_direction(given.convention)
    read: PairsRead | None = None
    if best.seen.convention is not None:
        robot_inverted = False if as_told else None
        read = read_pairs(
            held, best, given.mount, given.board_pose, given.camera_axes, robot_inverted, by_joints
        )
        best, mount, inverted, why = read.reading, read.mount, read.robot_inverted, read.why
    else:
        if given.board_pose or given.camera_axes:
            raise ImportSourceError("pairs-option", source=held.root)
        mount, inverted, why = mounting(held, given.mount, best, as_told, by_joints)
        if len(factors := scales(held, best)) > 1:
            raise ask_unit(held, best, factors, mount)
        best = rescaled(best, factors[0])
    seen, pairs = best.seen, best.pairs
    how = replace(best.convention, inverse=best.convention.inverse != inverted)
    board, square = _board(best)
    facts = {
        "images": (f"{len(pairs)} {best.family}", f"board in {len(seen.views)} of {seen.looked} looked at"),
        "poses": (f"{len(pairs)} rows of {best.table.name}", _evidence(best)),
        "convention": (
            how.name,
            f"board stays within {1e3 * best.stays_m:.1f} mm, {np.degrees(best.stays_rad):.2f}°",
        ),
        "mount": (mount, why),
        "board": (f"{board.kind.value} {board.columns}×{board.rows}, {1e3 * board.square_m:g} mm", square),
        "camera": ("matrix as told" if seen.camera_known else "to be estimated", ""),
    }
    if seen.another is not None:
        other, shown = seen.another
        name = f"{other.kind.value} {other.columns}×{other.rows}"
        facts["another"] = name, f"in {shown} of {seen.looked} images looked at, which are not used"
    camera = seen.camera if seen.camera_known else CameraModel(seen.camera.width, seen.camera.height)
    if joints:
        facts["joints"] = f"{len(joints.numbers)} rows of {joints.name}", "they move as the poses do"
    saw = None
    if seen.convention is not None and read is not None:
        how_board = replace(seen.convention, inverse=seen.convention.inverse != read.board_inverted)
        saw = next(t for t in held.tables if t.name == best.family), how_board
        del facts["images"], facts["camera"]
        direction = "board-from-camera" if read.board_inverted else "camera-from-board"
        facts["board"] = f"{len(pairs)} rows of {best.family}", f"{direction}, {how_board.name}; {seen.told}"
        if given.camera_axes:
            facts["camera axes"] = given.camera_axes, "as told; X is of the optical frame"
        elif not read.ahead:
            facts["camera axes"] = "not optical", "z < 0: X is of that table's frame; see --camera-axes"
    if not best.agree.all():
        odd = [view.name for view, agrees in zip(best.views, best.agree, strict=True) if not agrees]
        named = ", ".join(odd[:_NAMED]) + (" …" if len(odd) > _NAMED else "")
        facts["outliers"] = f"{len(odd)} of {len(best.agree)} do not agree with the others", named
    axes: CameraAxes | Literal[""] = given.camera_axes or ""
    told = PosesTold(
        best.table.name,
        best.family,
        how.name,
        saw[1].name if saw else "",
        joints.name if joints else "",
        str(held.root.resolve()),
        axes,
    )
    dataset = Dataset(mount, board, camera, given.robot, poses=told)
    used = {best.table.files, saw[0].files if saw else best.family, *([joints.files] if joints else [])}
    describes = seen.camera_known or (seen.square_known and not saw)
    unused = _unused(held, used | (held.described_by if describes else set()))
    return Believed(dataset, _rows(held, best.table, how, pairs, saw, joints, axes), facts, unused)


def _evidence(best: TableReading) -> str:
    """What the numbers of the robot's table show, and which other tables give the same X."""
    if not best.same_result:
        return best.told
    return f"{best.told}; {_listed([*best.same_result])} would give the same X"


def _unused(held: Contents, used: set[str]) -> list[str]:
    """Files that were seen and not used, one line a kind: data by name, what is never read by suffix."""
    tables = {table.files for table in held.tables}
    kinds = defaultdict[tuple[str, str], int](int)
    others = Counter[str]()
    for name, alike in held.files.items():
        if not used.isdisjoint((name, alike)):
            continue
        if alike in held.unread:
            kinds[alike, held.unread[alike]] += 1
        elif alike in held.images:
            kinds[alike, "images"] += 1
        elif not tables.isdisjoint((name, alike)):
            kinds[alike, "numbers like poses"] += 1
        elif name in held.described_by:
            kinds[alike, "says something of a board or camera"] += 1
        elif Path(name).suffix in DATA_SUFFIXES:
            kinds[alike, "no table of poses, no board, no camera"] += 1
        else:
            others[Path(name).suffix or Path(name).name] += 1
    lines = [f"{count} {name}: {what}" for (name, what), count in kinds.items()]
    lines += [f"{name}, {todo}" for name, todo in held.unread.items() if name not in held.files.values()]
    if others:
        suffixes = ", ".join(f"{count} {suffix}" for suffix, count in others.most_common())
        lines.append(f"never read: {suffixes}")
    return lines


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
        return board, "as described" if best.seen.size_told else "square as described, size as it is seen"
    factor, sigma = guessed_size(best)
    square_mm = 1e3 * factor * GUESSED_M
    sigma_mm = 1e3 * sigma * GUESSED_M
    share = sigma / factor
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
        marker_m=board.marker_m and board.marker_m * factor,
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
    axes: CameraAxes | Literal[""],
) -> list[PoseRow]:
    """Rows in the order of the robot's table; `saw`: where the board was, instead of images, in a camera with
    these axes, optical or as they are if not told."""
    keys = sorted(pairs, key=lambda key: pairs[key])
    flanges = how.poses(table.numbers[[pairs[key] for key in keys]])
    boards = None if saw is None else saw[1].poses(saw[0].numbers[np.array(keys)])
    if boards is not None and axes:
        boards = pose(OPTICAL_FROM_AXES[axes], np.zeros(3)) @ boards
    return [
        PoseRow(
            0,
            f"row {key + 1}" if isinstance(key, int) else str(key.relative_to(held.root)),
            _matrix(flanges[n]),
            None if joints is None else tuple(joints_rad(joints)[pairs[key]].tolist()),
            None if boards is None else _matrix(boards[n]),
        )
        for n, key in enumerate(keys)
    ]


def _matrix(T: np.ndarray) -> Matrix4:
    return msgspec.convert(T.tolist(), Matrix4)
