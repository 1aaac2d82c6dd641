"""What belongs together in a folder: which images, or poses of a board, go with which rows of which table.

Two sessions often have the same file names, and two cameras the same numbers. So a table goes with the images
that share its folder, or the part of its name that tells sessions apart, before anything else is compared.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import combinations
from pathlib import Path, PurePosixPath

from calibrate.imported.board import FEWEST, Key
from recordings.errors import ImportSourceError
from recordings.files import read_file
from recordings.image_headers import IMAGE_LIMIT_BYTES
from recordings.importers.tables import Contents, Table, natural

_SHARED = 0.8
"""Share of rows and images that must have numbers in common, where they are paired by numbers."""
_COMPARED = 3
"""Images of two families that are compared before they are called the same pictures."""
_MOST_CAMERAS = 4
"""Most cameras whose images differ by a digit of their names."""
_MADE = re.compile(r"draw|calibrated|overlay|visual|detect|result|undist|depth|corner|axes", re.I)
"""Names of images that a program painted on or made. One of infrared is another camera's, not made."""
_PARTS = re.compile(r"[a-z]+\d*|\d+")


@dataclass(frozen=True, eq=False)
class ImageSet:
    """Images of one family, and the tables whose rows go with them."""

    family: str
    """Their folder and name, digits as #."""
    rows: list[tuple[Table, dict[Key, int]]]
    """Each with image → row, of at least `FEWEST`."""

    @property
    def is_made(self) -> bool:
        """Tell whether they seem to be made from other images, which come first."""
        return bool(_MADE.search(self.family))

    @property
    def paths(self) -> list[Path]:
        paths = {path for _, pairs in self.rows for path in pairs if isinstance(path, Path)}
        return sorted(paths, key=natural)


@dataclass(frozen=True, eq=False)
class PairSet:
    """A table of the robot's poses and one of the board's."""

    robot: Table
    board: Table
    pairs: dict[Key, int]
    """Row of the board's → row of the robot's."""


def cameras_apart(held: Contents, robots: list[Table]) -> Contents:
    """The same folder, in which images that go with no table as a whole, and do by a digit of their names,
    are families of their own: im_#_0.png and im_#_1.png."""
    images: dict[str, list[Path]] = {}
    files = dict(held.files)
    for family, paths in held.images.items():
        whole = any(pairs_of(robot, paths) for robot in robots)
        parts = {} if whole else _parts_by_digit(family, paths)
        if not any(len(pairs_of(robot, part)) >= FEWEST for robot in robots for part in parts.values()):
            parts = {family: paths}
        images |= parts
        for name, part in parts.items():
            files |= {str(path.relative_to(held.root)): name for path in part if name != family}
    return replace(held, images=images, files=files)


def _parts_by_digit(family: str, paths: list[Path]) -> dict[str, list[Path]]:
    """Images of a family by a number in their names that has few values, with the same others beside each."""
    numbers = {path: re.findall(r"\d+", path.name) for path in paths}
    counts = {len(each) for each in numbers.values()}
    for column in range(max(counts)) if len(counts) == 1 else ():
        by_value = defaultdict[str, list[Path]](list)
        for path, each in numbers.items():
            by_value[each[column]].append(path)
        others = [
            {(path.parent, *numbers[path][:column], *numbers[path][column + 1 :]) for path in part}
            for part in by_value.values()
        ]
        if 1 < len(by_value) <= _MOST_CAMERAS and all(each == others[0] for each in others):
            folder, mark, name = family.rpartition("/")
            pieces = name.split("#")
            before, behind = "#".join(pieces[: column + 1]), "#".join(pieces[column + 1 :])
            return {f"{folder}{mark}{before}{value}{behind}": part for value, part in by_value.items()}
    return {}


def image_sets(held: Contents, robots: list[Table], told: str | None) -> list[ImageSet]:
    """The sets of images that go with tables of the robot's poses; those that programs made come last.

    `told`: the images that the user names. Raises ImportSourceError where none is named so.
    """
    meant = {} if boards_named(held, told) else _families(held, told)
    families = held.images | meant
    fits = {
        (family, robot.name): pairs
        for family, paths in families.items()
        for robot in robots
        if len(pairs := pairs_of(robot, paths)) >= FEWEST
    }
    own = _own(held, fits)
    sets = [
        ImageSet(
            family,
            [(robot, fits[family, robot.name]) for robot in robots if (family, robot.name) in own],
        )
        for family in meant
    ]
    return sorted((each for each in sets if each.rows), key=lambda each: (each.is_made, each.family))


def boards_named(held: Contents, told: str | None) -> list[Table]:
    """The tables of board poses that the user names instead of images; empty: none is named so."""
    if told is None:
        return []
    return [table for table in held.tables if table.whose != "robot" and table.name == told]


