"""Holds the project to `budget.toml` (`make check`); `--write` lowers its numbers, and raises none."""

from __future__ import annotations

import ast
import importlib
import io
import sys
import tokenize
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import msgspec

ROOT = Path(__file__).parents[1]
PACKAGES = ("recordings", "calibrate", "station", "tests", "benchmarks")
_LAYOUT = {tokenize.NL, tokenize.NEWLINE, tokenize.COMMENT, tokenize.INDENT, tokenize.DEDENT}
_HEAD = """\
# What the project may hold; `make check` fails above it. After a deletion: make budget.
# To raise a number, lower another one in the same commit, or first have an issue of this project agree to the
# rise: it says which number, from what to what, and why. Then write the new number here by hand.
"""


def code_lines(source: str) -> int:
    """Count lines of code: without blank lines, comments and docstrings (of fields, too)."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _LAYOUT and token.string:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Expr(value=ast.Constant(value=str()), lineno=first, end_lineno=last):
                lines.difference_update(range(first, (last or first) + 1))
    return len(lines)


def numbers() -> dict[str, dict[str, int]]:
    """Count what the budget limits, as it is today."""
    return {
        "code_lines": {
            package: sum(code_lines(path.read_text()) for path in sorted((ROOT / package).rglob("*.py")))
            for package in PACKAGES
        },
        "count": {
            "commands": sum(_commands()),
            "verbs": len(_loaded("station.protocol.verbs", "VERBS")),
            "configuration_keys": len(set(_keys(_loaded("station.cell.config", "StationConfig")))),
            "drivers": len(set(_drivers())),
            "exports": len(_loaded("calibrate.files.exports", "FORMATS")),
            "solver_constants": sum(map(_constants, sorted((ROOT / "calibrate/handeye").rglob("*.py")))),
        },
    }


def over(allowed: dict[str, dict[str, int]], found: dict[str, dict[str, int]]) -> dict[str, int]:
    """Give what exceeds its limit, and by how much."""
    return {
        f"{part}.{name}": number - allowed[part].get(name, 0)
        for part, counted in found.items()
        for name, number in counted.items()
        if number > allowed[part].get(name, 0)
    }


def _loaded(module: str, name: str) -> Any:
    return getattr(importlib.import_module(module), name)


def _commands() -> Iterator[int]:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    for program in scripts:
        grouped = (ROOT / program / "cli/app.py").is_file()
        yield len(_loaded(f"{program}.cli.app", program.upper()).commands) if grouped else 1


def _keys(struct: type[msgspec.Struct]) -> Iterator[tuple[type, str]]:
    """Keys of a section and of the sections in it; one in several places counts once."""
    kinds = get_type_hints(struct)
    for name in struct.__struct_fields__:
        yield struct, name
        for part in _parts(kinds[name]):
            if isinstance(part, type) and issubclass(part, msgspec.Struct):
                yield from _keys(part)


def _parts(kind: Any) -> Iterator[Any]:
    yield kind
    for part in get_args(kind):
        yield from _parts(part)


def _drivers() -> Iterator[str]:
    """Drivers of cameras and of the robot, by their names in a configuration."""
    for section, key in (("CameraConfig", "driver"), ("RobotConfig", "control")):
        for part in _parts(get_type_hints(_loaded("station.cell.config", section))[key]):
            if isinstance(part, str):
                yield part


def _constants(path: Path) -> int:
    """Count a module's constants that are made of numbers."""
    return sum(
        isinstance(target, ast.Name)
        and target.id.isupper()
        and any(
            isinstance(part, ast.Constant) and isinstance(part.value, (int, float))
            for part in ast.walk(value)
        )
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.Assign)
        for target, value in [(node.targets[0], node.value)]
    )


def lowered(allowed: dict[str, dict[str, int]], found: dict[str, dict[str, int]]) -> str:
    """Make the text of a budget that nothing in `allowed` is above."""
    text = _HEAD
    for part, counted in found.items():
        text += f"\n[{part}]\n"
        for name, number in counted.items():
            text += f"{name} = {min(number, allowed.get(part, {}).get(name, number))}\n"
    return text


def main() -> int:
    path = ROOT / "budget.toml"
    allowed, found = tomllib.loads(path.read_text()), numbers()
    if "--write" in sys.argv:
        path.write_text(lowered(allowed, found))
    excess = over(allowed, found)
    for name, number in excess.items():
        print(f"{name}: {number} above budget.toml")
    return bool(excess)


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main())
