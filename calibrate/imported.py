"""Which reading of other people's numbers agrees with the board in their images.

Numbers alone allow many: orders of angles, units, order of a quaternion, camera in hand or fixed. Each is
fitted to the board poses (`handeye.pose_fit`), and the evidence decides as in `handeye.readings`. It cannot
tell a camera in hand from a fixed one with inverted poses: names decide that, or the user.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from calibrate.boards.detect import detect
from calibrate.boards.grids import seen_size
from calibrate.boards.model import board_from_turned, board_points, check_board, usual_markers
from calibrate.errors import CalibrationError
from calibrate.geometry import Array, inverse, rotation_angle, transform_points
from calibrate.handeye.axxb.pairs import mount_poses
from calibrate.handeye.pose_fit import FREE, PoseFit, fit_poses, pose_views
from calibrate.handeye.readings import clear_gain
from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.lens.pnp import Candidate, candidate_poses, choose_candidates
from calibrate.views import BoardView, ViewSet
from recordings.errors import ImportSourceError
from recordings.files import read_file
from recordings.images import IMAGE_LIMIT_BYTES, ImageError, Pixels, decode_image, read_header
from recordings.importers.conventions import Convention, convention, possible
from recordings.importers.dataset import Dataset, PosesTold
from recordings.importers.tables import Lies, Table, natural
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel, Matrix4, Mount

_VOTERS = 24
"""Most images, evenly spread, that a reading is judged by."""
_FEWEST = 5
_TRIED = 6
"""Images on which a board is tried at a glance; misses in a row after which a thorough search gives up."""
_ENOUGH = 0.4
"""Share of the images that show the board at a glance above which the others are left at that."""
_MOST = 6
"""Most conventions of one table that are fitted, by the angles of turn that they and the board agree on."""
_STAYS_M, _STAYS_RAD = 0.015, 0.05
"""Median distance of the board from its place above which no reading is believed."""
_GUESSED_M = 0.02
_MADE = re.compile(r"draw|calibrated|overlay|visual|detect|result|undist|depth|corner|IR\b|axes", re.I)
"""Names of images that a program painted on, or that another camera took."""
_IN_HAND = re.compile(
    r"eye_?(in|on)_?hand|hand_?(in|on)_?eye|\beih\b|cam\w*2(gripper|end|ee|tool|flange|hand)"
    r"|attached on robot|in_hand|inhand|flange2cam|hand_camera|static_camera false",
    re.I,
)
_TO_HAND = re.compile(
    r"eye_?to_?hand|hand_?(to|out)_?eye|hand_out|eye_?on_?base|cam\w*2base|base2cam"
    r"|static_camera true|world_cam",
    re.I,
)
_TOOL_IN_BASE = re.compile(
    r"(end|gripper|ee|tool|tcp|flange|hand)_?(2|to|in)_?base|base_(tcp|ee|tool|flange)|world_end|O_T_EE|t_base_tcp"
    r"|robot_?(pose|coord|pos)|(tcp|tool|eef|ee|end|gripper|arm|effector)_?(pose|xyz|data|coord)|tool_?pose|\bhand\b"
    r"|robot_?data",
    re.I,
)
_BASE_IN_TOOL = re.compile(r"base_?(2|to|in)_?(end|gripper|ee|tool|tcp|flange|hand)", re.I)


@dataclass(frozen=True)
class Given:
    """What the user says; None: find it."""

    convention: str | None = None
    mount: Mount | None = None
    board: BoardSpec | None = None


@dataclass(frozen=True, eq=False)
class Reading:
    """One way to read a folder, and how well the board agrees."""

    table: Table
    convention: Convention
    family: str
    mount: Mount
    fit: PoseFit
    stays_m: float
    stays_rad: float
    told: str
    """Evidence by the numbers alone."""

    @property
    def text(self) -> str:
        return f"{self.mount}, {self.convention.name}"


@dataclass(frozen=True, eq=False)
class Believed:
    """A folder as it is read."""

    dataset: Dataset
    poses: dict[Path, Matrix4]
    """Image → base_from_flange, in the order of the rows."""
    facts: dict[str, tuple[str, str]] = field(default_factory=dict)
    """What → (what is believed, its evidence), for people."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """A family's images with the board found in some of them."""

    board: BoardSpec
    square_known: bool
    views: dict[Path, BoardView]
    candidates: dict[Path, list[Candidate]]
    camera: CameraModel
    camera_known: bool
    looked: int


