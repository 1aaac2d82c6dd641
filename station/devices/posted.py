"""An arm that a person moves and whose pose a program posts, behind `devices.base.Arm`.

The program writes lines (`devices.posts`) to a Unix socket beside the control socket, or, where
`robot.tcp_port` says so, to this port of 127.0.0.1, with a token as its first line. The first program has the
arm until it ends. Nothing is ever sent to the arm; a program that is refused is told why and let go.
Reading is slow on purpose: whatever is written to the socket, control and STOP in the same loop go on.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import secrets
import socket
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import msgspec

from recordings.files import write_atomically
from recordings.geometry import rotation_angle, rotation_exp
from recordings.importers.conventions import Convention
from recordings.schema.messages import ArmKinematics, RobotIdentity, RobotState, Source, Stamps, Vector6
from recordings.schema.stillness import LEAST_SAMPLES
from station.cell.clock_fit import ClockFit
from station.cell.config import StationConfig
from station.cell.errors import RobotError, StaleStateError, StationError
from station.cell.socket_folder import bind, make_folder, peer_of, post_socket, post_token
from station.cell.status import ArmCondition
from station.devices.clocks import ClockEstimator
from station.devices.history import HISTORY_S, state_at
from station.devices.news import CURRENT_S, RESTING_S
from station.devices.posts import Post, read_declaration, read_post

log = logging.getLogger(__name__)

SOURCES: dict[Source, str] = {"real": "live", "simulated": "simulated", "playback": "playback"}
"""What a program must declare in a cell of each kind."""
READ_BYTES, PAUSE_S, LINES_READ = 8192, 0.005, 50
"""So much is read at once, then for `PAUSE_S` nothing; of what came together only the newest `LINES_READ`
lines are parsed."""
LINE_BYTES = 2048
ANSWERS_PER_S = 20
"""Most wrong lines of which a program is told within a second; while it reads none of that, none."""
STATES_KEPT = 20_000
"""Most states kept, however many poses with times within `HISTORY_S` are posted."""
PROGRAMS = 8
"""Most programs connected at once to the socket, and as many to the port. Only the first may post."""
STRANGERS = 64
"""Most connections to the port that have not shown the token yet. The oldest makes room for one more."""
ACCEPTED_AT_ONCE = 8
"""Connections to the port that are let in between two looks at what came. So few that a program's token,
which it sends at once, is read long before `STRANGERS` others came after it."""
FIRST_LINE_S = 3.0
"""Longest wait for a program's first line."""
AFTER_WRONG_S = 1.0
"""Time after a wrong post in which no image is taken, so that a person sees what is wrong."""
NOTICE_S = 10.0
"""Time for which a notice stays on the screen."""
JUMP_M_S, JUMP_RAD_S = 2.5, 10.0
"""Speeds above which a post is wrong: ten times the limit for arms beside a person, 0.25 m/s."""
ARRIVAL_S = 0.1
"""Longest delay assumed of posts without a time of their own, when their speed is judged."""
CLOCK_STEP_S = 1.0
"""Smallest step of a program's clock ahead of this computer's that counts as another unit of time."""


class Refused(NamedTuple):
    """A line that a program posted, and what is wrong with it."""

    line: int
    """Its number, from 1: the declaration."""
    code: str
    text: str
    """Not the error itself, which would keep alive all lines that came with this one."""

    @classmethod
    def of(cls, line: int, error: StaleStateError) -> Refused:
        return cls(line, error.code, str(error))


