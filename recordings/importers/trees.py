"""Data files of any form as plain trees: dicts, lists, numbers, texts."""

from __future__ import annotations

import codecs
import json
import math
import re
import zipfile
from collections import defaultdict
from io import BytesIO
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from recordings import strict_yaml
from recordings.files import read_file

_BYTES_LIMIT, _ARRAY_LIMIT_BYTES = 4 * 1024 * 1024, 128 * 1024
_UNPACKED_LIMIT_BYTES = 4 * 1024 * 1024
"""Of an archive of arrays."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".pgm", ".tif", ".tiff")
_YAML = (".yaml", ".yml", ".samples", ".calib")
_ARRAYS = (".npy", ".npz", ".mat")
DATA_SUFFIXES = (*_YAML, *_ARRAYS, ".json", ".xml", ".csv", ".txt", ".dat", ".tsv", ".script")
"""Of files that are looked into."""
_NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d++(?:\.\d*+)?+|\.\d++)(?:[eE][-+]?\d++)?+(?![\w.])")
_OF_A_NAME = r"[^\s,;'\"\[\]]"
IMAGE = re.compile(
    rf"(?<!{_OF_A_NAME}){_OF_A_NAME}+(?:{'|'.join(map(re.escape, IMAGE_SUFFIXES))})\b", re.IGNORECASE
)
"""A name of an image. Like the number, it is looked for from the beginning of a word, not from each of its
letters: the time grows with the line's length, not with its square."""
_DAY = r"(?:\d{4}([-/.])\d{1,2}\1\d{1,2}|\d{1,2}([-/.])\d{1,2}\2\d{4})"
_ZONE = r"(?:Z|[-+]\d{2}:?\d{2})?"
_BEHIND_A_DAY = r"(?:[T_ ]+\d{1,2}[:-]\d{2}(?:[:-]\d{2}(?:[.,]\d+)?)?)?"
_TIME = r"\d{1,2}:\d{2}(?::\d{2}(?:[.,]\d+)?)?"
DATES = re.compile(rf"(?<![\w.]){_DAY}{_BEHIND_A_DAY}{_ZONE}(?![\w.])|(?<![\w.:]){_TIME}(?![\w.:])")
"""Dates and times of day, which are no numbers of a pose."""
_CELLS = re.compile(r"\s*[;\t]\s*|\s+")
_COMMA_CELLS = re.compile(r"\s*[;\t]\s*|,?\s+")
"""What parts cells where a comma with a space behind it does, and one without is a decimal comma."""
_QUOTED = re.compile(r"([\"'])([-+]?\d+),(\d+(?:[eE][-+]?\d+)?)\1")
_ONLY_COMMAS = re.compile(r"\s*[-+]?\d+,\d+(?:,[-+]?\d+,\d+)*\s*")
_WITH_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?|[-+]?\d+")
_COMMENT = ("#", "%")
_BOARD_IN_WORDS = re.compile(
    r"(?=.*(?:board|chess|check|square|tile|pattern|charuco|circle|marker|grid))"
    r"(?=.*\d ?(?:[x×*] ?\d|(?:mm|cm|m|inch)\b))",
    re.IGNORECASE,
)
_SENTENCE = 200
"""Most letters of a line that tells of a board in words."""
_MOST_OF_A_BOARD = 4
"""Most numbers of such a line: two sides, a square and a marker."""
_MARKED = (  # the mark of UTF-32 begins with that of UTF-16
    ((codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE), "utf-32"),
    ((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE), "utf-16"),
)
_ZEROS = {
    "utf-32-le": ((2, 4), (3, 4)),
    "utf-32-be": ((0, 4), (1, 4)),
    "utf-16-le": ((1, 2),),
    "utf-16-be": ((0, 2),),
}
"""Encodings → first place and step of the bytes that are mostly 0 in a text of Latin letters."""
_SAMPLE_BYTES = 2000
_MOSTLY = 0.4
POSE_SIZES = (6, 7, 12, 16, 8, 13, 17)
"""Numbers of a pose; the last three with a time stamp or a running number before them."""


class UnreadableArraysError(ValueError):
    """A file of arrays from which no numbers can be taken; says why."""


class CommasError(ValueError):
    """Commas part the numbers of a file and their decimals, and nothing tells which do which."""


