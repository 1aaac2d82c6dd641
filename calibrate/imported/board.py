"""The board in other people's images, whatever it is, or as other programs say that they saw it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from calibrate.boards.corners import Grey, to_grey
from calibrate.boards.detect import Detection, detect
from calibrate.boards.grids import count_circles, seen_size
from calibrate.boards.markers import marker_detector
from calibrate.boards.model import usual_markers
from calibrate.errors import CalibrationError
from calibrate.imported.charuco import DICTIONARIES, layouts, markers_in_squares
from calibrate.imported.described import Described, described
from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.lens.pnp import Candidate, candidate_poses
from calibrate.views.corners import NO_CORNERS, Corners
from calibrate.views.view_set import BoardView, ViewSet
from recordings.errors import ImportSourceError
from recordings.files import read_file
from recordings.image_headers import IMAGE_LIMIT_BYTES, ImageError, read_header
from recordings.images import decode_image
from recordings.importers.conventions import Convention, possible
from recordings.importers.messages import Progress
from recordings.importers.tables import Contents, Table
from recordings.schema.boards import board_problem
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel

FEWEST = 5
GUESSED_M = 0.02
"""Side of a square about whose size nothing is told."""
_VOTERS = 24
"""Most images, evenly spread, that a reading is judged by."""
_MOST_ROWS = 300
"""Most rows of board poses, evenly spread; of fewer, neighbours show whether rows are shifted."""
_LARGEST_SIDE_PX = 1000
"""Images are judged reduced to this size: their corners need not be exact."""
_TRIED = 6
"""Images on which a board is tried at a glance; misses in a row after which a thorough search gives up."""
_ANOTHER = 2
"""Images that show another board: one alone may be a mistake of the detector."""
_ENOUGH = 0.4
"""Share of the images that show the board at a glance above which the others are left at that."""

Key = Path | int
"""An image, or the row of a table of board poses."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Where the board was in the camera's frame, by image or by row."""

    board: BoardSpec
    square_known: bool
    views: dict[Key, BoardView]
    candidates: dict[Key, list[Candidate]]
    camera: CameraModel
    camera_known: bool
    looked: int
    images: list[Grey] = field(default_factory=list)
    """The images, reduced; a view's index is its place."""
    convention: Convention | None = None
    """How the poses that were told are read; None: images show the board."""
    told: str = ""
    """Evidence for it."""
    another: tuple[BoardSpec, int] | None = None
    """Another board, and how many of the images that do not show this one show it."""
    size_told: bool = True
    """Its columns and rows are told; else they are as the images show them."""


@dataclass(frozen=True)
class SeldomSeen:
    """A board that too few images show."""

    board: BoardSpec
    views: int
    """Images that show it."""
    looked: int


def told_boards(table: Table) -> Iterator[Seen]:
    """Every reading of a table of board poses as it stands: `pair_readings` tells which way round it is."""
    rows = _spread(len(table.numbers), _MOST_ROWS)
    for how, evidence in possible(table.numbers):
        poses = how.poses(table.numbers[rows])
        views: dict[Key, BoardView] = {
            row: BoardView(row, f"row {row + 1}", np.eye(4), NO_CORNERS, camera_from_board=T)
            for row, T in zip(rows, poses, strict=True)
        }
        candidates: dict[Key, list[Candidate]] = {
            row: [Candidate(T, 0)] for row, T in zip(rows, poses, strict=True)
        }
        seen = Seen(
            BoardSpec(BoardKind.UNSEEN), True, views, candidates, CameraModel(0, 0), False, len(views)
        )
        yield replace(seen, convention=how, told=evidence)


def _spread(count: int, most: int) -> list[int]:
    return list(map(int, np.linspace(0, count - 1, min(count, most))))


