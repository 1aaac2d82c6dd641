"""What lies in anyone's folder: images, tables of numbers that may be poses, what describes board and camera.

Nodes of the same place in a data file's tree, and of files that differ by digits only, are the rows of one
table.
"""

from __future__ import annotations

import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from recordings.files import read_beginning
from recordings.image_headers import LFS_POINTER
from recordings.importers.trees import (
    IMAGE,
    IMAGE_SUFFIXES,
    POSE_SIZES,
    CommasError,
    UnreadableArraysError,
    read_tree,
)

if TYPE_CHECKING:  # messages of bags load more than a folder needs
    from recordings.importers.messages import Array

_FILES_LIMIT = 5000
_FEWEST_ROWS = 3
_TWO = 2
_FEWEST_SIDES = 4
"""Fewest poses of a list of pairs: of two."""
_FEWEST_FOLDERS = 2
"""Fewest folders of which each may hold one pose."""
_FOLDERS_LIMIT = 5000
_VALUES_LIMIT = 200_000
"""Values and brackets of one file."""
_NUMBER_LIMIT = 1e6
"""No arm is a kilometre long, in whatever unit."""
_STAMP_LEAST = 1e8
"""Seconds since 1970 are more, and numbers of a pose are less."""
_TEXT_LIMIT = 200
"""Letters of a key or a text that are looked at: poses and boards are described in fewer."""
_DIGITS_LIMIT = 18
"""Digits of a running number; Python itself refuses those of some thousands."""
_WORDS_LIMIT = 20_000
_UNREAD = {
    "to be unpacked first": (".zip", ".tar", ".tgz", ".gz", ".7z", ".rar"),
    "to be saved as CSV first": (".xlsx", ".xls", ".ods", ".pkl", ".pickle"),
    "a robot program: its poses to be written as CSV first, one a line": (
        *(".mod", ".sys"),  # ABB
        *(".src", ".krl"),  # KUKA
        *(".ls", ".tp"),  # Fanuc
        *(".jbi", ".as", ".pg", ".urp", ".pac", ".pgx", ".dtx"),
    ),
}
_PROGRAM = next(todo for todo, suffixes in _UNREAD.items() if ".mod" in suffixes)
_KUKA = re.compile(rb"DEFDAT|\bE6POS\b|\bE6AXIS\b")
_COMMAS = "to be written with decimal points first: commas part its numbers and its decimals"
_RESULT = "a result of a calibration, which is not read"
_BEGINNING_BYTES = 64 * 1024
_HALVES = {
    "position": (re.compile(r"pos|position|trans\w*|tvecs?|t|xyz|p|location"), (3,)),
    "rotation": (re.compile(r"rot\w*|ori\w*|quat\w*|rvecs?|r|rpy|euler\w*|rodrigues"), (3, 4, 9)),
}
"""Words of the two halves of a pose that are told apart, and how many numbers each has."""
_OPENCVS = re.compile(r"(?<![a-z])(?:[rt]_?vecs?|rodrigues)(?![a-z])", re.I)
"""OpenCV's names of the halves of a pose, of which that of the turn says that it is a rotation vector."""
_ROTATION_VECTOR = re.compile(rf"{_OPENCVS.pattern}|rot(?:ation)?_?vec(?:tor)?s?(?![a-z])", re.I)
_HAND_AND_EYE = {"h": "hand", "e": "eye"}
"""Letters of columns that tell the two sides of a pair, where both are there: h_x … e_qw."""
_FORM = re.compile(r"m|mm|deg|rad|vec|vector|xyzw|wxyz|matrix|mat|\dx\d|x|angles?")
"""Words of a half's name that tell its unit or form."""
_COLUMNS = {
    "xyzw": ("qx", "qy", "qz", "qw"),
    "": ("rx", "ry", "rz"),
    "xyz": ("roll", "pitch", "yaw"),
    "ZYX": ("a", "b", "c"),
}
"""Names of columns behind x, y, z, and the rotation that they name."""
_IDENTITIES = frozenset(
    {
        *("image", "img", "image_id", "image_name", "picture", "photo", "frame"),
        *("file", "filename", "file_name", "name", "id", "index", "idx"),
    }
)
"""Columns and keys that tell which image a row belongs to."""
_WHOSE = {
    "other": re.compile(r"detect|joint|result|valid|guess|waiting|intrin", re.I),
    "robot": re.compile(
        r"robot|arm|tcp|tool|flange|gripper|hand(?!_?eye)|eef|end|effector|wrist|ee$|location", re.I
    ),
    "board": re.compile(r"cam|board|marker|target|track|obj|eye|chess|tag|sensor|[rt]vec", re.I),
}
"""Words of tables that tell of something else, of the robot's pose, and of the board's."""
_OF_BOARDS = re.compile(r"board|square|pattern|marker|dictionary|chess|circle|corner|^(columns|rows|cols)$")
_PART = re.compile(r"(.*?)[_. ]?(q?[xyzw]|r[xyz]|roll|pitch|yaw|[abc]|\d+)")
"""A name of one number among those of a pose: whose pose, and which number."""