def read_tree(path: Path) -> Any:
    """A data file as dicts, lists, numbers and texts; None: no such file, or not readable as what it says.

    Raises UnreadableArraysError for a damaged .npy, .npz or .mat, CommasError for what its name says.
    """
    suffix = path.suffix.lower()
    try:
        if suffix in _ARRAYS:
            content = read_file(path, _ARRAY_LIMIT_BYTES)  # larger: an image of depths
            return {name: _poses_first(array).tolist() for name, array in _arrays(path, content).items()}
        if suffix not in DATA_SUFFIXES:
            return None
        content = read_file(path, _BYTES_LIMIT)
        if suffix == ".xml":  # says itself in which letters it is written
            return _of_xml(ElementTree.fromstring(content))
        text = _decoded(content).replace("\N{MINUS SIGN}", "-")
        if suffix == ".json":
            return json.loads(text)
        if suffix in _YAML:
            plain = re.sub(r"^%YAML.*\n|!!opencv-matrix|!!python/\S+", "", text)
            return strict_yaml.load_plain(plain.encode())
        return _of_text(_with_points(text))
    except (UnreadableArraysError, CommasError):
        raise
    except (OSError, ValueError, EOFError, RecursionError, yaml.YAMLError, ElementTree.ParseError):
        return None


def _decoded(content: bytes) -> str:
    """The text of a file in UTF-8, UTF-16 or UTF-32, with its mark of the order of bytes or without."""
    for marks, encoding in _MARKED:
        if content.startswith(marks):
            return content.decode(encoding, "replace")
    for encoding, places in _ZEROS.items():
        zeros = [content[first:_SAMPLE_BYTES:step] for first, step in places]
        if all(each and each.count(0) > _MOSTLY * len(each) for each in zeros):
            return content.decode(encoding, "replace").removeprefix("\ufeff")
    return content.decode("utf-8-sig", "replace")


def _with_points(text: str) -> str:
    """The text with decimal points, where all lines of numbers have decimal commas.

    CommasError where commas without a space part the numbers, too.
    """
    text = _QUOTED.sub(r"\2.\3", text)
    if re.search(r"\d\.\d", _without_words(text)):
        return text
    lines = text.splitlines()
    for between in (_CELLS, _COMMA_CELLS):
        separated = [between.split(line.strip().strip(";")) for line in lines]
        rows = [n for n, cells in enumerate(separated) if _is_row(cells)]
        if rows and all(_is_cell(cell) for n in rows for cell in separated[n]):
            for n in rows:
                lines[n] = "; ".join(cell.replace(",", ".") for cell in separated[n])
            return "\n".join(lines)
    if _are_parted_by_commas_twice(lines):
        raise CommasError
    return text


def _is_row(cells: list[str]) -> bool:
    return len(cells) >= min(POSE_SIZES) and bool(_WITH_COMMA.search(cells[-1]))