def see_board(
    held: Contents, given: BoardSpec | None, paths: list[Path], progress: Progress
) -> Seen | SeldomSeen | None:
    """Find the board in evenly spread images; None: in none. ImportSourceError where none can be read."""
    images: dict[Path, Grey] = {}
    sizes = set[tuple[int, int]]()
    for path in (paths[place] for place in _spread(len(paths), _VOTERS)):
        try:
            header = read_header(data := read_file(path, IMAGE_LIMIT_BYTES))
            images[path] = to_grey(decode_image(data, header.width, header.height))
            sizes.add((header.width, header.height))
        except (ImageError, OSError) as error:
            unread = ImportSourceError("bad-image", place=path.parent, image=path.name, reason=str(error))
    if not images:
        raise unread
    if len(sizes) != 1:
        return None
    ((width, height),) = sizes
    factor = min(1.0, _LARGEST_SIDE_PX / max(width, height))
    small = {path: _reduced(image, factor) for path, image in images.items()}
    greys = list(small.values())
    few = [greys[place] for place in _spread(len(greys), _TRIED)]
    if given:
        likely = _likely([(given, None)], few, progress)
    else:
        told = described(held.facts)
        as_told = ((board, None) for board in told.boards)
        likely = _likely(chain(as_told, _shown(greys, told)), few, progress)
        if not any(each.often and (each.known or each.board.kind is BoardKind.CHESSBOARD) for each in likely):
            likely += _likely(_shown_circles(greys), few, progress)
    seldom: SeldomSeen | None = None
    for each in sorted(likely, key=_Tried.rank)[:2]:
        board = each.board
        known = each.known
        found = dict(_search(small, board, known, progress))
        if given is None and board.kind is BoardKind.CHESSBOARD:
            board, found = _with_its_markers(held, board, found, small, progress)
        views: dict[Key, BoardView] = {
            path: BoardView(n, path.name, np.eye(4), _of_full_size(found[path].corners, factor))
            for n, path in enumerate(images)
            if path in found
        }
        if len(views) < FEWEST:
            fewest = 1 if given else _ANOTHER
            if len(views) >= max(fewest, seldom.views + 1 if seldom else 0):
                seldom = SeldomSeen(board, len(views), len(images))
            continue
        camera = _camera(held, CameraModel(width, height), tuple(views.values()))
        if camera is not None:
            candidates = {path: candidate_poses(view, camera[0], board) for path, view in views.items()}
            without = [small[path] for path in images if path not in views]
            others = [tried.board for tried in likely if tried is not each]
            another = _another(each.board, others, without)
            return Seen(
                board,
                known,
                views,
                candidates,
                *camera,
                len(images),
                greys,
                another=another,
                size_told=each.size_told,
            )
    return seldom


def _with_its_markers(
    held: Contents,
    board: BoardSpec,
    found: dict[Path, Detection],
    images: dict[Path, Grey],
    progress: Progress,
) -> tuple[BoardSpec, dict[Path, Detection]]:
    """A chessboard and where it was found, or those of the ChArUco board of which it is the inside.

    ImportSourceError where there are markers in its squares, and no board of them is found.
    """
    shown = [*found][:: max(1, len(found) // _TRIED)]
    markers = markers_in_squares(board, [(images[path], found[path].corners.pixels) for path in shown])
    if markers is None:
        return board, found
    few = [images[path] for path in shown][:_ANOTHER]
    boards = [each for each in layouts(board, markers) if board_problem(each) is None]
    corners = [_corners(few, each) for each in boards]
    if not any(corners):
        raise ImportSourceError(
            "charuco-undescribed",
            source=held.root,
            columns=board.columns,
            rows=board.rows,
            dictionary=markers.dictionary,
        )
    charuco = boards[int(np.argmax(corners))]
    return charuco, dict(_search(images, charuco, True, progress))


def _corners(images: list[Grey], board: BoardSpec) -> int:
    """Corners of a board that are seen at a glance; 0 also where it has more markers than its dictionary."""
    try:
        return sum(len(detect(image, board, thorough=False).corners) for image in images)
    except CalibrationError:
        return 0


def _another(board: BoardSpec, boards: list[BoardSpec], images: list[Grey]) -> tuple[BoardSpec, int] | None:
    """Find the other board that most of `images` show, where two do: a set of two boards is told apart."""
    counts = [
        (sum(detect(image, other, thorough=False).found for image in images), other)
        for other in boards
        if (other.kind, other.columns, other.rows) != (board.kind, board.columns, board.rows)
    ]
    count, other = max(counts, key=lambda each: each[0], default=(0, board))
    return (other, count) if count >= _ANOTHER else None


def _reduced(image: Grey, factor: float) -> Grey:
    return np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))


def _of_full_size(corners: Corners, factor: float) -> Corners:
    return replace(corners, pixels=(corners.pixels + 0.5) / factor - 0.5)


def _search(
    images: dict[Path, Grey], board: BoardSpec, known: bool, progress: Progress
) -> Iterator[tuple[Path, Detection]]:
    """Look at a glance, then, where too few show the board so, harder, up to some misses in a row."""
    left = dict(images)
    for harder in (False, True):
        missed = 0
        for n, (path, image) in enumerate(images.items(), 1):
            enough = len(images) - len(left) > _ENOUGH * len(images)
            if path not in left or (harder and (enough or missed > _TRIED)):
                continue
            progress(n, len(images), f"looking for a {board.kind.value} {board.columns}×{board.rows}")
            seen = detect(image, board, harder, exhaustive=False)
            missed = 0 if seen.found or (known and len(left) < len(images)) else missed + 1
            if seen.found:
                del left[path]
                yield path, seen


@dataclass(frozen=True)
class _Tried:
    """A board that was looked for at a glance in a few images."""

    board: BoardSpec
    known: bool
    """The side of its squares is told; else it is a guess."""
    size_told: bool
    """Its columns and rows are told; else an image suggested them."""
    corners: int
    """Seen in all of these images together."""
    often: bool
    """At least half of them show it."""

    def rank(self) -> tuple[int, int]:
        """Sort key of the likeliest board first: one that is often seen and whose squares are told, then the
        one of which most corners are seen."""
        told_and_seen = self.known and self.often
        return (0 if told_and_seen else 1), -self.corners