def whose_of(name: str) -> str:
    """robot, board or other by the last words of a table's name that say any; empty: none says."""
    name = re.sub(r"hand_?eye|(?i:(eye|hand)_?(in|to|on)_?(hand|eye))", "", name)
    for part in reversed(re.split(r"[ /.]", name)):
        for whose, words in _WHOSE.items():
            if words.search(part):
                return whose
    return ""


@dataclass(frozen=True, eq=False)
class Table:
    """Numbers that may be poses, one row each."""

    name: str
    """File and place in it, digits as #."""
    rotation: str
    """What names of columns or the form of the numbers say of the rotation; empty: nothing."""
    numbers: Array
    """(n, k), k of 6, 7, 12 and 16"""
    images: list[str]
    """Name of the row's image as told beside it; empty: none."""
    places: list[tuple[int, ...]]
    """Numbers in the row's file name and place, its order."""
    files: str = ""
    """The file that holds it, or files of one row each, with # for the digits that tell them apart."""

    @property
    def whose(self) -> str:
        """robot, board or other by its last words that say any; empty: none says."""
        return whose_of(self.name)


@dataclass(frozen=True)
class ShortTable:
    """Numbers that may be poses, of too few rows to be read."""

    name: str
    rows: int

    @property
    def whose(self) -> str:
        """As that of a table."""
        return whose_of(self.name)


@dataclass
class Contents:
    """What a folder holds."""

    root: Path
    images: dict[str, list[Path]] = field(default_factory=dict)
    """Images by their folder and their name with digits as #."""
    tables: list[Table] = field(default_factory=list)
    cameras: list[tuple[Array, tuple[float, ...]]] = field(default_factory=list)
    """Matrix (3, 3) and distortion, each once."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Values of leaves that describe a board, by key: `boardWidth` is board_width."""
    words: str = ""
    """The folder's last names, names of files and keys: what may say how the camera is mounted."""
    files: dict[str, str] = field(default_factory=dict)
    """All files → their name with # for the digits that tell them apart."""
    described_by: set[str] = field(default_factory=set)
    """Those of them that say something of camera or board."""
    unread: dict[str, str] = field(default_factory=dict)
    """Files that are not looked into → what is to be done first."""
    told: list[Table] | None = None
    """The robot's tables that the user names; None: none was named."""
    told_as: str = ""
    """How the user names them."""
    short: list[ShortTable] = field(default_factory=list)
    """Tables with too few rows."""


@dataclass
class _Row:
    numbers: list[float]
    image: str
    place: tuple[int, ...]
    told: bool
    file: str
    labels: dict[str, str]
    """Other words and whole numbers told beside the numbers, by column or key."""