def _are_parted_by_commas_twice(lines: list[str]) -> bool:
    """Tell whether lines are of the kind 1,523,-2,071,…: every other number has no sign, and is one of many
    digits somewhere: so are decimals, and no matrix of whole numbers is a pose."""
    rows = [line.strip().split(",") for line in lines if _ONLY_COMMAS.fullmatch(line)]
    decimals = [cell for cells in rows for cell in cells[1::2]]
    sizes = {len(cells) // 2 for cells in rows}
    return bool(rows) and sizes <= {*POSE_SIZES} and max(map(len, decimals)) > 1


def _without_words(text: str) -> str:
    return DATES.sub(" ", IMAGE.sub(" ", text))


def _is_cell(cell: str) -> bool:
    """Tell whether a cell is a number with at most a comma in it, or a word."""
    return bool(_WITH_COMMA.fullmatch(cell) or "," not in cell)


def _arrays(path: Path, content: bytes) -> dict[str, np.ndarray[Any, Any]]:
    """Arrays by name. UnreadableArraysError for whatever the libraries make of a damaged file."""
    try:
        if path.suffix.lower() == ".npy":
            return {path.stem: _array(content)}
        if path.suffix.lower() == ".npz":
            return _unpacked(content)
        from scipy.io import loadmat  # half of the time that a reader needs to start; few folders have one

        loaded = loadmat(BytesIO(content))
        return {name: array for name, array in loaded.items() if not name.startswith("__")}
    except MemoryError:
        raise
    except Exception as error:  # zlib's, zipfile's, the libraries' own and those that they did not foresee
        raise UnreadableArraysError(str(error) or repr(error)) from error


def _poses_first(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Matrices that MATLAB stacks behind each other, (4, 4, n), as (n, 4, 4); others as they are."""
    stacked = array.ndim == 3 and array.shape[:2] == (4, 4) and array.dtype.kind in "fiu"
    if stacked and np.allclose(array[3], [[0], [0], [0], [1]]):
        return np.moveaxis(array, 2, 0)
    return array


def _unpacked(content: bytes) -> dict[str, np.ndarray[Any, Any]]:
    """The arrays of an .npz: not unpacked where that takes more memory than poses do."""
    with zipfile.ZipFile(BytesIO(content)) as archive:
        members = archive.infolist()
        if sum(member.file_size for member in members) > _UNPACKED_LIMIT_BYTES:
            raise ValueError(f"unpacked it is larger than {_UNPACKED_LIMIT_BYTES >> 20} MiB")
        return {member.filename.removesuffix(".npy"): _array(archive.read(member)) for member in members}


def _array(content: bytes) -> np.ndarray[Any, Any]:
    """The array of an .npy whose header claims no more than follows it."""
    file = BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, _, kind = np.lib.format.read_array_header_1_0(file)
    else:
        shape, _, kind = np.lib.format.read_array_header_2_0(file)
    claimed = math.prod(shape) * kind.itemsize
    if not kind.hasobject and claimed > len(content) - file.tell():
        raise ValueError(f"its header claims {claimed} bytes, and {len(content) - file.tell()} follow")
    return np.asarray(np.load(BytesIO(content), allow_pickle=False))


def _of_xml(element: ElementTree.Element) -> Any:
    if not len(element):
        numbers = [float(number) for number in _NUMBER.findall(element.text or "")]
        return numbers if len(numbers) > 1 else numbers[0] if numbers else (element.text or "").strip()
    children = [(child.tag, _of_xml(child)) for child in element]
    unique = len({tag for tag, _ in children}) == len(children)
    return dict(children) if unique else [child for _, child in children]


def _of_text(text: str) -> Any:
    """Lines with as many numbers, and the same words, are rows; four of four numbers are a matrix.

    Lines without words have those of the heading above them. Lines that tell of a board stay texts.
    """
    said: dict[str, str] = {}
    lines: list[str] = []
    for line in filter(str.strip, text.splitlines()):
        if told := _of_a_board(line):
            said.setdefault(*told)
        elif not line.lstrip().startswith(_COMMENT):
            lines.append(line)
    rows = _rows_of(lines)
    if not said:
        return rows
    return {**(rows if isinstance(rows, dict) else {"": rows} if rows else {}), **said}


def _of_a_board(line: str) -> tuple[str, str] | None:
    """(key, text) of a line, perhaps a comment, that tells the size of a board or of its squares in words."""
    plain = line.strip().lstrip("".join(_COMMENT)).strip()
    if len(plain) > _SENTENCE or not _BOARD_IN_WORDS.match(plain) or IMAGE.search(plain):
        return None
    if len(_numbers(plain)) > _MOST_OF_A_BOARD:
        return None
    key, _, value = plain.partition(":" if ":" in plain else "=")
    return (key.strip(), value.strip()) if value.strip() else (plain, plain)


def _rows_of(lines: list[str]) -> Any:
    header = re.split(r"[,;\t]", lines[0]) if lines else []
    header = [name.strip().strip("\"'") for name in header]
    if len(header) >= 6 and not _NUMBER.search(lines[0]):
        names = [re.sub(r"\W.*", "", name.strip().lower()) for name in header]
        cells = [re.split(r"[,;\t]", line) for line in lines[1:]]
        return [dict(zip(names, map(_value, row), strict=False)) for row in cells]
    groups, heading = defaultdict[tuple[str, int], list[Any]](list), ""
    for line in lines:
        image = IMAGE.search(line)
        rest = DATES.sub(" ", line.replace(image[0], "") if image else line)
        inside = [_numbers(part) for part in re.findall(r"\[([^\[\]]+)\]", rest)]
        numbers = next((part for part in inside if len(part) in POSE_SIZES), _numbers(rest))
        said = _NUMBER.sub("", re.sub(r"\[[^\[\]]*+\]", "", rest))
        label = " ".join(re.findall(r"[A-Za-z]\w*", said))[:40]
        if not numbers and not image:
            heading = label
            continue
        label = label or heading
        row = {"image": image[0], "pose": numbers} if image else numbers
        groups[label, len(numbers)].append(row)
    tree: dict[str, Any] = {}
    for (label, count), group in groups.items():
        plain = [row for row in group if isinstance(row, list)]
        if count == 4 and len(plain) % 4 == 0 and plain and np.allclose(plain[3::4], [0, 0, 0, 1], atol=1e-6):
            value: Any = [plain[at : at + 4] for at in range(0, len(plain), 4)]
        elif count == 1:
            value = [row[0] for row in plain]
        else:
            value = group
        while isinstance(value, list) and len(value) == 1:
            value = value[0]
        tree[label if label not in tree else f"{label} {count}"] = value
    return tree.get("") if set(tree) == {""} else tree


def _value(text: str) -> Any:
    text = text.strip().strip("\"'")
    numbers = _numbers(DATES.sub(" ", text))
    return numbers[0] if len(numbers) == 1 else numbers or text.strip()


def _numbers(text: str) -> list[float]:
    return [float(number) for number in _NUMBER.findall(text)]
