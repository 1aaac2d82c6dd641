"""The board as the files of a folder describe it: kind, sides, and lengths of square and marker.

Facts are keys with their values: `board_width: 9`, and `chessboard_size: 0.025` for a `size` inside of a
`chessboard`. A text is a fact, too: `board: 9x6, squares of 25 mm`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeGuard

import cv2

from calibrate.boards.model import BoardError, typed_board, usual_markers
from recordings.schema.messages import BoardKind, BoardSpec

_COLUMN_WORDS = frozenset(
    {"columns", "column", "cols", "col", "ncols", "width", "w", "x", "nx", "horizontal"}
)
_ROW_WORDS = frozenset({"rows", "row", "nrows", "height", "h", "y", "ny", "vertical"})
"""Words of the two keys that count a board's sides."""
_ONE_OF_MANY = frozenset({"square", "tile", "marker", "tag"})
"""A key with one of these words tells the width and height of a single one; of a grid of them see `_GRID`."""
_GRID = frozenset({"board", "grid"})
_SQUARE = re.compile(r"square|tile|spacing|chessboard_dim|center_dist|tag_size", re.I)
"""Keys of the length of a square, of the distance of circles, or of the side of a single tag."""
_MARKER = re.compile(r"(aruco|len|size|side).*marker|marker.*(dim|size|len|side)", re.I)
"""Keys of the length of a marker inside of a square."""
_LENGTH_WORDS = frozenset({"size", "side", "length", "len", "edge", "dim"})
_WORDS_BESIDE = frozenset(
    {
        *("board", "chess", "chessboard", "checker", "checkerboard", "pattern", "grid", "target"),
        *("calibration", "calib", "of", "a", "the", "in", "is"),
    }
)
"""A key of these two sets alone tells the square of a board whose sides are counted elsewhere."""
_UNITS_M = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1e-3),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 1e-2),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("inch", "inches"), 0.0254),
}
_UNIT = "|".join(sorted(_UNITS_M, key=len, reverse=True))
_LENGTH = re.compile(rf"(?<![\w.,])(\d+(?:[.,]\d+)?) ?({_UNIT})\b", re.I)
"""A number with its unit."""
_SIZE = re.compile(r"(?<![\w.])(\d{1,2}) ?(?:[x×*]|by) ?(\d{1,2})(?!\w|\.\d)")
"""`9x6`, `9 × 6`, `9 by 6`."""
_LARGEST_METRES = 1.0
"""A larger number without a unit is one of millimetres."""
_SIDES_LIMIT = 60
"""No board has so many columns or rows."""
_WIDEST_GAP = 10.0
"""Sides of tags that the gap between two of a grid is never."""
_SQUARES_M = 0.002, 0.5
"""Sides of squares for which a key without the word is believed."""


@dataclass(frozen=True)
class Described:
    """What files tell of a board."""

    boards: tuple[BoardSpec, ...]
    """The boards that it may be, likeliest first. `square_m` 0: the length of a square is not told."""
    square_m: float
    """Side of a square, or distance of circles; 0: not told."""
    tag_m: float
    """Side of a single tag; 0: not told."""


def described(facts: dict[str, Any]) -> Described:
    """Read what facts tell."""
    texts = [f"{key} {value}" for key, value in facts.items() if isinstance(value, str)]
    pairs = _pairs_of_counts(facts)
    counts = {key for pair in pairs for key in pair}
    sizes = list(_sizes(facts, pairs, texts))
    square_m = _length_m(facts, _SQUARE, counts) or _square_in_texts(texts)
    if not square_m and sizes:
        square_m = _plain_length_m(facts, counts)
    marker_m = _length_m(facts, _MARKER, counts)
    said = " ".join(f"{key} {value}" for key, value in facts.items()).lower()
    boards = [*_typed(facts), *_april_grids(facts)]
    if not boards:
        dictionary = _dictionary(facts, texts)
        for size in sizes:
            boards += _of_size(size, square_m, marker_m, dictionary, circles="circle" in said)
    return Described(tuple(dict.fromkeys(boards)), square_m, marker_m or square_m)


def _of_size(
    size: tuple[int, int], square_m: float, marker_m: float, dictionary: str | None, circles: bool
) -> Iterator[BoardSpec]:
    """The boards of two sides as they are told."""
    columns, rows = size
    if dictionary and size == (1, 1):
        for tag in range(4):
            yield BoardSpec(BoardKind.ARUCO, 1, 1, marker_m, dictionary=dictionary, tag_id=tag)
    elif dictionary:
        for legacy in (False, True):
            marker = marker_m or usual_markers(BoardKind.CHARUCO, square_m)[0]
            yield BoardSpec(BoardKind.CHARUCO, columns, rows, square_m, marker, dictionary, legacy)
    elif circles:
        yield BoardSpec(BoardKind.CIRCLES, columns, rows, square_m)
        yield BoardSpec(BoardKind.ASYMMETRIC_CIRCLES, columns, rows, square_m)
    else:
        yield BoardSpec(BoardKind.CHESSBOARD, columns, rows, square_m)
        yield BoardSpec(BoardKind.CHESSBOARD, columns - 1, rows - 1, square_m)  # squares may be counted


def _typed(facts: dict[str, Any]) -> Iterator[BoardSpec]:
    """Boards written as `--board` takes them."""
    for value in facts.values():
        if isinstance(value, str) and _SIZE.search(value):
            with suppress(BoardError):
                yield typed_board(value)