def believe(lies: Lies, given: Given = Given(), told: Dataset | None = None) -> Believed:
    """Decide how a folder is to be read. ImportSourceError names the nearest reading and the flag.

    `told`: a description of before, which is taken as it is where it names table and convention.
    """
    if told is not None:
        given = Given(given.convention, given.mount or told.mount, given.board or told.board)
        if (known := told.poses) is not None:
            tables = [table for table in lies.tables if table.name == known.table]
            pairs = _pairs(tables[0], lies.images.get(known.images, [])) if tables else {}
            if not pairs:
                raise ImportSourceError("no-pairs", source=lies.root, images=known.images, tables=known.table)
            return Believed(told, _matrices(tables[0], convention(known.convention), pairs))
    tables = [table for table in lies.tables if table.of_robot] or lies.tables
    pairings = [
        (table, family, pairs)
        for table in tables
        for family, paths in lies.images.items()
        if len(pairs := _pairs(table, paths)) >= _FEWEST
    ]
    if not pairings:
        images = [f"{len(paths)} {name}" for name, paths in lies.images.items()]
        there = [f"{len(table.numbers)} {table.name}" for table in lies.tables]
        said = [", ".join(each[:8]) or "none" for each in (images, there)]
        raise ImportSourceError("no-pairs", source=lies.root, images=said[0], tables=said[1])
    families = sorted(
        {family for _, family, _ in pairings}, key=lambda name: (bool(_MADE.search(name)), name)
    )
    readings: list[Reading] = []
    seen: dict[str, _Seen] = {}
    for family in families:
        of_family = [(table, pairs) for table, each, pairs in pairings if each == family]
        looked = _see(lies, given, sorted({path for _, pairs in of_family for path in pairs}, key=natural))
        if looked is None:
            continue
        seen[family] = looked
        readings = [r for table, pairs in of_family for r in _readings(table, family, pairs, looked, given)]
        if any(_good(reading) for reading in readings):
            break
    if not seen:
        raise ImportSourceError("no-board-found", source=lies.root, images=", ".join(families))
    best = _decide(lies, readings)
    looked = seen[best.family]
    pairs = next(p for t, f, p in pairings if t is best.table and f == best.family)
    return _believed(lies, given, best, pairs, looked)


def _pairs(table: Table, paths: list[Path]) -> dict[Path, int]:
    """Image → row: by the names told beside the rows, by the numbers in both names, or by order."""
    named = {Path(name).name: row for row, name in enumerate(table.images) if name}
    by_name = {path: named[path.name] for path in paths if path.name in named}
    if by_name:
        return by_name
    ordered = sorted(paths, key=natural)
    if len(paths) == len(table.numbers):
        return {path: row for row, path in enumerate(ordered)}
    if "#" not in table.name:
        return {}
    rows = {place[-1]: row for row, place in enumerate(table.places) if place}
    numbers = {path: int(found[-1]) for path in paths if (found := re.findall(r"\d+", path.stem))}
    shared = {path: rows[number] for path, number in numbers.items() if number in rows}
    unique = len(rows) == len(table.numbers) and len(set(numbers.values())) == len(numbers)
    return shared if unique and len(shared) > 0.8 * max(len(rows), len(paths)) else {}


def _see(lies: Lies, given: Given, paths: list[Path]) -> _Seen | None:
    """Find the board in evenly spread images; None: in too few."""
    chosen = [
        paths[k] for k in np.unique(np.linspace(0, len(paths) - 1, min(len(paths), _VOTERS)).astype(int))
    ]
    images = {}
    for path in chosen:
        with suppress(ImageError):
            header = read_header(data := read_file(path, IMAGE_LIMIT_BYTES))
            images[path] = decode_image(data, header.width, header.height)
    if len({image.shape[:2] for image in images.values()}) != 1:
        return None
    greys = [
        image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in images.values()
    ]
    boards = [given.board] if given.board else _boards(lies.facts, greys)
    for board, known in _quickly_seen(boards, list(images.values())[:_TRIED])[:2]:
        views: dict[Path, BoardView] = {}
        points = board_points(board)
        for thorough in (False, True):
            missed = 0 if known or views or not thorough else len(images)
            for n, (path, image) in enumerate(images.items()):
                if path in views or missed > _TRIED or (thorough and len(views) > _ENOUGH * len(images)):
                    continue
                found = detect(image, board, thorough, with_quality=False)
                missed = 0 if found.found else missed + thorough
                if found.found:
                    views[path] = BoardView(n, path.name, np.eye(4), points[found.indices], found.pixels)
        if len(views) < _FEWEST:
            continue
        height, width = greys[0].shape
        camera = _camera(lies, CameraModel(width, height), tuple(views.values()))
        if camera is not None:
            candidates = {path: candidate_poses(view, camera[0], board) for path, view in views.items()}
            return _Seen(board, known, views, candidates, *camera, len(chosen))
    return None


