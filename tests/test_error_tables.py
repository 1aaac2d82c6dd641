"""Each error that a source makes by its code is in its package's `errors.toml`, with all its values."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from string import Formatter
from typing import NamedTuple

import pytest

from recordings.errors import CodedError, ErrorData, RecordingError, error_table

ROOT = Path(__file__).parents[1]
PACKAGES = ("recordings", "calibrate", "station")


class Site(NamedTuple):
    """A place that makes an error by a literal code."""

    where: str
    package: str
    code: str
    values: frozenset[str]
    is_open: bool
    """Further values come from a mapping (`**values`)."""


@cache
def trees() -> dict[Path, ast.Module]:
    found = (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py")))
    return {path: ast.parse(path.read_text()) for path in found}


@cache
def error_classes() -> dict[str, type[CodedError]]:
    """All classes of the family by their names; modules without one are not imported."""
    classes: dict[str, type[CodedError]] = {"CodedError": CodedError}
    grew = True
    while grew:
        grew = False
        for path, tree in trees().items():
            for node in tree.body:
                if isinstance(node, ast.ClassDef) and node.name not in classes:
                    bases = {base.id for base in node.bases if isinstance(base, ast.Name)}
                    if bases & classes.keys():
                        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
                        classes[node.name] = getattr(import_module(module), node.name)
                        grew = True
    return classes


def literals(node: ast.expr) -> Iterator[str]:
    """Constants that an expression may be: itself, or one of two by a condition."""
    match node:
        case ast.Constant(value=str(text)):
            yield text
        case ast.IfExp(body=body, orelse=other):
            yield from literals(body)
            yield from literals(other)


def sites() -> Iterator[Site]:
    for path, tree in trees().items():
        for node in ast.walk(tree):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
                continue
            kind = error_classes().get(node.func.id)
            named = {word.arg for word in node.keywords}
            if kind is None:
                continue
            for code in literals(node.args[0]) if node.args else [kind.code]:
                where = f"{path.relative_to(ROOT)}:{node.lineno}"
                values = frozenset(filter(None, named))
                yield Site(where, kind.package, code, values, None in named)


def needed(entry: dict[str, str]) -> set[str]:
    """Names of the values that an entry of a table shows or promises."""
    sentences = entry["text"] + entry.get("remedy", "")
    return {name for _, name, _, _ in Formatter().parse(sentences) if name is not None} | {
        *entry.get("values", [])
    }


def test_every_code_is_in_its_table_and_gets_its_values() -> None:
    wrong = []
    for site in sites():
        entry = error_table(site.package).get(site.code)
        if entry is None:
            wrong.append(f"{site.where}: {site.code} is not in {site.package}/errors.toml")
        elif (missing := needed(entry) - site.values) and not site.is_open:
            wrong.append(f"{site.where}: {site.code} lacks {', '.join(sorted(missing))}")
    assert not wrong


@pytest.mark.parametrize("package", PACKAGES)
def test_every_entry_is_used_and_has_only_what_is_known(package: str) -> None:
    said = {
        node.value
        for tree in trees().values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    table = error_table(package)
    assert not table.keys() - said
    assert all(re.fullmatch("[a-z0-9]+(-[a-z0-9]+)*", code) for code in table)
    assert not {"failed", "recording", "calibration", "station"} & table.keys()
    assert all({"text"} <= entry.keys() <= {"text", "remedy", "values"} for entry in table.values())


class WordedError(CodedError):
    package = "worded"


@pytest.mark.parametrize(
    ("template", "values", "text"),
    [
        ("{path} is full", {"path": Path("a/{b}")}, "a/{b} is full"),
        (
            "turned {turn_rad:.1f°}, moved {way_m:.2f mm}",
            {"turn_rad": 0.1, "way_m": 0.0012},
            "turned 5.7°, moved 1.20 mm",
        ),
        ("holds {size_bytes:bytes}", {"size_bytes": 3 << 20}, "holds 3 MB"),
        ("{absent:.1f mm} away", {}, "{absent} away"),
        ("{way_m:.1f mm} away", {"way_m": None}, "None away"),
        ("{way_m:no} away", {"way_m": 2.5}, "2.5 away"),
        ("{path.parent} is full", {"path": "a"}, "{path.parent} is full"),
        ("a brace } too many", {}, "a brace } too many"),
    ],
)
def test_a_wrong_template_never_hides_the_error(
    template: str, values: dict[str, float], text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recordings.errors.error_table", lambda _: {"full": {"text": template}})
    assert str(WordedError("full", **values)) == text


def test_an_error_without_a_table_or_entry_tells_its_code_and_values() -> None:
    assert str(WordedError("disk-full", free_bytes=3)) == "disk-full, free_bytes 3"
    assert RecordingError("none-such", at=2).code == "none-such"


def test_an_error_made_again_keeps_the_words_of_the_other_process() -> None:
    data = ErrorData("exists", "It is there.", "Move it.", {"path": "a"})
    assert RecordingError.from_data(data).data == data
