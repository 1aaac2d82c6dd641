"""Tell other programs of a change: programs in a folder, and the journal.

    ROOT/hooks/NAME     run in the order of their names by the command that made the change, not by the daemon

A program runs only when the folder and the program belong to root or to who runs the command, and nobody else
may write to them. It has `TIME_LIMIT_S`; what it said is kept in `hooks.jsonl` beside the camera's log.
"""

from __future__ import annotations

import os
import signal
import socket
import stat
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Literal

import msgspec

from calibrate.files.folders import calibrations_folder
from calibrate.files.lines import append_line
from calibrate.files.validity import Validity, ValidityState, time_text
from recordings.files import state_root

HookEvent = Literal["install", "rollback", "valid", "unverified", "in-doubt", "withdrawn"]
TIME_LIMIT_S = 10.0
OUTPUT_BYTES = 4096
JOURNAL = Path("/run/systemd/journal/socket")
_PRIORITY = {ValidityState.IN_DOUBT: 4, ValidityState.WITHDRAWN: 4}
"""syslog: 4 is a warning, 5 a notice."""


class HookRun(msgspec.Struct, frozen=True, omit_defaults=True):
    """One program's run, or why it was not run."""

    wall: str
    event: HookEvent
    program: str
    exit_code: int | None = None
    """None: not run, or ended after `TIME_LIMIT_S`; `problem` says which."""
    output: str = ""
    """The end of stdout and stderr together, `OUTPUT_BYTES` at most."""
    problem: str = ""
    duration_s: float = 0.0

    @property
    def failed(self) -> bool:
        return self.exit_code != 0


def announce(root: Path | None, camera: str, event: HookEvent, validity: Validity) -> tuple[HookRun, ...]:
    """Tell the journal and run the hooks; what they do changes nothing here. For after the change.

    Each program gets the event as its argument and CALIBRATION_EVENT, _CAMERA, _VERSION, _STATE, _SINCE,
    _REASON, _TEXT and _PATH (of `current`) in its environment.
    """
    folder = calibrations_folder(root, camera).absolute()
    fields = {
        "CALIBRATION_EVENT": event,
        "CALIBRATION_CAMERA": camera,
        "CALIBRATION_VERSION": str(validity.version),
        "CALIBRATION_STATE": validity.state.value,
        "CALIBRATION_SINCE": validity.since,
        "CALIBRATION_REASON": validity.reason.code,
        "CALIBRATION_TEXT": validity.reason.text,
        "CALIBRATION_PATH": str(folder / "current"),
    }
    _tell_journal(fields, _PRIORITY.get(validity.state, 5))
    runs = tuple(_runs(state_root(root).absolute() / "hooks", event, fields))
    with suppress(OSError):  # the change is made and told; the runs are in the answer
        for run in runs:
            append_line(folder / "hooks.jsonl", run)
    return runs


def _runs(folder: Path, event: HookEvent, fields: dict[str, str]) -> list[HookRun]:
    if not folder.is_dir():
        return []
    if problem := _distrusted(folder):
        return [HookRun(time_text(), event, str(folder), problem=problem)]
    programs = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    return [_run(path, event, fields) for path in programs if not path.is_dir()]


def _distrusted(path: Path) -> str:
    """Say why it is not run; empty when it belongs to root or to us and nobody else may change it."""
    found = path.lstat()
    if stat.S_ISLNK(found.st_mode):
        return f"{path} is a symbolic link."
    if found.st_uid not in (0, os.geteuid()):
        return f"{path} belongs to uid {found.st_uid}, not to root or uid {os.geteuid()}."
    if found.st_mode & 0o022:
        return f"{path} may be written by others: chmod go-w."
    return ""


def _run(path: Path, event: HookEvent, fields: dict[str, str]) -> HookRun:
    wall, begun_s = time_text(), time.monotonic()
    problem = _distrusted(path)
    if not problem and not os.access(path, os.X_OK):
        problem = f"{path} is not executable."
    if problem:
        return HookRun(wall, event, path.name, problem=problem)
    with tempfile.TemporaryFile() as said:  # a pipe would fill up, or stay open in a child of the program
        try:
            process = subprocess.Popen(
                [path, event],
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=subprocess.STDOUT,
                env=os.environ | fields,
                cwd="/",
                start_new_session=True,
            )
        except OSError as error:
            return HookRun(wall, event, path.name, problem=f"{path}: {error.strerror}.")
        exit_code: int | None = None
        try:
            exit_code = process.wait(TIME_LIMIT_S)
        except subprocess.TimeoutExpired:
            problem = f"{path} was ended after {TIME_LIMIT_S:g} s."
        finally:  # the program and whatever it left running
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        end = said.seek(0, os.SEEK_END)
        said.seek(max(0, end - OUTPUT_BYTES))
        output = said.read(OUTPUT_BYTES).decode(errors="replace")
    return HookRun(wall, event, path.name, exit_code, output, problem, round(time.monotonic() - begun_s, 3))


def _tell_journal(fields: dict[str, str], priority: int) -> None:
    """One entry with the fields, by the journal's own protocol; nothing where there is no journal.

    Source: systemd.io/JOURNAL_NATIVE_PROTOCOL.
    """
    said = f"Calibration of camera {fields['CALIBRATION_CAMERA']}: {fields['CALIBRATION_EVENT']}, version "
    said += f"{fields['CALIBRATION_VERSION']}, {fields['CALIBRATION_STATE']}. {fields['CALIBRATION_TEXT']}"
    entry = {"MESSAGE": said, "PRIORITY": str(priority), "SYSLOG_IDENTIFIER": "calibrate"} | fields
    text = "".join(f"{name}={' '.join(value.split())}\n" for name, value in entry.items())
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as journal:
        journal.settimeout(1.0)
        journal.sendto(text.encode(), str(JOURNAL))
