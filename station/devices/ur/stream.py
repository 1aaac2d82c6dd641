"""Reader of the controller's state at its full rate, keeping every sample. Read-only.

The kernel stamps and keeps what comes while the event loop is busy. A reader lasts as long as its connection;
for the next connection a new one is made.
"""

from __future__ import annotations

import asyncio
import math
import socket
import struct
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from recordings.schema.messages import RobotState, Stamps
from station.cell.errors import StaleStateError
from station.devices.clocks import ClockEstimator, monotonic_from_wall_ns
from station.devices.history import HISTORY_S
from station.devices.rtde import HANDSHAKE_S, PORT, PacketType, Recipe, RtdeError, RtdeLink
from station.devices.ur.dashboard import connect_trouble

SILENCE_S = 2.0
"""Time without data after which the connection is closed."""
SO_TIMESTAMPNS = 35
"""Linux, 64 bit: receive time by the kernel, wall clock; `socket` does not name it."""
RECEIVE_BUFFER_BYTES = 1 << 20
ROUND_TRIPS, QUICK_S = 10, 0.002
"""So often the controller is asked for a quick answer: half of it bounds the time of every state."""
READ_BYTES = 1 << 16
POLL_S = 0.005
WALL_STEP_NS = 1_000_000
"""Change of the wall clock between two packets above which it was set, not slewed."""
_TIMESPEC = struct.Struct("@qq")
_ANCILLARY_BYTES = socket.CMSG_SPACE(_TIMESPEC.size)

NAMES = (
    "timestamp", "actual_q", "actual_qd", "target_q", "actual_TCP_pose", "robot_mode", "safety_mode",
    "safety_status_bits", "runtime_state", "robot_status_bits", "speed_scaling", "target_speed_fraction",
    "output_int_register_2",
)  # fmt: skip
PAYLOAD_SINCE = {3: (3, 11), 5: (5, 5)}
"""First minor version, per major version, that reports the payload."""