def _quickly_seen(boards: Iterable[BoardSpec], images: list[Pixels]) -> list[tuple[BoardSpec, bool]]:
    """Boards and whether their size is known: as they come where half of a few images show one at a glance,
    the others by the corners that are seen."""
    counted: list[tuple[int, int, BoardSpec, bool]] = []
    for each in boards:
        known = each.square_m > 0
        board = each if known else msgspec.structs.replace(each, square_m=_GUESSED_M)
        try:
            check_board(board)
        except CalibrationError:
            continue
        seen = [detect(image, board, thorough=False, with_quality=False) for image in images]
        often = 2 * sum(found.found for found in seen) >= len(seen) and known
        corners = sum(found.corners for found in seen)
        counted.append((-(10**6) if often else -corners, len(counted), board, known))
    return [(board, known) for _, _, board, known in sorted(counted, key=lambda c: c[:2])]


def _camera(lies: Lies, blank: CameraModel, views: tuple[BoardView, ...]) -> tuple[CameraModel, bool] | None:
    """(the lens by these images, False); (the one that was told, True) where they do not determine one."""
    own: CameraModel | None = None
    with suppress(CalibrationError):
        own = calibrate_intrinsics(ViewSet("eye-in-hand", views, blank)).camera
    for K, distortion in lies.cameras[:1] if own is None or len(views[0].pixels) < 12 else ():
        matrix: Any = tuple(map(tuple, K.tolist()))
        return msgspec.structs.replace(blank, matrix=matrix, distortion=distortion), True
    return None if own is None else (own, False)


_COLUMN_KEYS = ("columns", "cols", "num_x", "squares_x", "board_width", "width", "nx", "corners_x")
_ROW_KEYS = ("rows", "num_y", "squares_y", "board_height", "height", "ny", "corners_y")
_SQUARE = re.compile(r"square|tile|spacing|chessboard_dim|center_dist|tag_size", re.I)
_MARKER = re.compile(r"(aruco|len|size|side).*marker|marker.*(dim|size|len|side)", re.I)


def _boards(facts: dict[str, Any], greys: list[Any]) -> Iterator[BoardSpec]:
    """Boards that the files describe, likeliest first, then the chessboard that the images show."""
    text = " ".join(f"{key} {value}" for key, value in facts.items())

    def length(wanted: re.Pattern[str]) -> float:
        for key, value in facts.items():
            if wanted.search(key) and isinstance(value, (int, float)) and value > 0:
                return value / 1000 if "mm" in key or value > 1 else float(value)
        mm = re.search(rf"(?:{wanted.pattern})\D{{0,20}}?(\d+\.?\d*) ?mm|^\D*(\d+\.?\d*) ?mm\b", text, re.I)
        return float(mm[mm.lastindex or 1]) / 1000 if mm and wanted is _SQUARE else 0.0

    square_m, marker_m = length(_SQUARE), length(_MARKER)
    sizes = [
        (int(v[0]), int(v[1])) for k, v in facts.items() if re.search("pattern|board|size", k) and _two(v)
    ]
    columns, rows = (next((facts[k] for k in keys if k in facts), None) for keys in (_COLUMN_KEYS, _ROW_KEYS))
    if isinstance(columns, int) and isinstance(rows, int):
        sizes.append((columns, rows))
    sizes += [(int(a), int(b)) for a, b in re.findall(r"\b(\d{1,2}) ?[x×*] ?(\d{1,2})\b", text)]
    number = next((v for k, v in facts.items() if "dictionary" in k), None)
    names = {getattr(cv2.aruco, name): name for name in dir(cv2.aruco) if re.match(r"DICT_\d", name)}
    dictionary = number if isinstance(number, str) else names.get(number)
    for size in dict.fromkeys(size for size in sizes if min(size) >= 1 and max(size) < 60):
        if dictionary and size == (1, 1):
            for tag in range(4):
                yield BoardSpec(BoardKind.ARUCO, 1, 1, marker_m, dictionary=dictionary, tag_id=tag)
        elif dictionary:
            for legacy in (False, True):
                marker = marker_m or usual_markers(BoardKind.CHARUCO, square_m)[0]
                yield BoardSpec(BoardKind.CHARUCO, *size, square_m, marker, dictionary, legacy)
        elif "circle" in text.lower():
            kinds = [BoardKind.CIRCLES, BoardKind.ASYMMETRIC_CIRCLES]
            yield from (BoardSpec(kind, *size, square_m) for kind in kinds)
        else:
            yield BoardSpec(BoardKind.CHESSBOARD, *size, square_m)
            yield BoardSpec(BoardKind.CHESSBOARD, size[0] - 1, size[1] - 1, square_m)
    votes = Counter(filter(None, map(seen_size, greys[:10])))
    for shown in sorted(votes, key=lambda size: -size[0] * size[1])[:5]:
        yield BoardSpec(BoardKind.CHESSBOARD, *shown, square_m)


