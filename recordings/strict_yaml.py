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
from functools import cache
from itertools import islice
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from recordings.plain_text import ORDERS

if TYPE_CHECKING:  # `load_plain` does without, and so do programs that only use a camera
    import msgspec

LIMIT_BYTES = 256 * 1024
_NEST_LIMIT = 20
_NODE_LIMIT, _PLAIN_EVENT_LIMIT = 30_000, 150_000
"""A second's work, or less; a plan of 200 poses has 8000 nodes."""
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


@cache
def _loader() -> Any:
    """Loader of plain data of the YAML 1.2 core schema. Made at its first use: `load_plain` needs none."""

    class Loader(yaml.SafeLoader):  # type: ignore[misc]  # yaml has no types
        yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012
        depth = nodes = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            mark = self.peek_event().start_mark
            if self.check_event(yaml.AliasEvent) or getattr(self.peek_event(), "anchor", None):
                raise yaml.MarkedYAMLError(
                    problem="anchors (&) and aliases (*) are refused", problem_mark=mark
                )
            if getattr(self.peek_event(), "tag", None):
                raise yaml.MarkedYAMLError(problem="tags (!) are refused", problem_mark=mark)
            _refuse_orders(self.peek_event())
            self.depth += 1
            self.nodes += 1
            if self.nodes > _NODE_LIMIT:
                raise yaml.MarkedYAMLError(problem=f"more than {_NODE_LIMIT} values", problem_mark=mark)
            if self.depth > _NEST_LIMIT:
                raise yaml.MarkedYAMLError(problem="nested too deeply", problem_mark=mark)
            node = super().compose_node(parent, index)
            self.depth -= 1
            return node

    for tag, pattern, first in (
        ("null", r"~|null|", "~n"),
        ("bool", r"true|false", "tf"),
        ("int", r"[-+]?(0|[1-9][0-9]*)", "-+0123456789"),
        ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan", "-+.0123456789"),
    ):
        Loader.add_implicit_resolver(f"tag:yaml.org,2002:{tag}", re.compile(f"^(?:{pattern})$"), list(first))
    Loader.add_implicit_resolver("tag:yaml.org,2002:null", re.compile("^$"), [""])
    Loader.add_constructor("tag:yaml.org,2002:float", lambda _, node: _float(node.value))
    return Loader


def _refuse_orders(event: Any) -> None:
    if isinstance(event, yaml.ScalarEvent) and ORDERS.search(event.value):
        raise yaml.MarkedYAMLError(problem="control characters are refused", problem_mark=event.start_mark)


def load_plain(content: bytes) -> Any:
    """Plain data of a file that a program wrote, bounded in depth and so in time.

    libyaml itself knows no bound: 200 kB of brackets take minutes, or the stack. Raises StrictYamlError.
    """
    depth = 0
    try:
        for count, event in enumerate(yaml.parse(content, yaml.CSafeLoader)):
            if count > _PLAIN_EVENT_LIMIT:
                text = f"more than {_PLAIN_EVENT_LIMIT} values"
                raise yaml.MarkedYAMLError(problem=text, problem_mark=event.start_mark)
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _NEST_LIMIT:
                raise yaml.MarkedYAMLError(problem="nested too deeply", problem_mark=event.start_mark)
            if isinstance(event, yaml.AliasEvent):
                raise yaml.MarkedYAMLError(problem="aliases (*) are refused", problem_mark=event.start_mark)
            _refuse_orders(event)
        return yaml.load(content, yaml.CSafeLoader)
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError) as error:
        raise StrictYamlError([YamlProblem(0, "", f"not YAML ({' '.join(str(error).split())})")]) from None


def _float(text: str) -> float:
    return float(text.replace(".inf", "inf").replace(".nan", "nan"))