def pair_sets(robots: list[Table], boards: list[Table]) -> list[PairSet]:
    """The tables of the robot's and of the board's poses that go together."""
    fits = [
        (robot, board)
        for robot in robots
        for board in boards
        if board not in robots and len(pairs_of(robot, board)) >= FEWEST
    ]
    own = _sharing({(board.name, robot.name) for robot, board in fits})
    return [
        PairSet(robot, board, pairs_of(robot, board))
        for robot, board in fits
        if (board.name, robot.name) in own
    ]


def are_rivals(one: PairSet, other: PairSet) -> bool:
    """Tell whether two sets may be of two cameras: not the robot's poses told in two ways."""
    return one.board is not other.board


def are_sessions(one: PairSet, other: PairSet) -> bool:
    """Tell whether both tables of two sets differ by numbers only."""
    return all(
        mine is not theirs and _alike(mine.name) == _alike(theirs.name)
        for mine, theirs in ((one.robot, other.robot), (one.board, other.board))
    )


def pairs_of(table: Table, paths: list[Path] | Table) -> dict[Key, int]:
    """Image → row: by the names told beside the rows, by the numbers in both names, or by order.

    Row of a table of the board's poses → row of the robot's: by order.
    """
    if isinstance(paths, Table):
        return {row: row for row in range(len(paths.numbers)) if len(paths.numbers) == len(table.numbers)}
    by_name = _by_names(table.images, paths)
    if by_name:
        return by_name
    numbers = _numbers(paths)
    by_identity = _by_identities(table.images, numbers)
    if by_identity:
        return by_identity
    rows = _row_numbers(table)
    if "#" in table.name and len(set(numbers.values())) == len(paths) and set(numbers.values()) == set(rows):
        return {path: rows[number] for path, number in numbers.items()}
    ordered = sorted(paths, key=natural)
    if len(paths) == len(table.numbers):
        return {path: row for row, path in enumerate(ordered)}
    if "#" not in table.name:  # some images are gone, neither the first nor the last
        first, last = min(numbers.values(), default=0), max(numbers.values(), default=0)
        counted = first in (0, 1) and last - first + 1 == len(table.numbers)
        rows = {first + row: row for row in range(len(table.numbers))} if counted else {}
    shared: dict[Key, int] = {path: rows[number] for path, number in numbers.items() if number in rows}
    unique = len(rows) == len(table.numbers) and len(set(numbers.values())) == len(numbers)
    return shared if unique and len(shared) > _SHARED * max(len(rows), len(paths)) else {}


def same_pictures(paths: list[Path], others: list[Path]) -> bool:
    """Tell whether two families are copies of the same files."""
    if len(paths) != len(others):
        return False
    return all(_same_bytes(*both) for both in list(zip(paths, others, strict=True))[:_COMPARED])


def _same_bytes(path: Path, other: Path) -> bool:
    try:
        if path.stat().st_size != other.stat().st_size:
            return False
        return read_file(path, IMAGE_LIMIT_BYTES) == read_file(other, IMAGE_LIMIT_BYTES)
    except OSError:
        return False


def _families(held: Contents, told: str | None) -> dict[str, list[Path]]:
    """Images by family: those that the user names, by an existing folder or file, or by the family's name."""
    if told is None:
        return held.images
    places = [place for place in (Path(told), held.root / told) if place.exists()]
    for place in places:
        inside = {
            family: [path for path in paths if place in (path, *path.parents)]
            for family, paths in held.images.items()
        }
        if any(inside.values()):
            return {family: paths for family, paths in inside.items() if paths}
    pattern = told.replace("#", "[#]")
    for way in (pattern, f"*/{pattern}", f"*{pattern}"):
        named = {family: paths for family, paths in held.images.items() if fnmatchcase(family, way)}
        if named:
            return named
    there = ", ".join(f"{len(paths)} {family}" for family, paths in held.images.items())
    raise ImportSourceError("told-not-there", source=held.root, option="--images", told=told, there=there)


def _own(held: Contents, fits: dict[tuple[str, str], dict[Key, int]]) -> set[tuple[str, str]]:
    """The pairs of a family and a table that are not rather another family's, or another table's."""
    own = _sharing(set(fits))
    tables = {table.name: table for table in held.tables}
    paths = held.images
    by_table = defaultdict[str, list[str]](list)
    for family, name in own:
        by_table[name].append(family)
    for name, families in by_table.items():
        named = [image for image in tables[name].images if image]
        shares = {family: _shared_parts(named, paths[family]) for family in families}
        own -= {(family, name) for family in families if shares[family] < max(shares.values())}
    return own


