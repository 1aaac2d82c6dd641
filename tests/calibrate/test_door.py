"""The public door: its example runs."""

from __future__ import annotations

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
    assert names["flange_from_camera"].shape == (4, 4)
    assert "views True" in capsys.readouterr().out
