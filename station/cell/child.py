"""Child processes that say when they are ready, and end with their input: a daemon, simulated devices."""

from __future__ import annotations

import os
import select
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Self

from recordings.files import open_regular
from station.cell.errors import StationError

STOP_TIMEOUT_S = 3.0
END_TIMEOUT_S = 0.5
LOG_LIMIT_BYTES = 1_000_000


class ChildProcess:
    """Child process that ends by `stop`, at the end of its `with` block, or when this process dies."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process

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
    program: str, command: list[str], timeout_s: float, log: Path | None, stdin: int = subprocess.PIPE
) -> ChildProcess:
    """Start a child, and return once it writes a line with `"ready": true`; else it is ended: StationError.

    It has a session of its own: Ctrl-C in this terminal is not meant for it. program: its name for people.
    log: where its standard error goes.
    """
    with tempfile.TemporaryFile() if log is None else open_log(log) as stderr:
        said_before = stderr.seek(0, os.SEEK_END)
        child = subprocess.Popen(
            command, stdin=stdin, stdout=subprocess.PIPE, stderr=stderr, start_new_session=True
        )
        assert child.stdout is not None
        if (
            select.select([child.stdout], [], [], timeout_s)[0]
            and b'"ready": true' in child.stdout.readline()
        ):
            return ChildProcess(child)
        try:
            child.wait(END_TIMEOUT_S)  # it may be ending already
        except subprocess.TimeoutExpired:
            child.kill()
        child.communicate()
        stderr.seek(said_before)
        words = stderr.read().decode(errors="replace").strip()
    said = "\n".join(words.splitlines()[-3:]) or f"no ready line within {timeout_s:g} s"
    raise StationError("not-started", program=program, log=log or "what it said", tail=said)


def open_log(path: Path) -> BinaryIO:
    """Open a log for appending; one that grew too long is renamed, replacing the last one renamed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileNotFoundError):
        if path.stat().st_size > LOG_LIMIT_BYTES:
            path.replace(path.with_suffix(".log.1"))
    return os.fdopen(open_regular(path, os.O_RDWR | os.O_APPEND | os.O_CREAT), "a+b")