class Payload(NamedTuple):
    """The payload on the flange as set on the pendant."""

    mass_kg: float = 0.0
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of gravity, in `flange`."""


class Sample(NamedTuple):
    state: RobotState
    operation: int
    """Status word of asynchronous moves, see `moves`."""
    payload: Payload


class StateReader:
    """Reader of the state stream of one connection, in the event loop.

    `on_state` is called for every state, in order; it must be quick. `on_end` is called once with the reason
    when the connection ends, unless it was never open or is closed here.
    """

    def __init__(
        self, host: str, on_state: Callable[[RobotState], None], on_end: Callable[[str], None]
    ) -> None:
        self.host = host
        self.version: tuple[int, int, int, int] = (0, 0, 0, 0)
        self.rate_hz = 0.0
        self.newest: Sample | None = None
        self.history: deque[RobotState] = deque(maxlen=1)
        self.clock = ClockEstimator()
        self.stands_still = False
        """True when the controller time of the newest packet did not advance."""
        self.not_finite = False
        """True when a number of the newest packet was NaN or infinite: it told nothing."""
        self.ended: str | None = None
        """Why the connection is over; None while it lives."""
        self._on_state = on_state
        self._on_end = on_end
        self._link = socket.socket()
        self._following = False
        """True while states come: after the handshake, until the end."""
        self._heard_s = 0.0
        """When data came last (host monotonic)."""
        self._wall_ahead_ns = _wall_ahead_ns()
        self._wall_set_ns = 0
        """When the wall clock was last seen to have been set (host monotonic)."""

    async def open(self) -> Sample:
        """Connect and return the first state. Raises RobotError."""
        try:
            self._rtde, self._recipe = await asyncio.to_thread(self._connect)
            self._follow()
            give_up_s = time.monotonic() + SILENCE_S
            while self.newest is None and self.ended is None:
                if self.not_finite and (late_s := time.monotonic() - give_up_s) > 0:
                    raise StaleStateError("state-not-finite", age_s=SILENCE_S + late_s, limit_s=SILENCE_S)
                await asyncio.sleep(POLL_S)
        except BaseException as error:
            self.close(_reason(error, self.host))
            if not isinstance(error, OSError | RtdeError):
                raise
        if self.newest is None:
            raise RtdeError(reason=f"robot state of {self.host}: {self.ended}")
        return self.newest

    def close(self, why: str = "closed here") -> None:
        self._on_end = lambda _: None
        self._end(why)

    def _end(self, why: str) -> None:
        if self.ended is None:
            self.ended, self._following = why, False
            asyncio.get_running_loop().remove_reader(self._link)
            self._link.close()
            self._on_end(why)

    def read(self) -> None:
        """Read all that has arrived.

        To be called before the age of the newest state is judged: what this computer had no time to read
        counts as come.
        """
        try:
            for _ in range(RECEIVE_BUFFER_BYTES // READ_BYTES):
                if not self._following or self._read_once() < READ_BYTES:
                    return
        except BlockingIOError:
            pass
        except (OSError, RtdeError) as error:
            self._end(_reason(error, self.host))

    def _read_once(self) -> int:
        data, ancillary, _, _ = self._link.recvmsg(READ_BYTES, _ANCILLARY_BYTES)
        if not data:
            raise RtdeError(reason="the robot closed the connection")
        self._heard_s = time.monotonic()
        monotonic_ns, wall_ns = self._arrival(ancillary)
        for kind, payload in self._rtde.packets.feed(data):
            self._take(kind, payload, monotonic_ns, wall_ns)
        return len(data)

    def _connect(self) -> tuple[RtdeLink, Recipe]:
        """Connect and agree on the variables; blocking."""
        # A controller skips samples when the receiver's buffer is full; this one holds seconds.
        self._link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        self._link.settimeout(HANDSHAKE_S)
        self._link.connect((self.host, PORT))
        link = RtdeLink(self._link)
        return link, self._handshake(link)

    def _handshake(self, link: RtdeLink) -> Recipe:
        trips_s: list[float] = []
        while len(trips_s) < ROUND_TRIPS and min(trips_s, default=1.0) > QUICK_S:
            begun = time.perf_counter()
            self.version = link.version()
            trips_s.append(time.perf_counter() - begun)
        self.clock.latency_s = min(trips_s) / 2
        self.rate_hz = 500.0 if self.version[0] > 3 else 125.0
        self.history = deque(maxlen=int(HISTORY_S * self.rate_hz) + 1)
        names: tuple[str, ...] = NAMES
        if self.version[:2] >= PAYLOAD_SINCE.get(self.version[0], (0, 0)):
            names += ("payload", "payload_cog")
        recipe = link.outputs(self.rate_hz, names)
        link.start()
        return recipe

    def _follow(self) -> None:
        self._link.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._link.setblocking(False)
        self._heard_s, self._following = time.monotonic(), True
        for kind, payload in self._rtde.pending:
            self._take(kind, payload, time.monotonic_ns(), time.time_ns())
        asyncio.get_running_loop().add_reader(self._link, self.read)
        self._expect()

    def _expect(self) -> None:
        """End a connection that is silent for `SILENCE_S`."""
        self.read()
        if self._following and time.monotonic() > self._heard_s + SILENCE_S:
            self._end(f"no data from the robot for {SILENCE_S:g} s")
        elif self._following:
            asyncio.get_running_loop().call_later(SILENCE_S / 4, self._expect)

    def _take(self, kind: int, payload: bytes, monotonic_ns: int, wall_ns: int) -> None:
        if kind != PacketType.DATA:
            return
        v = self._recipe.unpack_elements(payload)
        # What guards motion compares numbers, and NaN is neither above nor below any limit.
        self.not_finite = not all(map(math.isfinite, v))
        if self.not_finite:
            return
        controller_s = v[0]
        before = self.newest
        if before is not None:
            if controller_s == before.state.stamps.controller_s:
                self.stands_still = True
                return
            if controller_s < before.state.stamps.controller_s:
                self.history.clear()  # the controller's clock went back
        state = RobotState(
            stamps=Stamps(host_monotonic_ns=monotonic_ns, host_wall_ns=wall_ns, controller_s=controller_s),
            joints_rad=v[1:7],
            joint_speeds_rad_s=v[7:13],
            target_joints_rad=v[13:19],
            tcp_pose=v[19:25],  # type: ignore[arg-type]  # struct gave exactly six
            robot_mode=int(v[25]),
            safety_mode=int(v[26]),
            safety_status_bits=int(v[27]),
            runtime_state=int(v[28]),
            robot_status_bits=int(v[29]),
            speed_scaling=v[30],
            target_speed_fraction=v[31],
        )
        self.stands_still = False
        self.clock.add(controller_s, monotonic_ns)
        self.history.append(state)
        self.newest = Sample(
            state, int(v[32]), Payload(v[33], (v[34], v[35], v[36])) if len(v) > 33 else Payload()
        )
        self._on_state(state)

    def _arrival(self, ancillary: list[tuple[int, int, bytes]]) -> tuple[int, int]:
        """Return host monotonic and wall time of the newest bytes, from the kernel's stamp.

        A stamp from before the wall clock was set is replaced by the time now. Otherwise an old stamp is
        right, also after a long halt of this process.
        """
        ahead_ns = _wall_ahead_ns()
        if abs(ahead_ns - self._wall_ahead_ns) > WALL_STEP_NS:
            self._wall_set_ns = time.monotonic_ns()
        self._wall_ahead_ns = ahead_ns
        for level, kind, value in ancillary:
            if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS:
                seconds, ns = _TIMESPEC.unpack(value)
                wall_ns = seconds * 1_000_000_000 + ns
                arrived_ns = monotonic_from_wall_ns(wall_ns)
                if self._wall_set_ns < arrived_ns <= time.monotonic_ns():
                    return arrived_ns, wall_ns
        return time.monotonic_ns(), time.time_ns()


def _reason(error: BaseException, host: str) -> str:
    """Say why a connection failed or ended."""
    if isinstance(error, TimeoutError):
        return f"no answer from {host}:{PORT} within {HANDSHAKE_S:g} s"
    if isinstance(error, ConnectionResetError):
        return "the robot reset the connection"
    if isinstance(error, ConnectionRefusedError):
        return connect_trouble(error, "RTDE service")
    return str(error)


def _wall_ahead_ns() -> int:
    """Return wall minus monotonic time; the smaller of two readings, in case one was interrupted."""
    return min(-time.monotonic_ns() + time.time_ns() for _ in range(2))


class TraceRecorder:
    """Recorder of every state between `begin` and `end`, over a connection of its own; reusable."""

    def __init__(self, host: str) -> None:
        self._host = host
        self._states: list[RobotState] = []
        self._reader: StateReader | None = None

    async def begin(self) -> None:
        """Begin recording; return once samples come. RobotError when none do."""
        self._states = []
        self._reader = StateReader(self._host, self._states.append, lambda _: None)
        await self._reader.open()

    async def end(self) -> list[RobotState]:
        """End recording; return all samples since `begin`, in order, as long as the connection lasted."""
        if self._reader is not None:
            self._reader.close()
        return self._states
