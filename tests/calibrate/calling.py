"""`calibrate` called as a shell would call it, with a state folder of its own."""

from __future__ import annotations

from pathlib import Path
from subprocess import CompletedProcess

import pytest

from calibrate.cli import main, output
from tests.command_line import call


def run(*arguments: object, cwd: Path) -> CompletedProcess[str]:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(cwd)
        patch.setenv("XDG_STATE_HOME", str(cwd / "state"))
        patch.delenv("STATE_DIRECTORY", raising=False)
        patch.setattr(output.out, "width", 150)  # whatever a test before it told
        return call(main, *arguments)


def refused(done: CompletedProcess[str], code: int, *words: str) -> None:
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in " ".join(done.stderr.split())
