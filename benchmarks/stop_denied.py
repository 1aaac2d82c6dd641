"""STOP of a user while others of the operators' group do their worst.

The real daemon on a simulated cell, in a folder as systemd makes it (0750, the operators' group). A process
of one member (uid 52001) sends STOP's datagram and watches the page beside the socket; *heard* is the time
until the daemon counted it, right after its stop call. Between trials another client acknowledges, so that
every STOP is one that latches; a few come while the arm moves. Others are processes of uid 52002 (and 52001,
"two users"). `station stop` is the command as a shell runs it. Needs root, to become these users.
"""

from __future__ import annotations

import asyncio
import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from benchmarks.trials import table, trials
from station.cell.errors import RefusedError
from station.cell.socket_folder import motion_page, stop_socket
from station.cell.status import StationState, StationStatus
from station.protocol.client import Client
from station.protocol.stop_client import Motion, open_page, read_page
from station.protocol.verbs import GetPlan, Go, Prepare, Purpose

TRIALS, MOVING, COMMANDS = 100, 4, 10
CROWD = 1000
VICTIM, OTHER, GROUP = 52001, 52002, 52000
LIMIT_MS = 100.0
POLL_S = 0.0002
GIVE_UP_S = 3.0


@dataclass
class Found:
    """Figures of one situation."""

    name: str
    heard_ms: list[float] = field(default_factory=list)
    rest_ms: list[float] = field(default_factory=list)
    """Times of an arm that moved."""
    commands: list[tuple[int, float, float]] = field(default_factory=list)
    """Exit code, seconds, processor seconds of `station stop`"""


def run() -> str:
    if os.getuid() != 0:
        return "Not measured: only root can become the users of this benchmark."
    found = asyncio.run(_measure())
    rows = [_row(f) for f in found]
    header = ("situation", "STOPs", "≤ 100 ms", "heard p50 ms", "p99", "max")
    more = ("at rest from motion, ms", "`station stop`: exit codes", "slowest s", "most CPU s")
    return table((*header, *more), rows) + f"\n\nLoad at the end {os.getloadavg()[0]:.1f}."


def _row(f: Found) -> tuple[object, ...]:
    heard: tuple[object, ...] = ("–",) * 5
    if f.heard_ms:
        p50, p99 = np.percentile(f.heard_ms, [50, 99])
        good = sum(ms <= LIMIT_MS for ms in f.heard_ms)
        heard = (len(f.heard_ms), good, f"{p50:.1f}", f"{p99:.1f}", f"{max(f.heard_ms):.1f}")
    rest = f"{min(f.rest_ms):.0f}–{max(f.rest_ms):.0f} (n = {len(f.rest_ms)})" if f.rest_ms else "–"
    codes, seconds, cpu = zip(*f.commands, strict=True)
    said = ", ".join(f"{codes.count(code)} × {code}" for code in sorted(set(codes)))
    return (f.name, *heard, rest, said, f"{max(seconds):.2f}", f"{max(cpu):.2f}")


# -- the daemon, the member who stops, and the operator who goes on -----------------------------------------


@contextmanager
def _folder() -> Iterator[tuple[Path, bool]]:
    """And whether it is a small disk of its own, that may be filled."""
    folder = Path("/run") / f"station-benchmark-{os.getpid()}"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "none", str(folder)]).returncode == 0
    os.chown(folder, 0, GROUP)
    folder.chmod(0o750)
    try:
        yield folder, mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(folder)], check=False)
        shutil.rmtree(folder, ignore_errors=True)