def _two(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(float(v).is_integer() for v in value)


def _readings(
    table: Table, family: str, pairs: dict[Path, int], seen: _Seen, given: Given
) -> Iterator[Reading]:
    """Yield every reading that the views can judge."""
    paths = [path for path in seen.views if path in pairs]
    if len(paths) < _FEWEST:
        return
    numbers = table.numbers[[pairs[path] for path in paths]]
    told = [(convention(given.convention), "as told")] if given.convention else possible(numbers)
    named = [c for c, _ in told if table.rotation and c.rotation == table.rotation]
    likely = []
    for how, evidence in [each for each in told if not named or each[0] in named]:
        flange = how.poses(numbers)
        likely.append((_turn_miss(flange, [seen.candidates[path] for path in paths]), how, evidence, flange))
    likely.sort(key=lambda each: each[0])
    for miss, how, evidence, flange in likely[:_MOST]:
        if miss > 3 * likely[0][0] + 0.05:
            break
        mounts: tuple[Mount, ...] = ("eye-in-hand", "eye-to-hand")
        for mount in mounts:
            fitted = _fitted(seen, paths, flange, mount)
            if fitted is not None:
                yield Reading(table, how, family, mount, *fitted, evidence)


def _turn_miss(flange: Array, options: list[list[Candidate]]) -> float:
    """Median difference, rad, of the angles by which arm and board turn from each view to those after it."""
    misses = []
    for step in (1, 2, 3):
        for i in range(len(flange) - step):
            turned = rotation_angle(flange[i, :3, :3].T @ flange[i + step, :3, :3])
            a, b = (np.array([c.camera_from_board[:3, :3] for c in options[k]]) for k in (i, i + step))
            seen = rotation_angle(a[:, None] @ np.swapaxes(b, 1, 2))
            misses.append(float(np.abs(seen - turned).min()))
    return float(np.median(misses))


def _fitted(
    seen: _Seen, paths: list[Path], flange: Array, mount: Mount
) -> tuple[PoseFit, float, float] | None:
    options = [seen.candidates[path] for path in paths]
    chosen = choose_candidates(
        [np.array([c.camera_from_board for c in each]) for each in options], flange, mount
    )
    views = []
    for path, each, k, F in zip(paths, options, chosen, flange, strict=True):
        view, found = seen.views[path], each[k]
        points = view.board_points
        if found.turn:
            points = transform_points(inverse(board_from_turned(seen.board, found.turn)), points)
        views.append(
            replace(view, base_from_flange=F, board_points=points, camera_from_board=found.camera_from_board)
        )
    poses = pose_views(ViewSet(mount, tuple(views), seen.camera), 0.02, 0.003 if seen.square_known else FREE)
    try:
        fit = fit_poses(poses)
    except np.linalg.LinAlgError:
        return None
    places = mount_poses(flange, mount) @ fit.X[0] @ poses.boards.at(fit.factors)
    away = inverse(fit.Y[0]) @ places
    stays_m = float(np.median(np.linalg.norm(away[:, :3, 3], axis=1)))
    return fit, stays_m, float(np.median(rotation_angle(away[:, :3, :3])))


def _good(reading: Reading) -> bool:
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


def _decide(lies: Lies, readings: list[Reading]) -> Reading:
    good = [reading for reading in readings if _good(reading)] or readings
    ranked = sorted(good, key=lambda r: -r.fit.log_evidence)
    if not ranked:
        raise ImportSourceError("no-reading", source=lies.root, nearest="none", stays_m=0.0, stays_rad=0.0)
    best = ranked[0]
    if not _good(best):
        raise ImportSourceError(
            "no-reading",
            source=lies.root,
            nearest=f"{best.table.name}: {best.text}",
            stays_m=best.stays_m,
            stays_rad=best.stays_rad,
        )
    for other in ranked[1:]:
        if best.fit.log_evidence - other.fit.log_evidence > clear_gain(len(best.fit.full)):
            break
        if other.mount != best.mount or not _same(best, other):
            raise ImportSourceError(
                "two-readings",
                source=lies.root,
                first=f"{best.table.name}: {best.text}",
                second=f"{other.table.name}: {other.text}",
            )
    return best


def _same(one: Reading, other: Reading) -> bool:
    """Tell whether two readings are the same poses, in other words."""
    a, b = (reading.convention.poses(reading.table.numbers) for reading in (one, other))
    return a.shape == b.shape and bool(np.abs(a - b).max() < 1e-3)


def _mount(lies: Lies, given: Given, best: Reading) -> tuple[Mount, bool, str]:
    """(mounting, whether the poses are inverted, why). The motion only fits one mounting with given poses."""
    words = f"{lies.words} {' '.join(f'{k} {str(v).lower()}' for k, v in lies.facts.items())}"
    named: set[Mount] = set()
    if _IN_HAND.search(words):
        named.add("eye-in-hand")
    if _TO_HAND.search(words):
        named.add("eye-to-hand")
    if given.mount:
        return given.mount, given.mount != best.mount, "as told"
    straight, inverted = (bool(way.search(best.table.name)) for way in (_TOOL_IN_BASE, _BASE_IN_TOOL))
    by_direction: Mount | None = None
    if straight != inverted:
        other: Mount = "eye-to-hand" if best.mount == "eye-in-hand" else "eye-in-hand"
        by_direction = best.mount if straight else other
    if len(named) == 1:
        (mount,) = named
        if by_direction in (None, mount):
            return mount, mount != best.mount, "by names, and the board's motion"
    elif by_direction is not None:
        return by_direction, by_direction != best.mount, f"by the board's motion; {best.table.name}"
    raise ImportSourceError("which-mount", source=lies.root, mount=best.mount, table=best.table.name)


def _believed(lies: Lies, given: Given, best: Reading, pairs: dict[Path, int], seen: _Seen) -> Believed:
    mount, inverted, why = _mount(lies, given, best)
    how = replace(best.convention, inverse=best.convention.inverse != inverted)
    board, square = seen.board, "as described"
    if not seen.square_known:
        factor = float(best.fit.factors[0])
        sigma = float(np.sqrt(np.linalg.inv(best.fit.solved.precision)[-2, -2]))
        square_m = factor * _GUESSED_M
        tolerance = min(0.1, max(3 * sigma / factor, 0.01))
        near = round(square_m * 2000) / 2000
        square_m = near if abs(near - square_m) < tolerance * square_m else square_m
        board = msgspec.structs.replace(
            board, square_m=round(square_m, 6), square_tolerance=round(tolerance, 4)
        )
        square = f"square by the arm's motion: {1e3 * factor * _GUESSED_M:.2f} mm"
    camera = seen.camera if seen.camera_known else CameraModel(seen.camera.width, seen.camera.height)
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
    told = PosesTold(best.table.name, best.family, how.name)
    dataset = Dataset(mount, board, camera, lies.root.resolve().name, poses=told)
    return Believed(dataset, _matrices(best.table, how, pairs), facts)


def _matrices(table: Table, how: Convention, pairs: dict[Path, int]) -> dict[Path, Matrix4]:
    paths = sorted(pairs, key=lambda path: pairs[path])
    flange = how.poses(table.numbers[[pairs[path] for path in paths]])
    return {path: msgspec.convert(T.tolist(), Matrix4) for path, T in zip(paths, flange, strict=True)}
