"""The public door: its example runs, its names exist, and nothing heavy is loaded before it is used."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

import calibrate


def example() -> str:
    """The first indented block of the docstring; `test_pictures` does what the second one does."""
    lines = (calibrate.__doc__ or "").partition("In a notebook")[0].splitlines()
    block = [line for line in lines[1:] if line.startswith("    ") or not line]
    return textwrap.dedent("\n".join(block))


def test_the_example_runs(
    session_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "session.mcap").write_bytes(session_file.read_bytes())
    names: dict[str, object] = {}
    exec(
        compile(example().replace('cell="simulated")', 'cell="simulated", override="a test")'), "x", "exec"),
        names,
    )
    assert names["flange_from_camera"].shape == (4, 4)  # type: ignore[attr-defined]
    assert "views True" in capsys.readouterr().out


HELP = """import sys; sys.argv = ['calibrate', '--help']
from calibrate.cli import main
try:
    main()
except SystemExit:
    pass
"""


@pytest.mark.parametrize("program", ["import calibrate", HELP])
def test_neither_the_door_nor_the_help_loads_what_is_heavy(program: str) -> None:
    asked = f"{program}\nimport sys\nprint('LOADED', *sys.modules)"
    done = subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True)
    assert not {"numpy", "scipy", "cv2", "matplotlib"} & set(done.stdout.partition("LOADED")[2].split())