@dataclass(frozen=True)
class Loaded(Generic[T]):
    """A file's content, and what its reader may say of it."""

    value: T
    lines: dict[str, int]
    """'limits.speed_m_s' to its line"""
    ignored: list[YamlProblem]
    """Keys of earlier releases that are without effect."""


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
        loader = _loader()(content)
        node, where = _below(loader.get_single_node(), under)
        problems = (
            list(islice(_problems(node, kind, where), _PROBLEMS_TOLD))
            if node
            else [YamlProblem(0, "", "the file is empty")]
        )
        if wrong := [problem for problem in problems if not problem.harmless]:
            raise StrictYamlError(wrong)
        lines = dict(_lines(node, where))
        plain = loader.construct_document(node)
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 0
        raise StrictYamlError([YamlProblem(line, "", str(error.problem))]) from None
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError, ValueError, OverflowError) as error:
        if isinstance(error, StrictYamlError):
            raise
        raise StrictYamlError([YamlProblem(0, "", f"not YAML: {' '.join(str(error).split())}")]) from None
    try:
        return Loaded(msgspec.convert(plain, kind), lines, problems)
    except msgspec.ValidationError as error:
        raise StrictYamlError([YamlProblem(0, "", str(error))]) from None


def _below(root: yaml.Node | None, key: str) -> tuple[yaml.Node | None, str]:
    """(the value of `key` in the file's mapping, `key`); the file itself where it has none."""
    if key and isinstance(root, yaml.MappingNode):
        for name, value in root.value:
            if name.value == key:
                return value, key
    return root, ""


def _problems(node: yaml.Node, kind: Any, where: str) -> Iterator[YamlProblem]:
    """Walks the tree beside the type, so that one report names every wrong key and value."""
    import msgspec

    line = node.start_mark.line + 1
    options = [k for k in _options(kind) if k is not NoneType]
    if node.tag.endswith(":null") and len(options) < len(_options(kind)):
        return
    structs = [k for k in options if isinstance(k, type) and issubclass(k, msgspec.Struct)]
    if structs and isinstance(node, yaml.MappingNode):
        yield from _struct_problems(node, structs[0], where)
    elif (
        isinstance(node, yaml.SequenceNode) and len(options) == 1 and get_origin(options[0]) in (tuple, list)
    ):
        item = get_args(options[0])
        if len(item) == 1 or item[-1] is Ellipsis:
            for i, child in enumerate(node.value):
                yield from _problems(child, item[0], f"{where}[{i}]")
        elif len(node.value) != len(item):
            yield YamlProblem(line, where, f"{len(item)} values are needed, {len(node.value)} are here")
        else:
            for i, (child, child_kind) in enumerate(zip(node.value, item, strict=True)):
                yield from _problems(child, child_kind, f"{where}[{i}]")
    else:
        yield from _leaf_problems(node, kind, where)


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


def _leaf_problems(node: yaml.Node, kind: Any, where: str) -> Iterator[YamlProblem]:
    import msgspec

    line = node.start_mark.line + 1
    loader = _loader()("")
    value = loader.construct_object(node, deep=True)
    try:
        msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        found = f" (found {node.value[:40]!r})" if isinstance(node, yaml.ScalarNode) else ""
        words = [str(word) for option in _options(kind) for word in _words(option)]
        said = f"must be one of {', '.join(words)}" if words else str(error)
        if any(isinstance(option, type) and issubclass(option, msgspec.Struct) for option in _options(kind)):
            said = "fields are needed here, each as key: value"
        yield YamlProblem(line, where, said + found)
        return
    if isinstance(value, float) and not math.isfinite(value):
        yield YamlProblem(line, where, "is not a finite number")


def _words(kind: Any) -> tuple[Any, ...]:
    """Return the values of a Literal or an Enum; of other types none."""
    if get_origin(kind) is Literal:
        return get_args(kind)
    return tuple(k.value for k in kind) if isinstance(kind, type) and issubclass(kind, Enum) else ()


def _options(kind: Any) -> tuple[Any, ...]:
    return get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
