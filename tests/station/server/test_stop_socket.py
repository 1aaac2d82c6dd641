"""STOP without a connection: what `station stop` may be believed, and that nobody can take it away."""

from __future__ import annotations

import asyncio
import os
import socket
import stat
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from station.cell.errors import StationError
from station.cell.socket_folder import (
    UntrustedFolderError,
    bind,
    default_socket,
    folder_owner,
    make_folder,
    motion_page,
    post_socket,
    post_token,
    stop_socket,
)
from station.protocol.client import Client
from station.protocol.messages import USER_CLIENT_LIMIT
from station.protocol.stop_client import (
    ArmMotion,
    Outcome,
    Page,
    create_page,
    main,
    open_page,
    read_page,
    send_stop,
    stop,
    write_page,
)
from station.server import stop_server
from station.server.connections import ClientServer
from station.server.dispatch import SessionDispatcher
from station.server.stop_server import Peer, StopServer
from tests.durability import full
from tests.patience import PATIENCE_S, until
from tests.station.server.test_connections import RecordingHandler, raw

NOBODY = 65534
ONLY_ROOT = pytest.mark.skipif(os.getuid() != 0, reason="only root can become somebody else")


class Station(SessionDispatcher):
    """A stop server without an arm; `motion` is what the arm would say."""

    latched = False
    motion = ArmMotion.RESTS

    def __init__(self, control: Path) -> None:
        self.control = control
        self.heard: list[Peer] = []
        self.server = StopServer(control, self)
        self._beating: asyncio.Task[None] | None = None

    def stop_by_datagram(self, sender: Peer) -> None:
        self.heard.append(sender)
        self.latched = True

    def start(self) -> None:
        self.server.start()
        self._beating = asyncio.create_task(self._beat())

    async def _beat(self) -> None:
        while True:
            self.server.round()
            await asyncio.sleep(0.01)

    async def close(self) -> None:
        if self._beating is not None:
            self._beating.cancel()
            await asyncio.gather(self._beating, return_exceptions=True)
        self.server.close()


@pytest.fixture
async def station(tmp_path: Path) -> AsyncIterator[Station]:
    tmp_path.chmod(0o700)
    made = Station(tmp_path / "c.sock")
    made.start()
    yield made
    await made.close()


async def stopped(control: Path) -> Outcome:
    return (await asyncio.to_thread(stop, control))[0]


async def test_stop_is_confirmed_when_the_arm_rests(station: Station) -> None:
    assert await stopped(station.control) is Outcome.RESTS
    assert station.heard == [Peer(0, os.getpid(), os.getuid())]
    assert stat.S_IMODE(motion_page(station.control).stat().st_mode) == 0o640  # the group reads it


@pytest.mark.parametrize("payload", [b"", b"\0" * 9, b'{"verb": "go"}', b"x" * 60_000])
async def test_whatever_a_datagram_says_it_is_stop(station: Station, payload: bytes) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
        link.sendto(payload, str(stop_socket(station.control)))
    await until(lambda: station.heard)


