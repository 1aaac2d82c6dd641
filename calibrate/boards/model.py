"""A board's points, their number, and the turns in which it looks the same.

Board frame: origin in the first point, x along a row, y down the columns, z into the board.
"""

from __future__ import annotations

import re
from functools import lru_cache

import cv2
import numpy as np

from calibrate.errors import CalibrationError
from recordings.geometry import Array, pose, rotation_exp
from recordings.schema.boards import board_problem
from recordings.schema.messages import SINGLE_TAGS, BoardKind, BoardSpec

APRIL_DICTIONARY = "DICT_APRILTAG_36h11"


class BoardError(CalibrationError):
    """A board whose description cannot be right."""

    code = "board"
    exit_code = 2


def dictionary_id(name: str) -> int:
    """Look up OpenCV's number of a marker dictionary such as DICT_6X6_250; BoardError when there is none."""
    value = getattr(cv2.aruco, name, None)
    if not name.startswith("DICT_") or not isinstance(value, int):
        raise BoardError("dictionary-unknown", name=name)
    return value


def check_board(spec: BoardSpec) -> None:
    """Raise BoardError where the numbers cannot belong to a real board."""
    if spec.kind is BoardKind.UNSEEN:
        raise BoardError("board-unseen")
    if problem := board_problem(spec):
        raise BoardError("board-impossible", key=problem[0], problem=problem[1])
    tag, markers = spec.kind in SINGLE_TAGS, spec.kind in (BoardKind.CHARUCO, BoardKind.APRIL_GRID)
    if tag or markers:
        tags = spec.columns * spec.rows // (2 if spec.kind is BoardKind.CHARUCO else 1)
        needed, dictionary = spec.tag_id + 1 if tag else tags, tag_dictionary(spec)
        held = len(cv2.aruco.getPredefinedDictionary(dictionary_id(dictionary)).bytesList)
        if needed > held:
            raise BoardError("dictionary-too-small", needed=needed, held=held, dictionary=dictionary)


def has_markers(spec: BoardSpec) -> bool:
    """Tell whether the board is found by markers: in a mirrored image it is not."""
    return spec.kind in (*SINGLE_TAGS, BoardKind.CHARUCO, BoardKind.APRIL_GRID)


def usual_markers(kind: BoardKind, square_m: float) -> tuple[float | None, str | None]:
    """Choose `marker_m` and dictionary of a board of which only the squares are stated; None: it has none."""
    if kind is BoardKind.CHARUCO:
        return 0.75 * square_m, "DICT_6X6_250"
    if kind is BoardKind.APRIL_GRID:
        return 0.3 * square_m, None
    return None, "DICT_4X4_50" if kind is BoardKind.ARUCO else None


def board_of(given: BoardSpec | str) -> BoardSpec:
    """Take a board as it is, or as it is typed ('8x5 30'). Raises BoardError where no such board exists."""
    board = typed_board(given) if isinstance(given, str) else given
    check_board(board)
    return board


def typed_board(text: str) -> BoardSpec:
    """Parse a typed board: '8x5 30' is a chessboard of 8 × 5 inner corners, squares of 30 mm.

    Other kinds are named first; marker size (charuco) or gap (april-grid) and dictionary come last, unless
    the defaults: 'charuco 8x6 30 22 DICT_5X5_100'. A single tag has a side and a number: 'april-tag 120 3'.
    Raises BoardError.
    """
    in_mm = re.sub(r"(\d+(?:\.\d+)?) *cm\b", lambda cm: f"{10 * float(cm[1]):g}", text.replace("×", "x"))
    words = re.sub(r"(?<=\d) *mm|,", " ", in_mm).split()
    try:
        kind = BoardKind.CHESSBOARD if words[0][0].isdigit() else BoardKind(words.pop(0).lower())
        dictionary = words.pop().upper() if words[-1].upper().startswith("DICT_") else None
        number, columns, rows = 0, 1, 1
        if kind in SINGLE_TAGS:
            number = int(words.pop()) if len(words) > 1 else 0
        else:
            columns, rows = (int(part) for part in words.pop(0).lower().split("x"))
        size_m, *marker = (float(word) / 1000 for word in words)
        usual_m, usual = usual_markers(kind, size_m)
        too_few = kind not in SINGLE_TAGS and min(columns, rows) < 3
        if len(marker) > (usual_m is not None) or too_few or not 0.002 <= size_m <= 0.5:
            raise ValueError
    except (ValueError, IndexError):
        raise BoardError("no-board-typed", typed=text) from None
    marker_m = marker[0] if marker else usual_m
    board = BoardSpec(kind, columns, rows, size_m, marker_m, dictionary or usual, tag_id=number)
    check_board(board)
    return board


def tag_dictionary(spec: BoardSpec) -> str:
    """Return the dictionary of a board of markers; AprilTags have a usual one."""
    return spec.dictionary or APRIL_DICTIONARY


