"""A package's public names: written once, as its imports for type checkers, and loaded at their first use."""

from __future__ import annotations

import ast
from collections.abc import Callable
from importlib import import_module
from pathlib import Path


def open_door(package: str, source: str) -> tuple[Callable[[str], object], list[str]]:
    """Make `__getattr__` and `__all__` of the imports `NAME as NAME` in `source`, the file of the package."""
    homes = {
        name.name: str(node.module)
        for node in ast.walk(ast.parse(Path(source).read_bytes()))
        if isinstance(node, ast.ImportFrom)
        for name in node.names
        if name.asname == name.name
    }

    def load(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(homes[name]), name)

    return load, sorted(homes)