def _likely(
    boards: Iterable[tuple[BoardSpec, Grey | None]], images: list[Grey], progress: Progress
) -> list[_Tried]:
    """Try boards at a glance, until one whose squares are told is often seen.

    One that an image suggested must first be found in that one.
    """
    tried: list[_Tried] = []
    for n, (each, shown) in enumerate(boards):
        known = each.square_m > 0
        board = each if known else _guessed(each)
        progress(n, n + 1, f"trying a {board.kind.value} {board.columns}×{board.rows}")
        part = shown is not None and any(
            _is_part(board, larger.board) for larger in tried if not larger.known
        )
        try:
            if part or (shown is not None and not detect(shown, board, True, False).found):
                continue
            seen = [detect(image, board, False) for image in images]
        except CalibrationError:
            continue
        often = 2 * sum(found.found for found in seen) >= len(seen)
        corners = sum(len(found.corners) for found in seen)
        tried.append(_Tried(board, known, shown is None, corners, often))
        if often and known:
            break
    return tried


def _guessed(board: BoardSpec) -> BoardSpec:
    """The board with squares of a guessed length, and the markers that such squares usually have."""
    marker_m = usual_markers(board.kind, GUESSED_M)[0]
    return msgspec.structs.replace(board, square_m=GUESSED_M, marker_m=marker_m)


def _is_part(board: BoardSpec, larger: BoardSpec) -> bool:
    """Tell whether circles are some of a larger grid's. `detect` itself takes no part of a chessboard."""
    same = board.kind is larger.kind is not BoardKind.CHESSBOARD
    return same and board.columns <= larger.columns and board.rows <= larger.rows


def _camera(
    held: Contents, blank: CameraModel, views: tuple[BoardView, ...]
) -> tuple[CameraModel, bool] | None:
    """(the lens by these images, False); (the one that was told, True) where they do not determine one."""
    own: CameraModel | None = None
    with suppress(CalibrationError):
        own = calibrate_intrinsics(ViewSet("eye-in-hand", views, blank)).camera
    for K, distortion in held.cameras[:1] if own is None or len(views[0].corners) < 12 else ():
        matrix: Any = tuple(map(tuple, K.tolist()))
        return msgspec.structs.replace(blank, matrix=matrix, distortion=distortion), True
    return None if own is None else (own, False)


def _shown(greys: list[Grey], told: Described) -> Iterator[tuple[BoardSpec, Grey]]:
    """Boards that images suggest, with the lengths that are told: a tag that most of a few show, and
    chessboards."""
    few = greys[:: max(1, len(greys) // _TRIED)]
    for dictionary in (f"DICT_{end}" for end in DICTIONARIES):
        detector = marker_detector(dictionary, 1)
        ids = [detector.detectMarkers(grey)[1] for grey in few]
        tags = Counter(int(tag) for seen in ids if seen is not None for tag in np.unique(seen))
        for tag, count in tags.most_common(1):
            if 2 * count > len(few) and len(tags) < _TRIED:
                kind = BoardKind.APRIL_TAG if "APRIL" in dictionary else BoardKind.ARUCO
                grey = next(g for g, seen in zip(few, ids, strict=True) if seen is not None and tag in seen)
                yield BoardSpec(kind, square_m=told.tag_m, dictionary=dictionary, tag_id=tag), grey
    sizes = {size: grey for grey in greys[:: max(1, len(greys) // (2 * _TRIED))] if (size := seen_size(grey))}
    if sizes:  # one image may show a part only: the largest sides of all
        whole = max(side for side, _ in sizes), max(side for _, side in sizes)
        sizes.setdefault(whole, sizes[max(sizes, key=lambda size: size[0] * size[1])])
    for size in sorted(sizes, key=lambda size: -size[0] * size[1])[: _TRIED + 2]:
        yield BoardSpec(BoardKind.CHESSBOARD, *size, told.square_m), sizes[size]


def _shown_circles(greys: list[Grey]) -> Iterator[tuple[BoardSpec, Grey]]:
    """Grids of circles that images suggest: to count circles takes longer than anything else here."""
    few = greys[:: max(1, len(greys) // _TRIED)]
    counts = [count_circles(grey) for grey in few]
    for count, times in Counter(counts).most_common(2):
        alike = [grey for grey, circles in zip(few, counts, strict=True) if circles == count]
        for columns in range(3, count // 3 + 1) if times > 1 else ():
            if count % columns == 0:
                for kind in (BoardKind.CIRCLES, BoardKind.ASYMMETRIC_CIRCLES):
                    yield from ((BoardSpec(kind, columns, count // columns), grey) for grey in alike)
