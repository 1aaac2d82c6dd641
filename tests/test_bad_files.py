"""Whatever lies where a file should be is refused at once: a pipe, a device, a folder, a loop, 20 GB.

Nobody answers while a file is opened or read that never ends.
"""

from __future__ import annotations

import os
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from calibrate.cli import main as calibrate
from calibrate.files.loader import load_installed
from recordings.cli import main as recordings
from recordings.errors import CodedError
from station.cell.session_folder import list_sessions
from station.cli import main as station
from tests.command_line import call

MOST_CPU_S, MOST_BYTES, GIVE_UP_S = 2.0, 3 * 2**30, 60


def _sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 20_000_000_000)


KINDS: dict[str, Callable[[Path], None]] = {
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "terminal": lambda path: path.symlink_to("/dev/tty"),
    "folder": Path.mkdir,
    "loop": lambda path: path.symlink_to(path.name),
    "20 GB": _sparse,
}

Place = tuple[str, Callable[[Path], object]]
"""Where the file lies below a folder, and what reads it there."""


def _command(main: Callable[[], None], *arguments: str | Path) -> Callable[[Path], object]:
    """A command that ends with an error and its remedy; FILE and ROOT stand for the file and the folder."""

    def run(path: Path) -> None:
        names = {"FILE": path, "ROOT": path.parent, "NEW": path.parent / "new"}
        done = call(main, *(names.get(str(argument), argument) for argument in arguments))
        assert done.returncode in (1, 2, 3) and "Traceback" not in done.stderr
        said = "".join(done.stderr.split())
        assert path.name in said or Path(os.path.realpath(path)).name in said  # not of `usage`

    return run


def _of_session(root: Path) -> None:
    """The session is listed, without what its file would tell."""
    (found,) = list_sessions(root)
    assert found.views == 0


PLACES: dict[str, Place] = {
    "configuration": ("station.yaml", _command(station, "doctor", "--config", "FILE")),
    "plan": ("plan.yaml", _command(station, "plan", "--check", "FILE")),
    "replay": ("session.mcap", _command(station, "serve", "--replay", "FILE", "--root", "NEW")),
    "session.json": ("sessions/one/session.json", lambda path: _of_session(path.parents[2])),
    "calibration": ("cell.yaml", _command(calibrate, "show", "FILE")),
    "current": ("calibrations/current", lambda path: load_installed(path.parents[1])),
    "recording": ("session.mcap", _command(recordings, "info", "FILE")),
    "recording to recover": ("session.mcap.part", _command(recordings, "recover", "FILE")),
    "bag": ("bag.mcap", _command(recordings, "import", "FILE", "-o", "NEW.mcap")),
    "bag of ROS 2": ("bag.db3", _command(recordings, "import", "FILE", "-o", "NEW.mcap")),
    "dataset.yaml": ("dataset.yaml", _command(recordings, "import", "ROOT", "-o", "NEW.mcap")),
}
"""One of each way to read; that there are no others: tests/test_rooms.py."""


CASES = [(place, kind) for place in PLACES for kind in KINDS]


@contextmanager
def at_once() -> Iterator[None]:
    """Fails where the block waits for ever, takes all the memory, or computes for long."""

    def give_up(number: int, frame: object) -> None:
        pytest.fail("it waits for ever")

    before, limits = signal.signal(signal.SIGALRM, give_up), resource.getrlimit(resource.RLIMIT_DATA)
    signal.alarm(GIVE_UP_S)
    resource.setrlimit(resource.RLIMIT_DATA, (MOST_BYTES, limits[1]))
    cpu_s = time.process_time()
    try:
        yield
        assert time.process_time() - cpu_s < MOST_CPU_S
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, limits)
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize(("place", "kind"), CASES)
def test_nothing_in_place_of_a_file_is_waited_for(
    place: str, kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    name, read = PLACES[place]
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    KINDS[kind](path)
    with at_once():
        try:
            read(path)
        except CodedError as error:
            assert error.code


ENDLESS: dict[str, bytes] = {
    "a million poses": b"poses:\n" + b"- {name: a}\n" * 1_000_000,
    "numbers": b"poses: [" + b"1," * 130_000 + b"1]",
    "empty": b"poses: [" + b"{}," * 87_000 + b"{}]",
    "keys": b"".join(b"k%d: 1\n" % number for number in range(25_000)),
    "calibration": b"format: handeye-calibration/1\nviews: [" + b"1," * 2_000_000 + b"1]",
}


OTHERS = ("configuration", "calibration")


@pytest.mark.parametrize(
    ("place", "content"), [*(("plan", name) for name in ENDLESS), *((place, "empty") for place in OTHERS)]
)
def test_no_text_is_read_for_long(
    place: str, content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the daemon's process the arm's heartbeat would wait for it."""
    monkeypatch.chdir(tmp_path)
    name, read = PLACES[place]
    (tmp_path / name).write_bytes(ENDLESS[content])
    with at_once():
        read(tmp_path / name)
