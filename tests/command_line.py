"""The three commands called in this process: the entry points of the scripts, without their start-up time."""

from __future__ import annotations

import io
import sys
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from subprocess import CompletedProcess

import pytest


def call(main: Callable[[], None], *arguments: object) -> CompletedProcess[str]:
    """Call `main` with the arguments as a shell would; give its output and exit code."""
    command = [main.__module__.partition(".")[0], *map(str, arguments)]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", command)
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    return CompletedProcess(command, code, out.getvalue(), err.getvalue())
