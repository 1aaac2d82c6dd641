"""YAML that means what it says: files written by people, read into strict types, all problems at once.

YAML 1.1 as PyYAML reads it surprises: `no` is false, `010` is 8, `12:30:45` is a number, `1e-3` is text,
the last of two equal keys wins, and ten lines of aliases can expand to gigabytes. Here only true and false
are booleans, numbers are decimal, and aliases, tags and duplicate keys are errors.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from itertools import islice
from types import UnionType
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from recordings.plain_text import ORDERS

if TYPE_CHECKING:  # `load_plain` does without, and so do programs that only use a camera
    import msgspec

LIMIT_BYTES = 256 * 1024
_NEST_LIMIT = 20
_BY_PEOPLE_LIMIT, _BY_PROGRAMS_LIMIT = 40_000, 150_000
"""Values and brackets, a second's work or less; a plan of 200 poses has 10,000."""
_PROBLEMS_TOLD = 100
T = TypeVar("T")


@dataclass(frozen=True)
class YamlProblem:
    line: int
    """From 1; 0 = the whole file."""
    where: str
    """'limits.speed_m_s'"""
    text: str
    remedy: str = ""
    harmless: bool = False
    """The file is read all the same."""

    def __str__(self) -> str:
        place = f"line {self.line}: " if self.line else ""
        said = f"{place}{self.where + ': ' if self.where else ''}{self.text}"
        return f"{said.rstrip('.')}. {self.remedy}" if self.remedy else said


class StrictYamlError(ValueError):
    """Everything that is wrong with one file."""

    def __init__(self, problems: list[YamlProblem]) -> None:
        super().__init__("\n".join(map(str, problems)))
        self.problems = problems


class _Loader(yaml.CSafeLoader):  # type: ignore[misc]  # yaml has no types
    """Plain data of the YAML 1.2 core schema, numbers decimal only."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012


_WHOLE = r"[-+]?(0|[1-9][0-9]*)"
"""No leading zero: a serial number 0128 is text, as it is to the YAML 1.1 that Python's programs write. With
a point it is a number: 0012.5."""
_SCALARS = (
    ("null", r"~|null|Null|NULL|"),
    ("bool", r"true|True|TRUE|false|False|FALSE"),
    ("int", _WHOLE),
    ("float", rf"({_WHOLE}|[-+]?([0-9]+\.[0-9]*|\.[0-9]+))([eE][-+]?[0-9]+)?|(?i:[-+]?\.inf|\.nan)"),
)
for _tag, _pattern in _SCALARS:
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), None)
_Loader.add_constructor(
    "tag:yaml.org,2002:float",
    lambda _, node: float(node.value.lower().replace(".inf", "inf").replace(".nan", "nan")),
)


class Dumper(yaml.CSafeDumper):  # type: ignore[misc]  # yaml has no types
    """For `yaml.dump`: quotes texts that are numbers to the readers here, but not to PyYAML, such as 12e4."""


for _tag, _pattern in _SCALARS:
    Dumper.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), None)


def _refuse_traps(content: bytes, limit: int) -> None:
    """Raise MarkedYAMLError for what expands, runs code, takes minutes or the stack (200 kB of brackets)."""
    depth = 0
    for count, event in enumerate(yaml.parse(content, yaml.CSafeLoader)):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        for wrong, problem in (
            (depth > _NEST_LIMIT, "nested too deeply"),
            (count > limit, f"more than {limit} values"),
            (getattr(event, "anchor", None), "anchors (&) and aliases (*) are refused"),
            (getattr(event, "tag", None), "tags (!) are refused"),
            (ORDERS.search(getattr(event, "value", "")), "control characters are refused"),
        ):
            if wrong:
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)


def _no_yaml(error: Exception) -> StrictYamlError:
    if isinstance(error, yaml.MarkedYAMLError):
        line = error.problem_mark.line + 1 if error.problem_mark else 0
        return StrictYamlError([YamlProblem(line, "", str(error.problem))])
    return StrictYamlError([YamlProblem(0, "", f"not YAML ({' '.join(str(error).split())})")])


def load_plain(content: bytes) -> Any:
    """Plain data of a file that a program wrote. Raises StrictYamlError."""
    try:
        _refuse_traps(content, _BY_PROGRAMS_LIMIT)
        return yaml.load(content, _Loader)
    except (yaml.YAMLError, UnicodeDecodeError, ValueError) as error:
        raise _no_yaml(error) from None


@dataclass(frozen=True)
class Loaded(Generic[T]):
    """A file's content, and what its reader may say of it."""

    value: T
    lines: dict[str, int]
    """'limits.speed_m_s' to its line"""
    ignored: list[YamlProblem]
    """Keys of earlier releases that are without effect."""


def load(content: bytes, kind: type[T], under: str = "") -> T:
    """The file's content as `kind`; see `read`."""
    return read(content, kind, under).value