class PostedArm:
    """`source`: the cell's. `control`: path of its control socket."""

    def __init__(self, config: StationConfig, source: Source, control: Path) -> None:
        robot = config.robot
        self.identity = RobotIdentity(robot.model, robot.serial, arm_class=robot.arm_class)
        self.guided = False
        self.notice = ""
        self.kinematics: ArmKinematics | None = None
        self.path, self.token_file = post_socket(control), post_token(control)
        self._tcp_port = config.robot.tcp_port
        self._source = source
        self._current_s = max(CURRENT_S, config.stillness.window_s / 2)
        """Age up to which a pose is the present one: half the window in which rest is looked for."""
        self._longest_gap_s = config.stillness.window_s / LEAST_SAMPLES
        """Longest time between two poses with which rest can be seen."""
        self._servers = list[asyncio.Server]()
        self._links: dict[asyncio.StreamWriter, asyncio.Task[None]] = {}
        """Connected programs, and what serves each."""
        self._strangers: dict[asyncio.StreamWriter, None] = {}
        """Those of them that have not shown the token of the port yet, the oldest first."""
        self._poster = ""
        """The program that has the arm; empty: none."""
        self._delay_s = 0.0
        """Age of a pose when it is posted, as the program declares it."""
        self._written: Convention | None = None
        self._callbacks: list[Callable[[RobotState], None]] = []
        self._states: deque[RobotState] = deque(maxlen=STATES_KEPT)
        self._clock: ClockEstimator | None = None
        """None: the posts have no time of their own."""
        self._wrong: StaleStateError | None = None
        self._wrong_since_s = self._notice_since_s = 0.0
        self._first_pose = asyncio.Event()

    # -- as an arm ---------------------------------------------------------------------------------------

    async def connect(self) -> RobotIdentity:
        """Listen, and return when a program has posted a pose. StationError where nothing can listen."""
        if not self._servers:
            make_folder(self.path.parent)
            self.path.unlink(missing_ok=True)
            bind(listening := socket.socket(socket.AF_UNIX), self.path)
            unix = await asyncio.start_unix_server(self._serve, sock=listening, limit=READ_BYTES)
            self._servers.append(unix)
            if self._tcp_port is not None:
                try:
                    self._servers.append(await self._listen(self._tcp_port))
                except StationError:
                    await self.close()  # or the next attempt would wait without that port
                    raise
        await self._first_pose.wait()
        return self.identity

    def subscribe(self, callback: Callable[[RobotState], None]) -> None:
        self._callbacks.append(callback)

    def state(self, largest_age_s: float = CURRENT_S) -> RobotState:
        """Return the newest pose; one of a program that posts as rarely as it may is the present one."""
        if time.monotonic() > self._notice_since_s + NOTICE_S:
            self.notice = ""
        if (trouble := self._trouble()) is not None:
            raise trouble
        if self._age_s() > max(largest_age_s, self._current_s):
            raise self._silent()
        return self._states[-1]

    def overdue(self) -> StaleStateError | None:
        if (trouble := self._trouble()) is not None:
            return trouble
        return self._silent() if self._age_s() > max(RESTING_S, self._current_s) else None

    def _trouble(self) -> StaleStateError | None:
        """Name a wrong post, or that nobody posts; None: poses come, or came."""
        if self._wrong is not None and time.monotonic() < self._wrong_since_s + AFTER_WRONG_S:
            return self._wrong
        if not self._poster or not self._states:
            return StaleStateError("post-nobody", robot=self.identity.model, socket=self.path)
        return None

    def check(self, state: RobotState) -> bool:
        return True

    def delay(self, pause_s: float, since_s: float) -> StaleStateError | None:
        return None

    def condition(self, state: RobotState) -> ArmCondition:
        return ArmCondition()

    def at(self, host_monotonic_ns: int) -> RobotState:
        return state_at(self._states.copy(), self.clock(), host_monotonic_ns)

    def clock(self) -> ClockFit | None:
        """The program's clock against the host's, or how late poses by arrival may be."""
        if self._clock is not None:
            return self._clock.fit()
        return ClockFit(0.0, 0.0, self._delay_s + PAUSE_S) if self._states else None

    async def close(self) -> None:
        if self._servers:
            while self._servers:
                self._servers.pop().close()
            for link in self._links:
                link.transport.abort()
            if self._links:
                await asyncio.wait(self._links.values(), timeout=FIRST_LINE_S)
            self.path.unlink(missing_ok=True)
            self.token_file.unlink(missing_ok=True)

    def _age_s(self) -> float:
        return time.monotonic() - self._states[-1].stamps.host_monotonic_ns / 1e9

    def _silent(self) -> StaleStateError:
        return StaleStateError("post-silent", poster=self._poster or "no program", age_s=self._age_s())

    # -- for programs ------------------------------------------------------------------------------------

    async def _listen(self, port: int) -> asyncio.Server:
        """Listen on this computer's own address alone, for programs that can read a file of this user."""
        token = secrets.token_hex(16).encode()
        try:
            write_atomically(self.token_file, token + b"\n", 0o600)
            return await asyncio.start_server(
                partial(self._serve, token=token),
                "127.0.0.1",
                port,
                limit=READ_BYTES,
                backlog=ACCEPTED_AT_ONCE,
            )
        except OSError as error:
            raise StationError("socket", path=f"127.0.0.1:{port}", reason=str(error)) from None

    async def _serve(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, token: bytes = b""
    ) -> None:
        link, holds = writer.get_extra_info("socket"), False
        poster, family = _name_of(link), link.family
        if (serving := asyncio.current_task()) is not None:
            self._links[writer] = serving
        try:
            if token:
                await self._require_token(reader, writer, token)
            # Socket and port each have this limit. Who may not post has no place in it.
            known = [one for one in self._links if one not in self._strangers]
            if sum(one.get_extra_info("socket").family == family for one in known) > PROGRAMS:
                raise RobotError("post-refused", poster=poster, reason=f"{PROGRAMS} programs are connected")
            if self._poster:
                raise RobotError("post-refused", poster=poster, reason=f"{self._poster} has the arm")
            self._poster, holds = poster, True
            await self._take(reader, writer)
        except (StationError, OSError) as error:
            if link.family is socket.AF_UNIX or holds or not self._poster:
                self._notify(str(error))
            answer = {"code": getattr(error, "code", "socket"), "text": str(error)}
            with contextlib.suppress(OSError):
                writer.write(msgspec.json.encode(answer) + b"\n")
                await asyncio.wait_for(writer.drain(), FIRST_LINE_S)
        finally:
            if holds:
                self._poster = ""
                self._forget()
            self._links.pop(writer, None)
            self._strangers.pop(writer, None)
            writer.close()

    async def _require_token(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, token: bytes
    ) -> None:
        """Wait for the token, as one of few strangers. RobotError where another line or none comes."""
        self._strangers[writer] = None
        if len(self._strangers) > STRANGERS:
            oldest = next(iter(self._strangers))
            del self._strangers[oldest]
            oldest.transport.abort()
        if not await _gives(token, reader):
            raise RobotError("post-token", file=self.token_file)
        self._strangers.pop(writer, None)

    async def _take(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Take a program's lines until it ends. RobotError where it is none for this cell."""
        lines, wanted, model = _lines(reader), SOURCES[self._source], self.identity.model
        try:
            first, *others = await asyncio.wait_for(anext(lines), FIRST_LINE_S)
        except (TimeoutError, StopAsyncIteration):
            raise RobotError("post-undeclared", reason="nothing was written") from None
        declared, self._written = read_declaration(first)
        if declared.source != wanted:
            reason = f"its poses are {declared.source}, the cell takes {wanted} ones"
            raise RobotError("post-refused", poster=self._poster, reason=reason)
        if declared.robot and declared.robot != model:
            reason = f"it posts the arm {declared.robot}, the cell's is {model}"
            raise RobotError("post-refused", poster=self._poster, reason=reason)
        self._delay_s, self._clock = declared.late_s, None
        answers = _Answers(writer)
        answers.tell(self._posts(others, 2))  # 1 is the declaration
        number = 2 + len(others)
        async for some in lines:
            answers.tell(self._posts(some, number))
            number += len(some)

    def _posts(self, lines: list[bytes], first: int) -> list[Refused]:
        """Take the posts of a piece, of which the first line has this number; return what was wrong."""
        arrived_ns = time.monotonic_ns()
        refused = list[Refused]()
        if len(lines) > LINES_READ:
            self._notify(f"{self._poster} posts too fast: only the newest poses are read")
        found = list[tuple[int, Post, Vector6]]()
        left_out = max(len(lines) - LINES_READ, 0)
        for number, line in enumerate(lines[left_out:], first + left_out):
            if not line.strip():
                continue
            try:
                found.append((number, *read_post(line, self._written)))
            except StaleStateError as error:
                self._note_wrong(error)
                refused.append(Refused.of(number, error))
        for number, post, pose in found if found and found[-1][1].t is not None else found[-1:]:
            if (wrong := self._add(post, pose, arrived_ns)) is not None:
                self._note_wrong(wrong)
                refused.append(Refused.of(number, wrong))
        return refused

    def _note_wrong(self, error: StaleStateError) -> None:
        self._wrong, self._wrong_since_s = StaleStateError.from_data(error.data), time.monotonic()

    def _add(self, post: Post, pose: Vector6, arrived_ns: int) -> StaleStateError | None:
        """Add a pose to the states; return what is wrong with it beside those before it."""
        before = self._states[-1] if self._states else None
        if (post.t is None) is not (self._clock is None):
            self._forget()
            before, self._clock = None, None if post.t is None else ClockEstimator(self._delay_s)
        posted_s = arrived_ns / 1e9 if post.t is None else post.t
        wrong: StaleStateError | None = None
        if before is not None:
            step_s = posted_s - before.stamps.controller_s
            waited_s = (arrived_ns - before.stamps.host_monotonic_ns) / 1e9
            if step_s == 0:
                return None  # posted again: no news
            if step_s > waited_s + CLOCK_STEP_S:
                wrong = StaleStateError("post-clock", step_s=step_s, passed_s=waited_s)
            if step_s < 0 or wrong is not None:
                self._forget()
            else:
                least_s = ARRIVAL_S if post.t is None else PAUSE_S
                wrong = _jump(before.tcp_pose, pose, max(step_s, least_s))
        if self._clock is not None:
            self._clock.add(posted_s, arrived_ns)
        joints = post.joints_rad or ()
        stamps = Stamps(arrived_ns, time.time_ns(), posted_s)
        self._states.append(RobotState(stamps, joints, (), joints, pose))
        while self._states[0].stamps.controller_s < posted_s - HISTORY_S:
            self._states.popleft()
        span_s = posted_s - self._states[0].stamps.controller_s
        if span_s > max(RESTING_S, self._longest_gap_s * (len(self._states) - 1)):
            least = f"{1 / self._longest_gap_s:.0f} poses a second"
            self._notify(f"rest is seen from {least} on: post faster, or raise stillness.window_s")
        for callback in self._callbacks:
            callback(self._states[-1])
        self._first_pose.set()
        return wrong

    def _forget(self) -> None:
        """Forget what belongs to another clock."""
        self._states.clear()
        if self._clock is not None:
            self._clock = ClockEstimator(self._delay_s)

    def _notify(self, notice: str) -> None:
        if notice != self.notice:
            log.warning("%s", notice)
        self.notice, self._notice_since_s = notice, time.monotonic()


class _Answers:
    """Tells a program which of its lines are wrong, and waits for nothing."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self._writer = writer
        self._second_began_s = 0.0
        self._told = 0
        """Number of lines told within this second."""

    def tell(self, refused: list[Refused]) -> None:
        """Tell of some lines, as far as the program reads and `ANSWERS_PER_S` permits."""
        now_s = time.monotonic()
        if now_s - self._second_began_s >= 1.0:
            self._second_began_s = now_s
            self._told = 0
        link = self._writer.transport
        for one in refused[: ANSWERS_PER_S - self._told]:
            if link.is_closing() or link.get_write_buffer_size() > 0:
                return
            self._writer.write(msgspec.json.encode(one._asdict()) + b"\n")
            self._told += 1


async def _gives(token: bytes, reader: asyncio.StreamReader) -> bool:
    """Tell whether a program's first line is the token."""
    try:
        first = await asyncio.wait_for(reader.readline(), FIRST_LINE_S)
    except (TimeoutError, ValueError, OSError):  # ValueError: a line that never ends; OSError: it is gone
        return False
    return secrets.compare_digest(first.strip(), token)


async def _lines(reader: asyncio.StreamReader) -> AsyncIterator[list[bytes]]:
    """Yield the whole lines of each piece; a line that never ends is cut."""
    rest = b""
    while data := await reader.read(READ_BYTES):
        *lines, rest = (rest + data).split(b"\n")
        if len(rest) > LINE_BYTES:
            lines, rest = [*lines, rest[:LINE_BYTES]], b""
        if lines:
            yield lines
        await asyncio.sleep(PAUSE_S)


def _jump(before: Vector6, after: Vector6, seconds: float) -> StaleStateError | None:
    """Make the error for a way that no arm goes in this time; None: it may."""
    distance_m = math.dist(before[:3], after[:3])
    if distance_m <= JUMP_M_S * seconds:
        if before[3:] == after[3:]:
            return None
        angle_rad = float(rotation_angle(rotation_exp(before[3:]).T @ rotation_exp(after[3:])))
        if angle_rad <= JUMP_RAD_S * seconds:
            return None
        way = f"{math.degrees(angle_rad):.0f}°"
    else:
        way = f"{1000 * distance_m:.0f} mm"
    return StaleStateError("post-jump", way=way, seconds=seconds)


def _name_of(link: socket.socket) -> str:
    """Name the program at the other end: 'python3 (process 4711)'."""
    if link.family is not socket.AF_UNIX:
        return "a program by TCP"
    pid = peer_of(link)[0]
    with contextlib.suppress(OSError):
        return f"{Path(f'/proc/{pid}/comm').read_text().strip()} (process {pid})"
    return f"pid {pid}"
