"""Commands that errors and screens suggest are taken by the parser as they are printed."""

from __future__ import annotations

import ast
import re
import shlex
from collections.abc import Iterator

import typer

from recordings.errors import error_table
from tests.test_error_tables import ROOT, trees
from tests.test_examples import PROGRAMS

_COMMAND = re.compile(r"`((?:station|calibrate|recordings)(?: [^`]*)?)`")


def suggested() -> Iterator[tuple[str, str]]:
    """(where, command) of every quoted command in a text that is no docstring; what is filled in reads X."""
    for path, tree in trees().items():
        docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        inside = {
            id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values
        }
        for node in ast.walk(tree):
            if id(node) in docs or id(node) in inside:
                continue
            if isinstance(node, ast.JoinedStr):
                text = "".join(
                    str(part.value) if isinstance(part, ast.Constant) else "X" for part in node.values
                )
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                text = node.value
            else:
                continue
            for command in _COMMAND.findall(text):
                yield f"{path.relative_to(ROOT)}:{node.lineno}", command
    for package in PROGRAMS:
        for code, entry in error_table(package).items():
            for command in _COMMAND.findall(re.sub("{.*?}", "X", f"{entry['text']} {entry.get('remedy')}")):
                yield f"{package}/errors.toml [{code}]", command


def missing_options(command: str) -> list[str]:
    """Options that the program does not take. Raises a usage error where it has no such command."""
    program, *words = shlex.split(command.replace("…", "X"), comments=True)
    group = PROGRAMS[program]
    named = next((word for word in words if not word.startswith("-")), None)
    if named is None or named in ("X", "--X"):
        return []
    _, found, _ = group.resolve_command(typer.Context(group), [named])
    options = {name for param in found.params for name in (*param.opts, *param.secondary_opts)}
    return [w for w in words if w.startswith("--") and w.partition("=")[0] not in options]


def test_every_suggested_command_exists_with_its_options() -> None:
    commands = sorted(set(suggested()))  # here, not as parameters: each worker would read all sources
    assert len(commands) > 30
    missing = {command: (where, missing_options(command)) for where, command in commands}
    assert not {command: found for command, found in missing.items() if found[1]}