def read(content: bytes, kind: type[T], under: str = "") -> Loaded[T]:
    """Read the content as `kind`, a msgspec struct. Raises StrictYamlError with all problems and lines.

    A struct's `GONE` names keys of earlier releases, which are ignored. `under`: where the file has this key,
    only what stands below it is read.
    """
    import msgspec

    if len(content) > LIMIT_BYTES:
        raise StrictYamlError([YamlProblem(0, "", f"larger than {LIMIT_BYTES // 1024} kB")])
    try:
        _refuse_traps(content, _BY_PEOPLE_LIMIT)
        loader = _Loader(content)
        node, where = _below(loader.get_single_node(), under)
        if node is None:
            raise StrictYamlError([YamlProblem(0, "", "the file is empty")])
        problems = list(islice(_problems(node, kind, where), _PROBLEMS_TOLD))
        if wrong := [problem for problem in problems if not problem.harmless]:
            raise StrictYamlError(wrong)
        value = msgspec.convert(loader.construct_document(node), kind)
        return Loaded(value, dict(_lines(node, where)), problems)
    except StrictYamlError:
        raise
    except (yaml.YAMLError, UnicodeDecodeError, ValueError, OverflowError) as error:
        raise _no_yaml(error) from None


def _lines(node: yaml.Node, where: str) -> Iterator[tuple[str, int]]:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            inside = f"{where}.{key.value}" if where else str(key.value)
            yield inside, key.start_mark.line + 1
            yield from _lines(value, inside)
    elif isinstance(node, yaml.SequenceNode):
        for i, child in enumerate(node.value):
            yield f"{where}[{i}]", child.start_mark.line + 1
            yield from _lines(child, f"{where}[{i}]")


def _below(root: yaml.Node | None, key: str) -> tuple[yaml.Node | None, str]:
    """(the value of `key` in the file's mapping, `key`); the file itself where it has none."""
    values = root.value if isinstance(root, yaml.MappingNode) else []
    return next(((value, key) for name, value in values if name.value == key), (root, ""))


def _problems(node: yaml.Node, kind: Any, where: str) -> Iterator[YamlProblem]:
    """Walks the tree beside the type, so that one report names every wrong key and value."""
    import msgspec

    options = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    structs = [k for k in options if isinstance(k, type) and issubclass(k, msgspec.Struct)]
    if structs and isinstance(node, yaml.MappingNode):
        yield from _struct_problems(node, structs[0], where)
        return
    if isinstance(node, yaml.SequenceNode):
        for items in (get_args(k) for k in options if get_origin(k) in (tuple, list)):
            if len(items) == 1 or items[-1] is Ellipsis:
                items = items[:1] * len(node.value)
            if len(items) == len(node.value):
                for i, (child, item) in enumerate(zip(node.value, items, strict=True)):
                    yield from _problems(child, item, f"{where}[{i}]")
                return
    line, value = node.start_mark.line + 1, _Loader("").construct_object(node, deep=True)
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        found = f" (found {node.value[:40]!r})" if isinstance(node, yaml.ScalarNode) else ""
        words = [str(word) for option in options for word in _words(option)]
        said = f"must be one of {', '.join(words)}" if words else str(error)
        if structs:
            said = "fields are needed here, each as key: value"
        yield YamlProblem(line, where, said + found)
    else:
        if isinstance(value, float) and not math.isfinite(value):
            yield YamlProblem(line, where, "is not a finite number")


def _struct_problems(node: yaml.MappingNode, kind: type[msgspec.Struct], where: str) -> Iterator[YamlProblem]:
    from msgspec.structs import fields as fields_of

    hints = get_type_hints(kind, include_extras=True)  # with the limits of numbers
    fields = {f.encode_name: f for f in fields_of(kind)}
    seen: set[str] = set()
    for key, value in list(node.value):
        name, line = str(key.value), key.start_mark.line + 1
        inside = f"{where}.{name}" if where else name
        if name in seen:
            yield YamlProblem(line, inside, "stands here twice")
        elif name in getattr(kind, "GONE", ()):
            yield YamlProblem(line, inside, "has no effect any more", "Delete it.", harmless=True)
            node.value.remove((key, value))
        elif name not in fields:
            import difflib

            near = difflib.get_close_matches(name, fields, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"known here: {', '.join(fields)}"
            yield YamlProblem(line, inside, f"unknown key; {hint}")
        else:
            yield from _problems(value, hints[fields[name].name], inside)
        seen.add(name)
    for name, field in fields.items():
        if field.required and name not in seen:
            yield YamlProblem(node.start_mark.line + 1, f"{where}.{name}" if where else name, "is missing")


def _words(kind: Any) -> tuple[Any, ...]:
    """Return the values of a Literal or an Enum; of other types none."""
    if get_origin(kind) is Literal:
        return get_args(kind)
    return tuple(k.value for k in kind) if isinstance(kind, type) and issubclass(kind, Enum) else ()