def look(
    source: Path, poses: Path | None = None, reading: Callable[[Path], None] = lambda path: None
) -> Contents:
    """Read what lies in a folder, or one file, in this process: imports call `reader.look`.

    `poses` tells the robot's: a file, a folder or the end of their names. `reading` is told each file before
    it is read.
    """
    root = source if source.is_dir() else source.parent
    file = poses if poses is None or poses.exists() else root / poses
    found, words = Contents(root), ["/".join(source.resolve().parts[-3:])]
    rows = defaultdict[tuple[str, ...], list[_Row]](list)
    files = list(islice(_files(source, found.unread), _FILES_LIMIT + 1))
    if len(files) > _FILES_LIMIT:
        found.unread[f"more than {_FILES_LIMIT} files"] = "those that are needed to be put elsewhere first"
    files = sorted(files[:_FILES_LIMIT], key=natural)
    folded = _folded([path.relative_to(root) for path in files])
    for path in files if file is None or file.is_relative_to(root) else [*files, file]:
        alike = folded[path.relative_to(root)] if path.is_relative_to(root) else _pattern(path.name)
        name = str(path.relative_to(root)) if path.is_relative_to(root) else path.name
        found.files[name] = alike
        if path.suffix.lower() in IMAGE_SUFFIXES:
            found.images.setdefault(alike, []).append(path)
            continue
        todo = next((todo for todo, suffixes in _UNREAD.items() if path.suffix.lower() in suffixes), "")
        if _begins(path, LFS_POINTER):
            todo = "to be fetched first with `git lfs pull`"
        elif path.suffix.lower() == ".dat" and _is_kuka_program(path):
            todo = _PROGRAM
        if todo:
            found.unread[alike] = todo
        if todo or path.name.startswith((".", "README", "CMake")):
            continue
        reading(path)
        try:
            tree = read_tree(path)
            if _is_result(tree):
                found.unread[alike] = _RESULT
                continue
            nodes = list(islice(_nodes(tree, (), ""), _VALUES_LIMIT + 1))
        except CommasError:
            found.unread[alike] = _COMMAS
            continue
        except UnreadableArraysError as problem:
            found.unread[alike] = f"to be saved as CSV first ({problem})"
            continue
        except RecursionError:
            found.unread[alike] = "to be saved as CSV first (nested too deeply)"
            continue
        if len(nodes) > _VALUES_LIMIT:
            found.unread[alike] = f"to be shortened first: more than {_VALUES_LIMIT} values"
            continue
        if not nodes:
            continue
        words.append(name)
        told = defaultdict[tuple[str, ...], list[_Row]](list)
        for node in nodes:
            if _facts(node, found):
                found.described_by.add(name)
            words.extend(node.keys[-1:])
            if isinstance(node.value, str):
                words.append(node.value[:60])
            if (row := _pose(node.value) or _half(node)) is not None:
                numbers, rotation, half = row
                place = (*_numbers_in(name), *node.place)
                key = ".".join(filter(None, node.keys)), rotation, half, str(len(numbers))
                is_told = file in (path, *path.parents)
                told[key].append(_Row(numbers, node.image, place, is_told, alike, node.labels))
        for (named, *form), each in told.items():  # files of one row each make a table together
            holder = alike if len(each) == 1 else name
            for single in each:
                single.file = holder
            rows[f"{holder} {named}".strip(), *form].extend(each)
    words = words[:_WORDS_LIMIT]
    words += [re.sub("[- ]", "_", word) for word in words]
    found.words = " ".join(dict.fromkeys(words))
    told_tables: list[Table] = []
    for name, rotation, each in _joined(rows):
        for part, some in _parts_of(each).items():
            told_numbers = np.array([row.numbers for row in some])
            table = _without_count(told_numbers)
            poses_alike = table.shape[1] in (6, 7, 12, 16) and float(np.abs(table).max()) <= _NUMBER_LIMIT
            if poses_alike and len(some) < _FEWEST_ROWS:
                found.short.append(ShortTable(_name_of_part(name, part), len(some)))
            elif poses_alike:
                counts = told_numbers[:, 0] if table.shape[1] < told_numbers.shape[1] else None
                beside = _names_of_rows(some, counts, found.images), [row.place for row in some]
                found.tables.append(
                    Table(_name_of_part(name, part), rotation, table, *beside, files=some[0].file)
                )
                if some[0].told:
                    told_tables.append(found.tables[-1])
    if poses is not None:  # what exists is meant before what is named so
        is_there = file is not None and file.exists()
        found.told_as = str(poses)
        found.told = told_tables if is_there else _named_so(found.tables, str(poses))
    return found