@pytest.mark.parametrize(
    ("motion", "outcome"), [(ArmMotion.MOVES, Outcome.MOVES), (ArmMotion.UNKNOWN, Outcome.UNKNOWN)]
)
async def test_an_arm_that_is_not_seen_to_rest_is_not_called_stopped(
    station: Station, motion: ArmMotion, outcome: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("station.protocol.stop_client.REST_S", 0.2)
    station.motion = motion
    assert await stopped(station.control) is outcome
    assert station.heard


async def test_rest_is_not_believed_before_the_session_has_carried_stop_out(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The newest state is of before STOP, and a move may just have begun."""
    monkeypatch.setattr("station.protocol.stop_client.REST_S", 0.2)
    monkeypatch.setattr(station, "stop_by_datagram", station.heard.append)  # it latches nothing yet
    assert await stopped(station.control) is Outcome.MOVES
    station.latched = True
    assert await stopped(station.control) is Outcome.RESTS


async def test_of_a_flood_only_so_much_reaches_the_loop_and_another_stop_is_confirmed(
    station: Station,
) -> None:
    flooding = True

    def flood() -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link:
            link.setblocking(False)
            while flooding:
                try:
                    link.sendto(b"x", str(stop_socket(station.control)))
                except BlockingIOError:
                    time.sleep(0.0005)

    flooder = asyncio.create_task(asyncio.to_thread(flood))
    await asyncio.sleep(0.3)
    begun_s, before = time.monotonic(), len(station.heard)
    assert await stopped(station.control) is Outcome.RESTS
    repeated = (len(station.heard) - before) / (time.monotonic() - begun_s + stop_server.REPEAT_S)
    flooding = False
    await flooder
    assert repeated <= 2 / stop_server.REPEAT_S


async def test_a_stop_after_an_acknowledgement_is_carried_out_however_soon_it_comes(station: Station) -> None:
    assert await stopped(station.control) is Outcome.RESTS
    station.latched = False
    assert send_stop(station.control) is None
    await until(lambda: len(station.heard) == 2)


async def test_a_daemon_that_hangs_is_not_believed(tmp_path: Path) -> None:
    tmp_path.chmod(0o700)
    hung = Station(tmp_path / "c.sock")
    hung.server.start()  # and nobody reads
    assert stop(hung.control)[0] is Outcome.SILENT
    assert {send_stop(hung.control) for _ in range(5000)} == {None}  # a queue full of STOPs is one
    hung.server.close()


def test_without_a_daemon_it_is_said_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tmp_path.chmod(0o700)
    for control in (tmp_path / "c.sock", tmp_path / "none" / "c.sock"):
        assert stop(control)[0] is Outcome.NO_DAEMON
        assert main(["--socket", str(control)]) == 1
    left_over = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    left_over.bind(str(stop_socket(tmp_path / "c.sock")))
    left_over.close()
    assert stop(tmp_path / "c.sock")[0] is Outcome.NO_DAEMON
    assert str(tmp_path) in capsys.readouterr().err


def test_other_arguments_are_left_to_the_whole_command_line() -> None:
    assert main(["--help"]) is None and main(["--socket"]) is None and main(["--socket", "--help"]) is None


# -- whose folder it is ------------------------------------------------------------------------------------


def as_nobody(program: str, *arguments: object) -> subprocess.Popen[bytes]:
    """It cannot read this interpreter's modules any more, if they lie in root's home."""
    modules = "import os, socket, struct, sys, time\n"
    become = f"{modules}os.setgroups([]); os.setgid({NOBODY}); os.setuid({NOBODY})\n"
    command = [sys.executable, "-c", become + program, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


FAKE = """
link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
link.bind(sys.argv[1])
page = open(sys.argv[2], "wb", buffering=0)
stops = 0
page.write(struct.pack("<8sIIQ", b"STATION1", 1, 2, stops))
print("ready", flush=True)
while True:
    link.recv(100); stops += 1; page.seek(0)
    page.write(struct.pack("<8sIIQ", b"STATION1", 1, 2, stops))
"""


@ONLY_ROOT
def test_a_fake_daemon_in_a_strangers_folder_is_not_believed(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    for folder in (tmp_path, *tmp_path.parents[:3]):
        folder.chmod(folder.stat().st_mode | 0o011)
    shared.mkdir()
    shared.chmod(0o1777)
    folder = shared / "station-0"
    folder.mkdir(mode=0o755)
    os.chown(folder, NOBODY, NOBODY)
    control = folder / "c.sock"
    fake = as_nobody(FAKE, stop_socket(control), motion_page(control))
    try:
        assert fake.stdout is not None and fake.stdout.readline()
        outcome, reason = stop(control)
        assert outcome is Outcome.UNTRUSTED and str(folder) in reason
        with pytest.raises(StationError):
            make_folder(folder)
        # Even in a good folder: the page is the stranger's.
        folder.chmod(0o755)
        os.chown(folder, 0, 0)
        assert stop(control)[0] is Outcome.UNTRUSTED
    finally:
        fake.kill()
        fake.communicate()


@ONLY_ROOT
def test_the_folder_that_root_made_for_the_daemons_account_is_believed(tmp_path: Path) -> None:
    """A folder like /run/station, which belongs to the user station."""
    folder = Path("/run") / f"station-test-{os.getpid()}"
    folder.mkdir(mode=0o755)
    try:
        os.chown(folder, NOBODY, NOBODY)
        assert folder_owner(folder) == NOBODY
        folder.chmod(0o770)
        with pytest.raises(UntrustedFolderError):
            folder_owner(folder)
    finally:
        folder.rmdir()


@ONLY_ROOT
def test_a_strangers_link_to_a_good_folder_is_not_followed(tmp_path: Path) -> None:
    good = tmp_path / "good"
    good.mkdir(mode=0o700)
    link = tmp_path / "link"
    link.symlink_to(good)
    assert folder_owner(link) == 0
    os.chown(link, NOBODY, NOBODY, follow_symlinks=False)
    with pytest.raises(UntrustedFolderError):
        folder_owner(link)


@ONLY_ROOT
def test_who_is_no_operator_is_told_so(tmp_path: Path) -> None:
    """`station stop` of a user outside the group, beside a daemon of systemd's."""
    folder = Path("/run") / f"station-test-{os.getpid()}"
    folder.mkdir(mode=0o750)
    child = os.fork()
    if child == 0:
        try:
            os.setgroups([])
            os.setgid(NOBODY)
            os.setuid(NOBODY)
            os._exit(stop(folder / "control.sock")[0] is not Outcome.DENIED)
        finally:
            os._exit(2)
    try:
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    finally:
        folder.rmdir()


def test_what_cannot_be_a_stop_socket_was_not_heard(tmp_path: Path) -> None:
    assert stop(tmp_path / ("x" * 200))[0] is Outcome.SILENT
    with socket.socket(socket.AF_UNIX) as stream:
        stream.bind(str(stop_socket(tmp_path / "c.sock")))
        stream.listen()
        assert stop(tmp_path / "c.sock")[0] is Outcome.SILENT


@pytest.mark.parametrize("mode", [0o777, 0o1777, 0o772])
async def test_a_folder_that_others_may_write_to_is_refused(tmp_path: Path, mode: int) -> None:
    folder = tmp_path / "open"
    folder.mkdir()
    folder.chmod(mode)
    with pytest.raises(StationError):
        make_folder(folder)
    with pytest.raises(StationError):
        await ClientServer(folder / "c.sock", RecordingHandler()).start()
    inside = folder / "inside"
    inside.mkdir(mode=0o700)
    if mode == 0o1777:  # as below /tmp: what lies there belongs to who made it
        assert folder_owner(inside) == os.getuid()
    else:
        with pytest.raises(UntrustedFolderError):
            folder_owner(inside)


def test_a_new_folder_is_this_users_alone(tmp_path: Path) -> None:
    make_folder(tmp_path / "a" / "run")
    assert stat.S_IMODE((tmp_path / "a" / "run").stat().st_mode) == 0o700


def test_without_a_runtime_folder_the_socket_lies_where_nobody_else_can_be_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    if Path("/run/station/control.sock").exists():
        pytest.skip("a station serves on this computer")
    assert default_socket().parent == tmp_path
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/proc/1/none")
    assert (tmp_path / "state") in default_socket().parents
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert (tmp_path / "state") in default_socket().parents
    for name in ("XDG_STATE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("pwd.getpwuid", {}.__getitem__)
    assert not default_socket().exists()  # for an account without a home STOP says that nothing listens


# -- the page, the modes, the places ------------------------------------------------------------------------


def test_the_page_is_read_as_it_was_written_and_nothing_else_is_taken_for_one(tmp_path: Path) -> None:
    path = tmp_path / "c.motion"
    written = create_page(path, Page(7, ArmMotion.MOVES, 3))
    read = open_page(path, {os.getuid()})
    assert read_page(read) == Page(7, ArmMotion.MOVES, 3)
    write_page(written, Page(7, ArmMotion.RESTS, 4))
    assert read_page(read) == Page(7, ArmMotion.RESTS, 4)
    os.pwrite(written, b"\xff" * 24, 0)
    assert read_page(read) is None
    os.ftruncate(written, 5)
    assert read_page(read) is None
    os.close(written)
    os.close(read)
    with pytest.raises(PermissionError):
        open_page(path, {os.getuid() + 1})


def test_in_a_folder_that_others_may_enter_a_socket_is_its_owners_alone(tmp_path: Path) -> None:
    for folder, mode in ((0o755, 0o600), (0o750, 0o660)):
        tmp_path.chmod(folder)
        path = tmp_path / f"{folder:o}.sock"
        with socket.socket(socket.AF_UNIX) as link:
            bind(link, path)
        assert stat.S_IMODE(path.stat().st_mode) == mode
        path.with_suffix("").mkdir()
        assert path.with_suffix("").stat().st_mode & 0o700 == 0o700, (
            "no other file is made as the sockets are"
        )


def test_two_daemons_of_one_folder_share_no_file(tmp_path: Path) -> None:
    controls = [tmp_path / name for name in ("station.left", "station.right", "c.sock", "x.stop")]
    files = [
        of(control) for control in controls for of in (stop_socket, motion_page, post_socket, post_token)
    ]
    assert len({*controls, *files}) == 20


async def test_a_disk_that_is_full_costs_the_confirmation_never_the_stop(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stop_server, "write_page", full)
    assert await stopped(station.control) is Outcome.SILENT
    assert station.heard


async def test_one_user_s_connections_are_counted_and_stop_needs_none(tmp_path: Path) -> None:
    tmp_path.chmod(0o700)
    control = ClientServer(tmp_path / "c.sock", RecordingHandler())
    await control.start()
    station = Station(tmp_path / "c.sock")
    station.start()
    clients = [await Client(tmp_path / "c.sock").open() for _ in range(USER_CLIENT_LIMIT)]
    answers = await raw(tmp_path / "c.sock")
    assert answers[0]["problem"]["code"] == "house-full"
    assert await stopped(tmp_path / "c.sock") is Outcome.RESTS
    await clients.pop().close()
    async with asyncio.timeout(PATIENCE_S):
        while len(clients) < USER_CLIENT_LIMIT:
            try:
                clients.append(await Client(tmp_path / "c.sock").open())
            except StationError:
                await asyncio.sleep(0.01)
    for client in clients:
        await client.close()
    await station.close()
    await control.close()
