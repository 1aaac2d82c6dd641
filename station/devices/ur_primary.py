"""The controller's primary interface (port 30001), read-only: the TCP offset and the arm's own kinematics.

RTDE tells the tool's pose but not the offset that is in it; here the controller states both, ten times a
second. One message = int32 size, uint8 type (16 = robot state), then sub-packages of int32 size, uint8 type,
payload; everything big-endian. Source: Universal Robots, "Remote control via TCP/IP: client interfaces".
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

from recordings.schema.messages import Vector6
from station.cell.errors import RobotError

PORT = 30001
ROBOT_STATE = 16
CARTESIAN_INFO = 4
KINEMATICS_INFO = 5
MESSAGE_LIMIT = 64 * 1024
SILENCE_S = 3.0
FIRST_S = 1.0
_HEADER = struct.Struct(">iB")
_CARTESIAN = struct.Struct(">12d")
"""TCP pose, then TCP offset: x y z [m], rotation vector [rad] each"""
_KINEMATICS = struct.Struct(">6I24dI")
"""Checksum per joint; theta, a, d, alpha of all joints; calibration status"""


@dataclass(frozen=True)
class DhParameters:
    """Standard Denavit-Hartenberg parameters of this very arm, factory corrections included."""

    theta_rad: Vector6
    a_m: Vector6
    d_m: Vector6
    alpha_rad: Vector6


@dataclass(frozen=True)
class Installation:
    tcp_offset: Vector6 | None = None
    """flange_from_tcp as set on the pendant"""
    dh: DhParameters | None = None
    """Sent once, at the beginning of a connection"""


class PrimaryError(RobotError):
    """Port 30001 does not speak the primary interface."""

    code = "primary-interface"


def read_state(payload: bytes) -> Installation:
    """The sub-packages of a robot state message. Raises PrimaryError on impossible sizes."""
    offset: Vector6 | None = None
    dh: DhParameters | None = None
    at = 0
    while at + _HEADER.size <= len(payload):
        size, kind = _HEADER.unpack_from(payload, at)
        if size < _HEADER.size or at + size > len(payload):
            raise PrimaryError(f"a sub-package of the robot state claims {size} bytes", size_bytes=size)
        body = payload[at + _HEADER.size : at + size]
        if kind == CARTESIAN_INFO and len(body) >= _CARTESIAN.size:
            offset = _six(_CARTESIAN.unpack_from(body)[6:])
        elif kind == KINEMATICS_INFO and len(body) >= _KINEMATICS.size:
            v = _KINEMATICS.unpack_from(body)[6:30]
            dh = DhParameters(_six(v[0:6]), _six(v[6:12]), _six(v[12:18]), _six(v[18:24]))
        at += size
    return Installation(offset, dh)


def _six(values: Sequence[float]) -> Vector6:
    if not all(map(math.isfinite, values)):
        raise PrimaryError("the robot state holds a number that is not finite")
    a, b, c, d, e, f = values
    return (a, b, c, d, e, f)


class PrimaryReader:
    """Follows the installation until the connection ends; `dead` then says why. Sends nothing, ever."""

    def __init__(self, host: str) -> None:
        self.installation = Installation()
        self.dead = ""
        self._host = host
        self._first = asyncio.Event()
        self._task = asyncio.create_task(self._run(), name=f"installation of {host}")

    async def first(self) -> Installation:
        """Waits for the first statement; empty when none comes in time (a firewalled or old controller)."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(FIRST_S):
                await self._first.wait()
        return self.installation

    async def _run(self) -> None:
        writer = None
        try:
            async with asyncio.timeout(SILENCE_S):
                reader, writer = await asyncio.open_connection(self._host, PORT, limit=MESSAGE_LIMIT)
            while True:
                async with asyncio.timeout(SILENCE_S):
                    kind, payload = await _message(reader)
                if kind == ROBOT_STATE:
                    self._learn(read_state(payload))
        except TimeoutError:
            self.dead = f"nothing came from {self._host}:{PORT} for {SILENCE_S:g} s"
        except (OSError, EOFError, PrimaryError) as error:
            self.dead = str(error) or type(error).__name__
        finally:
            self._first.set()
            if writer is not None:
                writer.transport.abort()

    def _learn(self, news: Installation) -> None:
        known = self.installation
        self.installation = Installation(news.tcp_offset or known.tcp_offset, news.dh or known.dh)
        if self.installation.tcp_offset is not None:
            self._first.set()

    async def close(self) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)


async def _message(reader: asyncio.StreamReader) -> tuple[int, bytes]:
    size, kind = _HEADER.unpack(await reader.readexactly(_HEADER.size))
    if not _HEADER.size <= size <= MESSAGE_LIMIT:
        raise PrimaryError(
            f"a message on port {PORT} claims {size} bytes",
            remedy="Check the robot's address.",
            size_bytes=size,
        )
    return kind, await reader.readexactly(size - _HEADER.size)