def _folded(files: list[Path]) -> dict[Path, str]:
    """Files → their name with digits as #: those with the same one belong together.

    Digits of a folder tell sessions and cameras apart. They are folded only where there is one folder for
    each pose: at least two folders alike, with one file of the kind in each.
    """
    kinds = defaultdict[str, list[Path]](list)
    for file in files:
        kinds[str(file.parent / _pattern(file.name))].append(file)
    folded = {file: kind for kind, each in kinds.items() for file in each}
    by_pose = defaultdict[str, list[Path]](list)
    for kind, each in kinds.items():
        if len(each) == 1:
            *above, _ = each[0].parts
            numbered = [level for level, name in enumerate(above) if _pattern(name) != name]
            if numbered:
                level = numbered[-1]
                parts = [*above[:level], _pattern(above[level]), *above[level + 1 :], Path(kind).name]
                by_pose[str(Path(*parts))].append(each[0])
    for kind, each in by_pose.items():
        if len(each) >= _FEWEST_FOLDERS:
            folded.update(dict.fromkeys(each, kind))
    return folded


def _joined(rows: dict[tuple[str, ...], list[_Row]]) -> Iterator[tuple[str, str, list[_Row]]]:
    """(name, rotation, rows) of whole poses, then of halves named alike but for which half they are.

    OpenCV's `rvec` and `tvec` stay in the name of what is the board's, by its name or beside whole poses
    that are the robot's or have no name: they tell the direction of its poses.
    """
    robot_named = any(whose_of(name) == "robot" for name, *_ in rows)
    whole = {name for name, _, half, _ in rows if not half}
    halves = defaultdict[tuple[str, int], dict[str, tuple[str, ...]]](dict)
    for key, each in rows.items():
        if key[2]:
            words = re.split(r"[/_. #]+", key[0].lower())
            alike = " ".join(word for word in words if not (_half_of(word) or _FORM.fullmatch(word)))
            halves[alike, len(each)].setdefault(key[2], key)
        else:
            yield key[0], key[1], each
    for both in halves.values():
        if len(both) == 2:
            at, turn = both["position"], both["rotation"]
            path, _, last = at[0].replace(" ", ".").rpartition(".")
            above = at[0][: len(path)]
            last_of_turn = turn[0].replace(" ", ".").rpartition(".")[2]
            is_opencvs = _OPENCVS.fullmatch(last_of_turn) and turn[1] == "rotvec"
            is_unnamed = whose_of(above) == ""
            beside_robots = is_unnamed and (robot_named or above in whole)
            name = turn[0] if is_opencvs and (whose_of(above) == "board" or beside_robots) else above
            for row, other in zip(rows[at], rows[turn], strict=True):
                row.numbers += other.numbers
                if len(row.numbers) == 12:  # a matrix has each row's number of the position behind it
                    row.numbers = [row.numbers[k] for k in (3, 4, 5, 0, 6, 7, 8, 1, 9, 10, 11, 2)]
            yield at[0] if "_" in last else name, turn[1], rows[at]