def grid_shape(spec: BoardSpec) -> tuple[int, int]:
    """Count columns and rows of points (not for april-grid, whose points come four to a tag)."""
    if spec.kind is BoardKind.CHARUCO:
        return spec.columns - 1, spec.rows - 1
    if spec.kind in SINGLE_TAGS:
        return 2, 2
    return spec.columns, spec.rows


@lru_cache(maxsize=32)
def board_points(spec: BoardSpec) -> Array:
    """List all points in `board`, (n, 3) metres, z = 0; the row number is the point's identity.

    Asymmetric circles: `square_m` is the distance of neighbouring rows, half that of circles in a row
    (OpenCV's convention). april-grid: corners of tag 0, 1 … row by row from the bottom left as Kalibr counts,
    each tag's four from its bottom left, counter-clockwise as printed. A single tag: the corners of its black
    square, row by row from its top left.
    """
    if spec.kind is BoardKind.APRIL_GRID:
        points = _april_points(spec)
    else:
        columns, rows = grid_shape(spec)
        j, i = np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float))
        if spec.kind is BoardKind.ASYMMETRIC_CIRCLES:
            j = 2 * j + i % 2
        points = np.stack([j.ravel(), i.ravel(), np.zeros(i.size)], axis=1) * spec.square_m
    points.flags.writeable = False
    return points


def _april_points(spec: BoardSpec) -> Array:
    pitch = spec.square_m + (spec.marker_m or 0.0)
    row, column = np.divmod(np.arange(spec.columns * spec.rows), spec.columns)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * spec.square_m
    plane = np.stack([column, row], axis=1)[:, None, :] * pitch + corners
    plane[..., 1] *= -1  # Kalibr counts upwards, y points down
    return np.concatenate([plane.reshape(-1, 2), np.zeros((4 * len(row), 1))], axis=1)


def looks_same_turns(spec: BoardSpec) -> tuple[int, ...]:
    """List turns about the normal, in quarters, after which the board looks exactly as before; 0 included.

    A chessboard's colours decide when columns + rows is odd. Square markers always decide; the three dots of
    a radon board are not read.
    """
    columns, rows = spec.columns, spec.rows
    if spec.kind in (BoardKind.CHARUCO, BoardKind.APRIL_GRID, *SINGLE_TAGS):
        return (0,)
    if spec.kind is BoardKind.CHESSBOARD:
        if (columns + rows) % 2:
            return (0,)
        return (0, 1, 2, 3) if columns == rows and columns % 2 == 0 else (0, 2)
    if spec.kind is BoardKind.CIRCLES:
        return (0, 1, 2, 3) if columns == rows else (0, 2)
    return (0,) if rows % 2 else (0, 2)


def board_from_turned(spec: BoardSpec, quarters: int) -> Array:
    """Turn the board frame by `quarters` of 90° about the centre of its points, (4, 4)."""
    points = board_points(spec)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    R = np.round(rotation_exp([0.0, 0.0, quarters * np.pi / 2]))
    return pose(R, centre - R @ centre)


def fixes_a_plane(points: Array) -> bool:
    """Tell whether points of a board (n, 3) fix its plane: not where all but one lie in a line."""
    rest = np.array([np.delete(points[:, :2], k, axis=0) for k in range(len(points))])
    spread = np.linalg.svd(rest - rest.mean(axis=1, keepdims=True), compute_uv=False)
    return len(points) > 3 and bool((spread[:, 1] > 1e-6 * spread[:, 0]).all())


def ambiguity_text(spec: BoardSpec) -> str:
    """Warn when the board can be mistaken for itself turned; empty otherwise."""
    turns = looks_same_turns(spec)
    if len(turns) == 1:
        return ""
    angle = "by 90°" if len(turns) == 4 else "by 180°"
    return (
        f"The {describe_board(spec)} looks the same when turned {angle}; its orientation is decided by the "
        "agreement of all views with the robot's motion. A board whose columns + rows is odd avoids this."
    )


def describe_board(spec: BoardSpec) -> str:
    """Describe the board for people: 'chessboard 7×6, 25 mm'."""
    if spec.kind is BoardKind.UNSEEN:
        return "not seen, poses told"
    if spec.kind in SINGLE_TAGS:
        return f"{spec.kind.value} {spec.tag_id} of {tag_dictionary(spec)}, {spec.square_m * 1000:g} mm"
    text = f"{spec.kind.value} {spec.columns}×{spec.rows}, {spec.square_m * 1000:g} mm"
    if spec.square_guessed:
        text += " by the arm's motion"
    if spec.kind is BoardKind.CHARUCO:
        layout = ", legacy layout" if spec.legacy else ""
        text += f", markers {(spec.marker_m or 0) * 1000:g} mm {spec.dictionary}{layout}"
    elif spec.kind is BoardKind.APRIL_GRID:
        text += f", gap {(spec.marker_m or 0) * 1000:g} mm"
    return text


def outer_corners(board: BoardSpec) -> tuple[int, ...]:
    """The four points nearest to the board's own corners: rows of `board_points`."""
    points = board_points(board)[:, :2]
    scores = points @ np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]]).T
    return tuple(dict.fromkeys(int(row) for row in scores.argmin(axis=0)))
