"""No program loads what it does not use, and every import contract breaks when it is broken."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import grimp
import pytest

from tests.test_error_tables import ROOT, trees

HEAVY = ("numpy", "cv2", "matplotlib", "google", "mcap_protobuf", "scipy", "rosbags")
SCREEN = ("numpy", "scipy", "cv2", "textual", "calibrate")
HARDWARE = ("textual", "serial", "rtde_control", "gi")
NOT_LOADED = {
    "import recordings.cli.app, calibrate, calibrate.handeye": HEAVY,
    "import calibrate.pipeline.job, calibrate.cli.importing, recordings.cli.commands": (*HARDWARE, "station"),
    "import station.daemon": ("scipy", "matplotlib", "textual"),
    "import station.tui.app": ("scipy", "matplotlib", "station.session"),
    "calibrate --help": HEAVY,
    "station --help": (*SCREEN, "station.operate", "asyncio"),
    "station status --help": (*SCREEN, "station.simulation", "station.plan"),
    "station capture --help": (*HARDWARE, "station.simulation", "station.session"),
    "station stop --socket /nowhere/s": (
        *("asyncio", "typer", "rich", "msgspec", "numpy", "json", "logging", "subprocess"),
    ),
}
"""What each program can do without: stopping the arm needs 0.03 s of processor time, all of it 0.29 s."""


@pytest.mark.parametrize("program", NOT_LOADED)
def test_what_is_not_used_is_not_loaded(program: str) -> None:
    name, code = program.split()[0], program
    if name != "import":
        code = f"import contextlib, sys\nfrom {name}.cli import main\nsys.argv = {program.split()}\n"
        code += "with contextlib.suppress(SystemExit): main()"
    code += f"\nimport sys; print([name for name in {NOT_LOADED[program]} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


PLANTS = [
    ("recordings/mcap", "calibrate.views.view_set"),
    ("recordings/mcap", "recordings.reader"),
    ("recordings/schema", "rosbags"),
    ("calibrate/files", "station.cell"),
    ("calibrate/handeye", "calibrate.files"),
    ("calibrate/boards", "calibrate.pipeline.job"),
    ("calibrate/check", "serial"),
    ("calibrate/check", "mcap"),
    ("station/analysis", "textual"),
    ("station/cell", "station.protocol"),
    ("station/devices", "station.plan"),
    ("station/devices", "station.devices.ur.robot"),
    ("station/devices/ur", "station.session"),  # and it has no floor
    ("station/operate", "station.session"),
    ("station/session", "serial"),
    ("station/session", "station.protocol.client"),
    ("station/session", "station.devices.ur"),
    ("station/server", "rtde_control"),
    ("station/simulation", "station.session"),
    ("station/simulation/controller", "station.devices.ur"),
    ("station/tui", "station.devices"),
    ("station/tui", "calibrate.files.versions"),
    ("station/cli", "gi"),
]
"""A room, and an import that is forbidden in it."""


def test_every_contract_breaks_where_a_forbidden_import_is_planted(tmp_path: Path) -> None:
    """In a copy in which every plant grows."""
    for package in ("recordings", "calibrate", "station"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("*.mcap"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for number, (room, module) in enumerate(PLANTS):
        (tmp_path / room / f"planted_{number}.py").write_text(f"import {module}\n")
    linter = Path(sys.executable).parent / "lint-imports"
    done = subprocess.run([linter, "--no-cache"], cwd=tmp_path, capture_output=True, text=True)
    contracts = (ROOT / "pyproject.toml").read_text().count("importlinter.contracts")
    assert f"Contracts: 0 kept, {contracts} broken" in done.stdout, done.stderr
    for number, (room, module) in enumerate(PLANTS):
        importer = f"{room.replace('/', '.')}.planted_{number}"
        assert re.search(rf"{re.escape(importer)} -> {re.escape(module)}\b", done.stdout), (room, module)


def test_imports_make_no_circle() -> None:
    """Imports for types and inside functions count, too."""
    graph = grimp.build_graph("recordings", "calibrate", "station", cache_dir=None)
    imported = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    TopologicalSorter(imported).prepare()  # CycleError names a circle


READ_DIRECTLY = {
    "recordings/files.py",  # the one function
    "recordings/errors.py", "calibrate/words.py",  # tables of the packages
    "recordings/importers/trees.py",  # an array of bytes that are read already
    "calibrate/pipeline/document.py",  # our own source
    "station/protocol/stop_client.py",  # the page, by a program that loads little
    # the kernel's files
    "station/cell/process.py", "station/server/approval.py", "station/server/control_group.py",
    "station/devices/discovery.py",
    "station/devices/aravis_device.py", "station/devices/posted.py",
    # files of the package
    "station/cli/requests.py", "station/simulation/controller/kinematics.py", "calibrate/report/html.py",
    "station/tui/live_page.py",
    "station/simulation/controller/__main__.py",  # stands alone
}  # fmt: skip
_READERS = {"read_text", "read_bytes", "imread", "memmap", "loadtxt", "genfromtxt", "fromfile"}


def test_files_of_people_are_opened_by_one_function() -> None:
    """`recordings.files.open_regular` opens at once, or not at all; anything else may wait for ever."""
    found = set()
    for path, tree in trees().items():
        for node in ast.walk(tree):
            if not isinstance(node, ast.Call):
                continue
            match node.func:
                case ast.Name("open") | ast.Attribute(ast.Name("np"), "load"):
                    found.add(path)
                case ast.Attribute(_, name) if name in _READERS:
                    found.add(path)
                case ast.Attribute(_, "open") if _is_mode(node.args[:1]):
                    found.add(path)
    assert {path.relative_to(ROOT).as_posix() for path in found} <= READ_DIRECTLY


def _is_mode(arguments: list[ast.expr]) -> bool:
    """`Path.open` for reading or appending; writers make a new file first."""
    match arguments:
        case [ast.Constant(str(mode))]:
            return set(mode) <= set("rab+t")
    return False