def _without_count(table: Array) -> Array:
    """The table without a first column of time stamps or running numbers, or a last one of time stamps."""
    last, columns = table[:, -1], table.shape[1]
    if columns in (7, 8, 13, 17) and last.min() > _STAMP_LEAST and bool((np.diff(last) > 0).all()):
        return table[:, :-1]
    first = table[:, 0]
    rises = bool((np.diff(first) > 0).all()) and (columns != 7 or not np.any(first % 1))
    if columns != 7 and _are_counts(first):  # in whatever order
        rises = True
    return table[:, 1:] if rises and columns in (7, 8, 13, 17) else table


def _are_counts(numbers: Array) -> bool:
    """Tell whether numbers (n,) are whole ones, each once."""
    return len(np.unique(numbers)) == len(numbers) and not np.any(numbers % 1)


def _names_of_rows(rows: list[_Row], counts: Array | None, images: dict[str, list[Path]]) -> list[str]:
    """Name or number of each row's image: as a column or key says that names one, else by whatever is told
    beside the numbers and names all images of a family, each once; empty: nothing does."""
    told = [row.image for row in rows]
    ways = [told]
    ways += [[row.labels.get(key, "") for row in rows] for key in rows[0].labels]
    if counts is not None and _are_counts(counts):
        ways.append([str(int(count)) for count in counts])
    for names in ways:
        if len(set(names)) < len(rows):
            continue
        numbers = [(re.findall(r"\d+", name) or [""])[-1][-_DIGITS_LIMIT:] for name in names]
        for paths in images.values():
            if {path.stem for path in paths} <= {PurePath(name).stem for name in names}:
                return names
            if _running_numbers(paths) == {int(number) for number in numbers if number}:
                return numbers
    return told


def _running_numbers(paths: list[Path]) -> set[int]:
    """The last numbers of the names of images; empty: they do not tell all apart."""
    found = {int(each[-1][-_DIGITS_LIMIT:]) for path in paths if (each := re.findall(r"\d+", path.stem))}
    return found if len(found) == len(paths) else set()


def _named_so(tables: list[Table], end: str) -> list[Table]:
    """Tables of this name, else those whose name ends with it as a whole word, else with its letters."""
    ways: list[Callable[[str], bool]] = [
        lambda name: name == end,
        lambda name: name.endswith(tuple(f"{mark}{end}" for mark in "/ .")),
        lambda name: name.endswith(end),
    ]
    for is_meant in ways:
        meant = [table for table in tables if is_meant(table.name)]
        if meant:
            return meant
    return []