def _shared_parts(names: list[str], paths: list[Path]) -> int:
    """Most folders and names that a told name shares with an image of a family, from its end."""
    if not names or not paths:
        return 0
    by_name = {path.name: path for path in paths}
    return max(_depth(name, by_name[last]) if (last := _parts(name)[-1]) in by_name else 0 for name in names)


def _sharing(pairs: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """The pairs (of a set of images or poses, of a table) that are not rather another's.

    Not a family's is a table in the folder of another session, and one of which a name says so, while another
    table's name says that it is the family's.
    """
    left = set(pairs)
    families = sorted({family for family, _ in pairs})
    for one, other in combinations(families, 2):
        ours, theirs = ({name for family, name in pairs if family == each} for each in (one, other))
        words, other_words = (set(_PARTS.findall(each.lower())) for each in (one, other))
        mine = {name for name in ours if _says(name, words - other_words, other_words - words)}
        others = {name for name in theirs if _says(name, other_words - words, words - other_words)}
        if mine and others:
            left -= {(one, name) for name in others} | {(other, name) for name in mine}
        if _alike(one) == _alike(other):
            for name in ours & theirs:
                near, far = (_common(name, each) for each in (one, other))
                if near != far:
                    left.discard((other if near > far else one, name))
    return left


def _says(name: str, own: set[str], foreign: set[str]) -> bool:
    words = set(_PARTS.findall(name.lower()))
    return bool(words & own) and not words & foreign


def _alike(family: str) -> str:
    return re.sub(r"\d+", "#", family)


def _common(name: str, family: str) -> int:
    """Folders that two files have in common, from the outermost."""
    parts = [PurePosixPath(each.split(" ")[0]).parent.parts for each in (name, family)]
    shared = 0
    for one, other in zip(*parts, strict=False):
        if one != other:
            break
        shared += 1
    return shared


def _by_names(names: list[str], paths: list[Path]) -> dict[Key, int]:
    """Image → the row that names it, by as many folders as the name tells; none where two rows do."""
    rows = defaultdict[str, list[int]](list)
    for row, name in enumerate(names):
        if name and not name.isdigit():
            last = _parts(name)[-1]
            rows[last].append(row)
    found: dict[Key, int] = {}
    stems = defaultdict[str, list[int]](list)
    for last, each in rows.items():
        stems[last.rpartition(".")[0] or last] += each
    has_names = any(path.name in rows for path in paths)
    for path in paths:
        told = rows.get(path.name, []) if has_names else stems.get(path.stem, [])
        depths = [_depth(names[row], path) for row in told]
        if depths and depths.count(max(depths)) == 1:
            found[path] = told[depths.index(max(depths))]
    return found


def _parts(name: str) -> list[str]:
    return [part for part in name.replace("\\", "/").split("/") if part] or [name]


def _depth(name: str, path: Path) -> int:
    """Folders and names, from the end, that a told name and a path share."""
    shared = 0
    for told, part in zip(reversed(_parts(name)), reversed(path.parts), strict=False):
        if told not in (part, path.stem):
            break
        shared += 1
    return shared


def _by_identities(names: list[str], numbers: dict[Path, int]) -> dict[Key, int]:
    """Image → the row of its number, where the rows tell all numbers of the images, each once."""
    rows = {int(name): row for row, name in enumerate(names) if name.isdigit() and len(name) < _LONGEST}
    complete = len(rows) == len(names) and len(set(numbers.values())) == len(numbers)
    return (
        {path: rows[number] for path, number in numbers.items()}
        if complete and (numbers and rows.keys() >= set(numbers.values()))
        else {}
    )


_LONGEST = 18
"""Digits of a running number."""


def _numbers(paths: list[Path]) -> dict[Path, int]:
    """Each image's running number: the last one of its name, or of its folder's where all names are alike."""
    for texts in ([path.stem for path in paths], *_folders(paths)):
        found = [re.findall(r"\d+", text) for text in texts]
        numbers = {path: int(each[-1][-_LONGEST:]) for path, each in zip(paths, found, strict=True) if each}
        if len(set(numbers.values())) > 1:
            return numbers
    return {}


def _folders(paths: list[Path]) -> Iterable[list[str]]:
    for level in range(2):
        if all(len(path.parents) > level for path in paths):
            yield [path.parents[level].name for path in paths]


def _row_numbers(table: Table) -> dict[int, int]:
    """Running number → row: the last number of the rows' places that tells all of them apart."""
    lengths = {len(place) for place in table.places}
    columns = range(-1, -min(lengths, default=0) - 1, -1) if len(lengths) == 1 else [-1]
    for column in columns:
        rows = {place[column]: row for row, place in enumerate(table.places) if place}
        if len(rows) == len(table.numbers):
            return rows
    return {}
