"""The package as pip installs it: a complete sdist, and a wheel whose offline work runs."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def tracked() -> list[str]:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("no git checkout: nothing says which files belong to the project")
    return listed.stdout.splitlines()


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory, tracked: list[str]) -> Path:
    """The folder with the sdist and the wheel that was built from the sdist."""
    source = tmp_path_factory.mktemp("source")
    for name in tracked:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, source / name)
    command = [sys.executable, "-m", "build", "--outdir", "dist"]
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    return source / "dist"


def lowest() -> list[str]:
    """The core dependencies as old as they may be."""
    core = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    return [re.sub(r">=([\d.]+).*", r"==\1.*", requirement) for requirement in core]


def another_python() -> str:
    """A newer one than this, where the machine has one that runs."""
    for minor in range(14, sys.version_info.minor, -1):
        found = shutil.which(f"python3.{minor}")
        if found and subprocess.run([found, "-c", "import ensurepip"], capture_output=True).returncode == 0:
            return found
    pytest.skip("no newer Python here")


@pytest.fixture(scope="module", params=["pinned", "newest", "lowest", "another Python"])
def installed(request: pytest.FixtureRequest, packed: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Programs of a venv with the wheel and no extra."""
    folder = tmp_path_factory.mktemp("installed")
    python = another_python() if request.param == "another Python" else sys.executable
    subprocess.run([python, "-m", "venv", folder], check=True, capture_output=True)
    [wheel] = packed.glob("*.whl")
    pins = ["-c", ROOT / "constraints.txt"]
    versions = {"lowest": lowest(), "newest": []}.get(request.param, pins)
    install = ("-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--only-binary=:all:")
    command = [folder / "bin/python", *install, *versions, wheel]
    subprocess.run(command, check=True, cwd=folder, capture_output=True)
    return folder / "bin"


def call(program: Path, *arguments: object, code: int = 0) -> str:
    done = subprocess.run([program, *map(str, arguments)], cwd="/", capture_output=True, text=True)
    assert done.returncode == code, done.stderr
    return done.stdout if code == 0 else done.stderr


def test_the_sdist_holds_every_file_of_the_project(packed: Path, tracked: list[str]) -> None:
    [sdist] = packed.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    assert set(tracked) - held <= {".gitignore"}


def test_offline_work_runs_from_the_wheel_alone(installed: Path, tmp_path: Path) -> None:
    where = "import recordings; print(recordings.__path__[0])"
    package = Path(call(installed / "python", "-c", where).strip())
    assert not package.is_relative_to(ROOT)
    sample = package / "samples/paper-640.mcap"
    call(installed / "recordings", "info", sample)
    out = ("-o", tmp_path / "cell.yaml", "--report", tmp_path / "cell.html")
    solved = call(installed / "calibrate", "solve", sample, *out, "--json")
    assert json.loads(solved)["verdict"] == "pass"
    install = ("install", tmp_path / "cell.yaml", "--cell", "simulated", "--root", tmp_path / "root")
    call(installed / "calibrate", *install)
    assert (tmp_path / "root/calibrations/current").exists()


def test_a_command_without_its_extra_says_which(installed: Path, tmp_path: Path) -> None:
    command = [installed / "calibrate", "board", "-o", tmp_path / "board.pdf"]
    done = subprocess.run(command, cwd="/", capture_output=True, text=True)
    assert done.returncode in (1, 2) and "Traceback" not in done.stderr
    assert "calibration-station[report]" in done.stderr