def _parts_of(rows: list[_Row]) -> dict[str, list[_Row]]:
    """Tables among rows of one name, by what is added to it: a list of pairs, the robot's first, is two.

    So are T1_0, T2_0, T1_1, T2_1 …, by the number that tells the two apart. What is named by two numbers may
    also be one table, of a grid of places.
    """
    last = [row.place[-1] if row.place else 0 for row in rows]
    if len(rows) >= _FEWEST_SIDES and last == [0, 1] * (len(rows) // 2):
        return {" robot": rows[::2], " board": rows[1::2]}
    parts = {"": rows}
    lengths = {len(row.place) for row in rows}
    for column in range(max(lengths)) if len(lengths) == 1 and max(lengths) > 1 else ():
        two = sorted({row.place[column] for row in rows})
        if len(two) != _TWO or len(rows) < _TWO * _FEWEST_ROWS:
            continue
        first, second = ([row for row in rows if row.place[column] == number] for number in two)
        rest = [{(*row.place[:column], *row.place[column + 1 :]) for row in each} for each in (first, second)]
        if rest[0] == rest[1] and len(rest[0]) == len(first) == len(second):
            parts |= {f"#{column}={two[0]}": first, f"#{column}={two[1]}": second}
    return parts


def _name_of_part(name: str, part: str) -> str:
    """The name of a table with the number that tells it apart: T#_# → T1_#."""
    if not part.startswith("#"):
        return name + part
    column, _, number = part.removeprefix("#").partition("=")
    places = [match.start() for match in re.finditer("#", name)]
    if int(column) >= len(places):
        return f"{name} {number}"
    at = places[int(column)]
    return f"{name[:at]}{number}{name[at + 1 :]}"


def _files(source: Path, unread: dict[str, str]) -> Iterator[Path]:
    """All files, also below folders that are links; each once. Links that leave `source` are `unread`."""
    if source.is_file():
        yield source
    root = os.path.realpath(source)
    been = {root}

    def is_inside(path: Path) -> bool:
        if not path.is_symlink() or Path(os.path.realpath(path)).is_relative_to(root):
            return True
        unread[path.name] = "to be copied here first: a link that leaves the folder"
        return False

    for folder, below, names in os.walk(source, followlinks=True):
        paths = [Path(folder, name) for name in sorted(below)]
        new = {os.path.realpath(path): path.name for path in paths if is_inside(path)}
        below[:] = [name for real, name in new.items() if real not in been]
        been.update(new)
        if len(been) > _FOLDERS_LIMIT:
            unread[f"more than {_FOLDERS_LIMIT} folders"] = "those that are needed to be put into one first"
            return
        for name in sorted(names):
            path = Path(folder, name)
            if is_inside(path) and path.is_file():
                yield path


def _begins(path: Path, beginning: bytes) -> bool:
    with suppress(OSError):
        return read_beginning(path, len(beginning)) == beginning
    return False


def _is_kuka_program(path: Path) -> bool:
    with suppress(OSError):
        return _KUKA.search(read_beginning(path, _BEGINNING_BYTES)) is not None
    return False


def _is_result(tree: Any) -> bool:
    """Tell whether a file is a calibration of ours or of easy_handeye: what came out, not what went in."""
    if not isinstance(tree, dict):
        return False
    ours = str(tree.get("format", "")).startswith("handeye-calibration")
    easy_handeyes = "transformation" in tree or ("parameters" in tree and "transform" in tree)
    return ours or (easy_handeyes and "samples" not in tree)


def natural(path: Path | str) -> list[Any]:
    """Sort key by which 2 comes before 10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", str(path))]


def _numbers_in(text: str) -> tuple[int, ...]:
    return tuple(int(digits[-_DIGITS_LIMIT:]) for digits in re.findall(r"\d+", text))


def _pattern(path: Path | str) -> str:
    return re.sub(r"\d+", "#", str(path))


@dataclass
class _Node:
    value: Any
    keys: tuple[str, ...]
    place: tuple[int, ...]
    image: str
    labels: dict[str, str]


def _nodes(
    tree: Any,
    keys: tuple[str, ...],
    image: str,
    place: tuple[int, ...] = (),
    labels: dict[str, str] | None = None,
) -> Iterator[_Node]:
    """The tree's nodes, those inside of a pose or of its half left out."""
    if isinstance(tree, dict):
        image = _image_of(tree) or image
        labels = _labels_of(tree) or labels
    labels = labels or {}
    yield (node := _Node(tree, keys, place, image, labels))
    if (isinstance(tree, list) or _is_matrix(tree)) and (_pose(tree) or _half(node)):
        return
    if _is_matrix(tree):  # its rows and columns are no board's
        yield from _nodes(_rows_of_matrix(tree), keys, image, place, labels)
    elif isinstance(tree, dict):
        yield from (_Node(parts, (*keys, stem), place, image, labels) for stem, parts in _stems(tree))
        for key, value in tree.items():
            name = str(key)[:_TEXT_LIMIT]
            named = name if IMAGE.fullmatch(name) else image
            yield from _nodes(value, (*keys, _pattern(name)), named, (*place, *_numbers_in(str(key))), labels)
    elif isinstance(tree, list):
        for at, value in enumerate(tree):
            if isinstance(value, (dict, list)):
                yield from _nodes(value, keys, image, (*place, at), labels)


def _image_of(row: dict[str, Any]) -> str:
    """The name or running number of a row's image as it is told beside its numbers; empty: none."""
    for value in row.values():
        if isinstance(value, str) and len(value) <= _TEXT_LIMIT and IMAGE.fullmatch(value):
            return value
    for key, value in row.items():
        if str(key).lower() not in _IDENTITIES or isinstance(value, bool):
            continue
        if isinstance(value, str) and 0 < len(value) <= _TEXT_LIMIT:
            return value
        if isinstance(value, (int, float)) and abs(value) < _NUMBER_LIMIT and float(value).is_integer():
            return str(int(value))
    return ""


def _labels_of(row: dict[str, Any]) -> dict[str, str]:
    """What is told beside the numbers of a row and may name its image, by key: words and whole numbers."""
    labels: dict[str, str] = {}
    for key, value in row.items():
        name = str(key)[:_TEXT_LIMIT]
        if isinstance(value, str) and 0 < len(value) <= _TEXT_LIMIT:
            labels[name] = value
        elif isinstance(value, (int, float)) and abs(value) < _NUMBER_LIMIT and float(value).is_integer():
            labels[name] = str(int(value))
    return labels


def _rows_of_matrix(matrix: dict[str, Any]) -> list[Any]:
    """The rows of OpenCV's matrix where each may be a pose; else nothing to look into."""
    numbers = _flat(matrix)
    columns = matrix.get("cols")
    if not numbers or columns not in POSE_SIZES or len(numbers) % columns:
        return []
    return [numbers[at : at + columns] for at in range(0, len(numbers), columns)]


def _stems(tree: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Poses whose numbers have a name each that begins alike: tcp_x, tcp_y …; pose1, pose2 …"""
    groups = defaultdict[str, dict[str, float]](dict)
    for key, value in tree.items():
        part = _PART.fullmatch(_plain_key(str(key))) if len(str(key)) <= _TEXT_LIMIT else None
        if part and part[1] and isinstance(value, (int, float)):
            groups[part[1]][part[2]] = value
    both = _HAND_AND_EYE if groups.keys() >= _HAND_AND_EYE.keys() else {}
    for letter, parts in groups.items():
        stem = both.get(letter, letter)
        yield stem, list(parts.values()) if "".join(parts).isdigit() else parts


def _flat(value: Any) -> list[float] | None:
    """The numbers of a number, of lists of them, of {x, y, z, w} and of OpenCV's matrix."""
    if isinstance(value, dict):
        told = {str(key).lower(): each for key, each in value.items()}
        if _is_matrix(value):
            return _flat(told["data"])
        names = next((n for n in ("xyzw", "xyz") if set(n) == set(told)), "")
        return _flat([told[name] for name in names]) if names else None
    if isinstance(value, list):
        parts = [_flat(part) for part in value]
        return None if None in parts else [number for part in parts if part for number in part]
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        return [float(value)]
    except OverflowError:  # a whole number of some hundred digits
        return None


def _is_matrix(value: Any) -> bool:
    """Tell whether this is OpenCV's."""
    return isinstance(value, dict) and {"rows", "data"} <= value.keys()


def _pose(value: Any) -> tuple[list[float], str, str] | None:
    """(numbers, what is known of the rotation, "") of a node that can be a pose, or None."""
    numbers = _flat(value) if isinstance(value, list) or _is_matrix(value) else None
    if numbers is not None:
        nested = isinstance(value, list) and any(isinstance(row, list) and len(row) > 1 for row in value)
        if len(numbers) not in POSE_SIZES or (nested and len(numbers) < 12):
            return None
        if len(numbers) == 16 and not any(numbers[3:15:4]) and any(numbers[12:15]):
            numbers = [numbers[4 * column + row] for row in range(4) for column in range(4)]
        return (numbers, "", "") if np.isfinite(numbers).all() else None
    if not isinstance(value, dict):
        return None
    told = {_plain_key(str(key)): each for key, each in value.items()}
    for rotation, columns in _COLUMNS.items():
        flat = _flat([told.get(name) for name in ("x", "y", "z", *columns)])
        if flat is not None and np.isfinite(flat).all():
            return flat, rotation, ""
    return None


def _plain_key(key: str) -> str:
    """A key without its unit."""
    return re.sub(r"[ _]?\(.*|_?(m|mm|cm|deg|rad)$|_(in|inch|inches)$", "", key.lower())


def _half(node: _Node) -> tuple[list[float], str, str] | None:
    """(numbers, what is known of the rotation, which half) of a node that is half of a pose, or None.

    The last word of its key that names one tells which.
    """
    words = _plain_key(node.keys[-1]).split("_") if node.keys else []
    half = next((half for word in reversed(words) if (half := _half_of(word))), "")
    flat = _flat(node.value) if half else None
    if not flat or len(flat) not in _HALVES[half][1] or not np.isfinite(flat).all():
        return None
    return flat, _form_of_half(node, half, len(flat)), half


def _form_of_half(node: _Node, half: str, count: int) -> str:
    """What the key or the parts of half of a pose say of the form of its rotation; empty: nothing."""
    if isinstance(node.value, dict) and "w" in node.value:
        return "xyzw"
    is_vector = half == "rotation" and count == 3 and _ROTATION_VECTOR.search(node.keys[-1])
    return "rotvec" if is_vector else ""


def _half_of(word: str) -> str | None:
    return next((half for half, (words, _) in _HALVES.items() if words.fullmatch(word.strip("#"))), None)


def _fact_key(keys: tuple[str, ...]) -> str:
    """The last key in lower case, words parted by `_`.

    The key above it stands before it where only that one speaks of a board: the `size` in a `chessboard` is
    chessboard_size.
    """
    above, last = ("", "", *(re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", key).lower() for key in keys))[-2:]
    return f"{above}_{last}" if _OF_BOARDS.search(above) and not _OF_BOARDS.search(last) else last


def _facts(node: _Node, found: Contents) -> bool:
    """Note a camera's matrix, by its form, and what describes a board; returns whether it seems to be so."""
    numbers = _flat(node.value) if isinstance(node.value, (list, dict)) else None
    if numbers and not np.isfinite(numbers).all():
        return False
    key = _fact_key(node.keys)
    tells = bool(_OF_BOARDS.search(key))
    if numbers and len(numbers) >= 9:
        K = np.array(numbers[:9]).reshape(3, 3)
        if K[0, 0] > 100 and K[1, 1] > 100 and not K[1, 0] and np.allclose(K[2], [0, 0, 1]):
            beside = tuple(numbers[9:14]) if len(numbers) in (13, 14) else ()
            if not any(np.allclose(K, other) for other, _ in found.cameras):
                found.cameras.append((K, beside))
            return True
    if numbers and "dist" in key and len(numbers) in (4, 5, 8) and found.cameras and not found.cameras[-1][1]:
        found.cameras[-1] = found.cameras[-1][0], tuple(numbers)
    if isinstance(node.value, dict):
        told = {str(k).lower(): v for k, v in node.value.items()}
        lens = _flat([told.get(name) for name in ("fx", "fy", "cx", "cy")])
        if lens and len(lens) == 4 and np.isfinite(lens).all() and not found.cameras:
            fx, fy, cx, cy = lens
            found.cameras.append((np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), ()))
            tells = True
    if isinstance(node.value, str):
        found.facts.setdefault(key, node.value[:_TEXT_LIMIT])
    elif isinstance(node.value, (dict, list)):
        if numbers and len(numbers) == 2:
            found.facts.setdefault(key, numbers)
    elif node.value is None or isinstance(node.value, bool) or abs((_flat(node.value) or [np.inf])[0]) < 1e15:
        found.facts.setdefault(key, node.value)
    return tells
