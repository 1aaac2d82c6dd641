"""Core dependencies install from wheels alone, on every Python and computer that is promised."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LINUX = ("manylinux_2_28", "manylinux_2_27", "manylinux_2_17", "manylinux2014")
MACOS = ("macosx_14_0", "macosx_13_0", "macosx_11_0", "macosx_10_9")


@pytest.mark.parametrize("version", ["3.11", "3.12", "3.13", "3.14"])
@pytest.mark.parametrize(
    "platforms",
    [
        pytest.param([f"{tag}_x86_64" for tag in LINUX], id="linux-x86_64"),
        pytest.param([f"{tag}_aarch64" for tag in LINUX], id="linux-aarch64"),
        pytest.param([f"{tag}_arm64" for tag in MACOS] + ["macosx_10_9_universal2"], id="macos-arm64"),
    ],
)
def test_core_dependencies_resolve_from_wheels(version: str, platforms: list[str], tmp_path: Path) -> None:
    core = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    done = subprocess.run(
        [
            *(sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--dry-run", "--quiet"),
            *("--ignore-installed", "--only-binary=:all:", "--target", str(tmp_path)),
            *("--python-version", version, *(f"--platform={tag}" for tag in platforms)),
            *core,
        ],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