def _april_grids(facts: dict[str, Any]) -> Iterator[BoardSpec]:
    """The grid of tags of Kalibr's target.yaml: the gap between tags is told as a share of their side."""
    columns = facts.get("tag_cols")
    rows = facts.get("tag_rows")
    side_m = facts.get("tag_size")
    gap = facts.get("tag_spacing")
    if not _is_count(columns) or not _is_count(rows) or not _is_number(side_m) or not _is_number(gap):
        return
    if side_m > 0 and 0 < gap < _WIDEST_GAP:
        yield BoardSpec(BoardKind.APRIL_GRID, int(columns), int(rows), float(side_m), float(gap * side_m))


def _dictionary(facts: dict[str, Any], texts: list[str]) -> str | None:
    """OpenCV's name of the markers' dictionary, also where its number is told; None: no markers are told."""
    told = next((value for key, value in facts.items() if "dictionary" in key), None)
    if isinstance(told, str):
        return told
    names = {getattr(cv2.aruco, name): name for name in dir(cv2.aruco) if re.match(r"DICT_\d", name)}
    if isinstance(told, int) and told in names:
        return names[told]
    named = (re.search(r"\bDICT_\w+", text) for text in texts)
    return next((found[0] for found in named if found and hasattr(cv2.aruco, found[0])), None)


# ---- the two sides


def _sizes(
    facts: dict[str, Any], pairs: list[tuple[str, str]], texts: list[str]
) -> Iterator[tuple[int, int]]:
    """(columns, rows), likeliest first, each once."""
    found = [
        (int(value[0]), int(value[1]))
        for key, value in facts.items()
        if re.search("pattern|board|size", key) and _is_two_counts(value)
    ]
    found += [(int(facts[columns]), int(facts[rows])) for columns, rows in pairs]
    found += [(int(a), int(b)) for text in texts for a, b in _SIZE.findall(text)]
    for size in dict.fromkeys(found):
        if min(size) >= 1 and max(size) < _SIDES_LIMIT:
            yield size


def _pairs_of_counts(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """The keys of columns and of rows that count a board's two sides: they differ by one word, as board_width
    and board_height do. Those with more words come first.

    Corners per row are columns. A square's own width is a length.
    """
    sides: dict[tuple[str, ...], dict[bool, str]] = {}
    for key, value in facts.items():
        words = _words(key)
        is_single = not _ONE_OF_MANY.isdisjoint(words) and _GRID.isdisjoint(words)
        if not _is_number(value) or not float(value).is_integer() or is_single:
            continue
        turned = "per" in words
        for word in words:
            if word in _COLUMN_WORDS | _ROW_WORDS:
                beside = tuple(other for other in words if other != word)
                is_columns = (word in _COLUMN_WORDS) != turned
                sides.setdefault(beside, {}).setdefault(is_columns, key)
    both = [beside for beside, each in sides.items() if each.keys() == {True, False}]
    both.sort(key=len, reverse=True)
    return [(sides[beside][True], sides[beside][False]) for beside in both]


# ---- lengths


def _length_m(facts: dict[str, Any], wanted: re.Pattern[str], counts: set[str]) -> float:
    """The length of the first key that is wanted and counts no side, metres; 0: none tells."""
    lengths = (
        _in_metres(key, value, facts)
        for key, value in facts.items()
        if key not in counts and wanted.search(key) and (wanted is _MARKER or not _MARKER.search(key))
    )
    return next((length_m for length_m in lengths if length_m > 0), 0.0)


def _plain_length_m(facts: dict[str, Any], counts: set[str]) -> float:
    """The length of a key that says `size` and nothing else than of a board, metres; 0: none is one."""
    for key, value in facts.items():
        words = set(_words(key)) - _UNITS_M.keys()
        if key in counts or not words & _LENGTH_WORDS or words - _LENGTH_WORDS - _WORDS_BESIDE:
            continue
        length_m = _in_metres(key, value, facts)
        if _SQUARES_M[0] <= length_m <= _SQUARES_M[1]:
            return length_m
    return 0.0


def _in_metres(key: str, value: Any, facts: dict[str, Any]) -> float:
    """A number or a text as a length. 0: it is none.

    Its unit is told by itself, its key or a key beside it; else it is metres or millimetres, as is likely.
    """
    if isinstance(value, str):
        told = _LENGTH.fullmatch(value.strip())
        if told:
            return _metres(told)
        try:
            value = float(value)
        except ValueError:
            return 0.0
    if not _is_number(value) or value <= 0:
        return 0.0
    words = _words(key)
    beside = next((facts[name] for name in facts if _words(name)[-1:] in (["unit"], ["units"])), None)
    units = [word for word in words if word in _UNITS_M]
    if not units and isinstance(beside, str) and beside.lower() in _UNITS_M:
        units = [beside.lower()]
    if units:
        return float(value) * _UNITS_M[units[-1]]
    return value / 1000 if value > _LARGEST_METRES else float(value)


def _square_in_texts(texts: list[str]) -> float:
    """The length of a square that a sentence tells, metres; 0: none does."""
    for text in texts:
        lengths = list(_LENGTH.finditer(text))
        before = re.search(rf"(?:{_SQUARE.pattern})[a-z]*\D{{0,20}}?{_LENGTH.pattern}", text, re.I)
        behind = re.search(rf"{_LENGTH.pattern}\W{{0,3}}(?:square|tile|check)", text, re.I)
        if told := before or behind:
            return _metres(told)
        of_the_board = _SIZE.search(text) or re.search(r"board|pattern", text, re.I)
        if of_the_board and len(lengths) == 1:
            return _metres(lengths[0])
    return 0.0


def _metres(told: re.Match[str]) -> float:
    return float(told[1].replace(",", ".")) * _UNITS_M[told[2].lower()]


def _words(key: str) -> list[str]:
    return re.findall(r"[a-z]+", key.lower())


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_count(value: Any) -> TypeGuard[float]:
    return _is_number(value) and float(value).is_integer() and 1 <= value < _SIDES_LIMIT


def _is_two_counts(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_count, value))
