"""Child processes that say when they are ready, and end with their input: a daemon, simulated devices."""

from __future__ import annotations

import os
import select
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Self

from recordings.files import open_regular

STOP_TIMEOUT_S = 3.0
END_TIMEOUT_S = 0.5


class ChildProcess:
    """Child process that ends by `stop`, at the end of its `with` block, or when this process dies."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def stop(self, timeout_s: float = STOP_TIMEOUT_S) -> None:
        """End the child, by force if it does not react. Idempotent."""
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with suppress(BrokenPipeError):
                    pipe.close()  # it ends with its input
        try:
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def start_child(
    command: list[str], timeout_s: float, log: Path | None, stdin: int = subprocess.PIPE
) -> tuple[subprocess.Popen[bytes], str]:
    """Start a child; return it, and why it was not ready and was ended ("": it is ready).

    It is ready once it writes a line with `"ready": true`. It has a session of its own: Ctrl-C in this
    terminal is not meant for it. log: where its standard error goes.
    """
    kept = None if log is None else open_regular(log, os.O_RDWR | os.O_APPEND | os.O_CREAT)
    with tempfile.TemporaryFile() if kept is None else os.fdopen(kept, "a+b") as stderr:
        said_before = stderr.seek(0, os.SEEK_END)
        child = subprocess.Popen(
            command, stdin=stdin, stdout=subprocess.PIPE, stderr=stderr, start_new_session=True
        )
        assert child.stdout is not None
        if (
            select.select([child.stdout], [], [], timeout_s)[0]
            and b'"ready": true' in child.stdout.readline()
        ):
            return child, ""
        try:
            child.wait(END_TIMEOUT_S)  # it may be ending already
        except subprocess.TimeoutExpired:
            child.kill()
        child.communicate()
        stderr.seek(said_before)
        words = stderr.read().decode(errors="replace").strip()
    return child, words or f"no ready line within {timeout_s:g} s"
