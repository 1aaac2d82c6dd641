"""`calibrate` called as a shell would call it, with a state folder of its own; errors by their codes."""

from __future__ import annotations

from pathlib import Path
from subprocess import CompletedProcess

import pytest

from calibrate.cli import main, output
from recordings.cli import lazy
from recordings.errors import CodedError, ErrorData
from tests.command_line import call


class Done(CompletedProcess[str]):
    """An ended command and the error that ended it."""

    error: ErrorData | None = None


def run(*arguments: object, cwd: Path) -> Done:
    ended_by: list[CodedError] = []
    shown = lazy.printed
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(cwd)
        patch.setenv("XDG_STATE_HOME", str(cwd / "state"))
        patch.delenv("STATE_DIRECTORY", raising=False)
        patch.setattr(output.out, "width", 150)  # whatever a test before it told
        patch.setattr(lazy, "printed", lambda problem: (ended_by.append(problem), shown(problem))[1])
        ended = call(main, *arguments)
    done = Done(ended.args, ended.returncode, ended.stdout, ended.stderr)
    done.error = ended_by[0].data if ended_by else None
    return done


def refused(done: Done, exit_code: int, code: str = "", *named: object) -> None:
    """Nothing on stdout, one line on stderr; `named`: files and options in it. No `code`: wrong usage."""
    assert (done.returncode, done.stdout) == (exit_code, ""), done.stderr
    assert "Traceback" not in done.stderr
    assert (done.error.code if done.error else "") == code, done.stderr
    for name in named:
        assert str(name) in " ".join(done.stderr.split())