@asynccontextmanager
async def _daemon(control: Path, root: Path) -> AsyncIterator[int]:
    command = [sys.executable, "-m", "station.cli", "serve", "--simulate", "--end-with-stdin"]
    daemon = subprocess.Popen(
        [*command, "--socket", str(control), "--root", str(root)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=(root / "daemon.log").open("wb"),
        group=GROUP,
        start_new_session=True,
    )
    try:
        assert daemon.stdout is not None
        await asyncio.to_thread(daemon.stdout.readline)
        yield daemon.pid
    finally:
        assert daemon.stdin is not None
        daemon.stdin.close()
        await asyncio.to_thread(daemon.wait, 30)


def _as_user(
    uid: int, what: str, *arguments: object, stdin: int | None = None, stdout: int | None = None
) -> subprocess.Popen[str]:
    """This module again, as a member of the group."""
    command = [sys.executable, "-m", "benchmarks.stop_denied", what, *map(str, arguments)]
    return subprocess.Popen(
        command, user=uid, group=GROUP, extra_groups=[], text=True, stdin=stdin, stdout=stdout
    )


class Member:
    """Presses STOP when told."""

    def __init__(self, control: Path) -> None:
        self._process = _as_user(VICTIM, "stopper", control, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    async def press(self) -> tuple[bool, float, float]:
        """Whether the arm moved, milliseconds until it was heard, and until the arm rested (inf: never)."""

        def ask() -> tuple[bool, float, float]:
            assert self._process.stdin is not None and self._process.stdout is not None
            print("stop", file=self._process.stdin, flush=True)
            moved, heard_s, rest_s = json.loads(self._process.stdout.readline())
            return moved, 1000 * (heard_s or np.inf), 1000 * (rest_s or np.inf)

        return await asyncio.to_thread(ask)

    def end(self) -> None:
        self._process.kill()
        self._process.communicate()


def _stopper(control: Path) -> None:
    page = open_page(motion_page(control), {0})
    for _ in sys.stdin:
        heard_s = rest_s = None
        before = read_page(page)
        begun_s = time.monotonic()
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link, suppress(BlockingIOError):
            link.setblocking(False)
            link.connect(str(stop_socket(control)))
            link.send(b"STOP")
        while rest_s is None and time.monotonic() - begun_s < GIVE_UP_S:
            now = read_page(page)
            if now is not None and before is not None and now.stops > before.stops:
                heard_s = heard_s or time.monotonic() - begun_s
                if now.motion is Motion.RESTS:
                    rest_s = time.monotonic() - begun_s
            time.sleep(POLL_S)
        moved = before is not None and before.motion is Motion.MOVES
        print(json.dumps([moved, heard_s, rest_s]), flush=True)


async def _until(client: Client, condition: Callable[[StationStatus], bool]) -> None:
    async with asyncio.timeout(60):
        async for status in client.statuses():
            if condition(status):
                return


async def _acknowledge(operator: Client) -> None:
    with suppress(Exception):  # a flood latches it again at once
        await operator.request("acknowledge")


async def _move(operator: Client, plan: object) -> None:
    """Up to a motion of the arm; a session that is over is begun anew."""
    for _ in range(3):
        await _acknowledge(operator)
        await operator.request("lease", action="take")
        await _until(operator, lambda s: s.state in (StationState.IDLE, StationState.PAUSED))
        purpose = "resume"
        with suppress(RefusedError):  # a session is open
            await operator.request("load_plan", plan=plan)
            purpose = "run"
        summary = await operator.call(Prepare(Purpose(purpose)), timeout_s=60.0)
        await operator.call(Go(summary.token))
        states: list[StationState] = []

        def moves(status: StationStatus, seen: list[StationState] = states) -> bool:
            seen.append(status.state)
            if status.state is StationState.MOVING and status.robot.speed_m_s > 0.05:
                return True
            ended = (StationState.IDLE, StationState.FAULT, StationState.STOPPED, StationState.PAUSED)
            return len(seen) > 5 and status.state in ended

        await _until(operator, moves)
        if states[-1] is StationState.MOVING:
            return
    raise RuntimeError("the arm did not move")


def _command(control: Path) -> tuple[int, float, float]:
    """`station stop` once, as a shell runs it: exit code, wall and processor time."""
    program = Path(sys.executable).with_name("station")
    before, begun_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    done = subprocess.run(
        [program, "stop", "--socket", str(control)],
        user=VICTIM,
        group=GROUP,
        extra_groups=[],
        capture_output=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return done.returncode, time.monotonic() - begun_s, cpu_s


# -- what others do ------------------------------------------------------------------------------------------


@contextmanager
def _others(*what: tuple[int, str, int], control: Path) -> Iterator[None]:
    """Processes (user, what they do, how many of it), until the end of the block."""
    at_work = [_as_user(uid, kind, control, number, stdout=subprocess.PIPE) for uid, kind, number in what]
    for process in at_work:
        assert process.stdout is not None
        process.stdout.readline()
    try:
        yield
    finally:
        for process in at_work:
            process.send_signal(signal.SIGCONT)
            process.kill()
            process.communicate()


def _crowd(control: Path, number: int, again: bool) -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    links: list[socket.socket | None] = [None] * number
    ready = False
    while True:
        for k, link in enumerate(links):
            if link is None or again:
                if link is not None:
                    link.close()
                links[k] = fresh = socket.socket(socket.AF_UNIX)
                fresh.setblocking(False)
                try:
                    fresh.connect(str(control))
                except OSError:  # the queue is full: once more
                    fresh.close()
                    links[k] = None
        if not ready:
            print("ready", flush=True)
            ready = True
        if not again:
            time.sleep(0.01)


def _flood(control: Path) -> None:
    link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    link.setblocking(False)
    link.connect(str(stop_socket(control)))
    print("ready", flush=True)
    while True:
        with suppress(BlockingIOError):
            link.send(b"x" * 1000)


def _screen(control: Path) -> None:
    async def hold() -> None:
        async with await Client.connect(control) as client:
            await client.request("lease", action="take")
            async for _ in client.statuses():
                print("ready", flush=True)
                os.kill(os.getpid(), signal.SIGSTOP)

    asyncio.run(hold())


def _burn() -> None:
    print("ready", flush=True)
    while True:
        pass


# -- situations ----------------------------------------------------------------------------------------------


async def _measure() -> list[Found]:
    with _folder() as (folder, small), tempfile.TemporaryDirectory() as scratch:
        control = folder / "control.sock"
        async with _daemon(control, Path(scratch)), await Client.connect(control) as operator:
            await _until(operator, lambda s: s.state is StationState.IDLE and s.camera.connected)
            member = Member(control)
            await operator.request("lease", action="take")
            await operator.request("make_plan", poses=25, seed=1, timeout_s=120.0)
            plan = msgspec.to_builtins((await operator.call(GetPlan())).plan)
            await operator.request("lease", action="release")

            async def situation(name: str, *what: tuple[int, str, int], moving: bool = True) -> Found:
                found = Found(name)
                with _others(*what, control=control):
                    while moving and len(found.rest_ms) < MOVING:
                        await _move(operator, plan)
                        moved, _, rest_ms = await member.press()
                        if moved:  # else it had just arrived
                            found.rest_ms.append(rest_ms)
                    await _presses(found, member, operator, control)
                await _acknowledge(operator)
                await operator.request("lease", action="release")
                return found

            half = CROWD // 2
            found = [
                await situation("nobody disturbs"),
                await situation(
                    f"{CROWD} idle connections, one user", (OTHER, "idle", half), (OTHER, "idle", half)
                ),
                await situation(
                    f"{CROWD} idle connections, two users", (OTHER, "idle", half), (VICTIM, "idle", half)
                ),
                await situation(
                    f"{CROWD} reconnecting, one user", (OTHER, "again", half), (OTHER, "again", half)
                ),
                await situation(
                    f"{CROWD} reconnecting, two users", (OTHER, "again", half), (VICTIM, "again", half)
                ),
                # A flood is itself STOP: no move outlives its start.
                await situation("flood of datagrams from another member", (OTHER, "flood", 1), moving=False),
                await situation("frozen screen that holds control", (OTHER, "screen", 1), moving=False),
                await situation("16 busy processes", *[(OTHER, "burn", 1)] * 16),
            ]
            if small:
                with suppress(OSError), (folder / "full").open("wb", buffering=0) as file:
                    while True:
                        file.write(bytes(512))
                found.append(await situation("full disk below the sockets", moving=False))
            member.end()
    found += _untrusted()
    return found


async def _presses(found: Found, member: Member, operator: Client, control: Path) -> None:
    for _ in range(trials(TRIALS)):
        await _acknowledge(operator)
        found.heard_ms.append((await member.press())[1])
        await asyncio.sleep(0.02)
    for _ in range(COMMANDS):
        await _acknowledge(operator)
        found.commands.append(await asyncio.to_thread(_command, control))


FAKE = """
import socket, struct, sys
link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
link.bind(sys.argv[1])
page = open(sys.argv[2], "wb", buffering=0)
for stops in range(10**9):
    page.seek(0)
    page.write(struct.pack("<8sIIQ", b"STATION1", 1, 2, stops))
    if not stops:
        print("ready", flush=True)
    link.recv(100)
"""


def _untrusted() -> list[Found]:
    """In a folder below /tmp that another user made first."""
    folder = Path(tempfile.gettempdir()) / f"station-benchmark-{os.getpid()}"
    folder.mkdir(mode=0o755)
    os.chown(folder, OTHER, GROUP)
    control = folder / "control.sock"
    empty = Found("folder of another user, nobody in it (honest failure)")
    fake = Found("folder of another user, a fake daemon in it (honest failure)")
    try:
        empty.commands += [_command(control) for _ in range(COMMANDS)]
        with subprocess.Popen(
            [sys.executable, "-c", FAKE, str(stop_socket(control)), str(motion_page(control))],
            user=OTHER,
            group=GROUP,
            extra_groups=[],
            stdout=subprocess.PIPE,
        ) as liar:
            assert liar.stdout is not None
            liar.stdout.readline()
            stop_socket(control).chmod(0o777)
            fake.commands += [_command(control) for _ in range(COMMANDS)]
            liar.kill()
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return [empty, fake]


def _act() -> None:
    what, *arguments = sys.argv[1:]
    control = Path(arguments[0])
    actions: dict[str, Callable[[], None]] = {
        "stopper": lambda: _stopper(control),
        "idle": lambda: _crowd(control, int(arguments[1]), again=False),
        "again": lambda: _crowd(control, int(arguments[1]), again=True),
        "flood": lambda: _flood(control),
        "screen": lambda: _screen(control),
        "burn": _burn,
    }
    actions[what]()


if __name__ == "__main__":
    if len(sys.argv) > 1:
        _act()
    else:
        print(run())
