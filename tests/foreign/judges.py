"""Programs of other people that read MCAP and say what is wrong with it. `make foreign` installs them.

Each judge takes a path and returns its findings; none means that it is content. A judge that is not installed
skips its tests and says so.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(os.environ.get("STATION_FOREIGN", Path(__file__).parents[2] / ".foreign"))
_TIMEOUT_S = 120
Judge = Callable[[Path], list[str]]


def missing(program: str) -> None:
    pytest.skip(f"the judge '{program}' is missing: run `make foreign`")


def library(module: str, program: str) -> Any:
    """A Python module of somebody else's; skips where it is not installed."""
    if (folder := str(FOLDER / "python")) not in sys.path:
        sys.path.append(folder)  # for good: some load their parts when they need them
    try:
        return import_module(module)
    except ImportError:
        missing(program)


def mcap_core(path: Path) -> list[str]:
    """The TypeScript library that Foxglove and Lichtblick read with."""
    modules = FOLDER / "node" / "node_modules"
    node = shutil.which("node")
    if node is None or not (modules / "@mcap" / "core").is_dir():
        missing("@mcap/core")
    done = subprocess.run(
        [str(node), str(Path(__file__).with_name("mcap_core.cjs")), str(path)],
        env={**os.environ, "NODE_PATH": str(modules)}, capture_output=True, text=True, timeout=_TIMEOUT_S,
    )  # fmt: skip
    if done.returncode:
        return [done.stderr[-500:]]
    said = json.loads(done.stdout)
    backwards = [f"log order goes backwards {said['backwards']} times"] if said["backwards"] else []
    return [*said["findings"], *backwards]


def rerun(*arguments: str) -> str:
    """What the viewer's command line says, and in a last line how it ended."""
    program = FOLDER / "python" / "rerun_cli" / "rerun"
    if not program.is_file():
        missing("rerun")
    done = subprocess.run([str(program), *arguments], capture_output=True, text=True, timeout=_TIMEOUT_S)
    return f"{done.stdout}{done.stderr}\nexit {done.returncode}"


def rerun_check(path: Path) -> list[str]:
    """`rerun mcap check`: decodes everything, and every chunk of a topic must follow the one before."""
    lines = rerun("mcap", "check", "--full", str(path)).splitlines()
    rows = [line for line in lines if re.match(r"\w+\s+\d+\s+\d+\s+/", line)]
    bad = [line for line in rows if not line.startswith("ok")]
    if lines[-1] != "exit 0" or not rows:
        bad += lines[-5:]
    return bad


JUDGES: dict[str, Judge] = {"@mcap/core": mcap_core, "rerun": rerun_check}
