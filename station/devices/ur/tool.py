"""Checks of TCP and payload: our flange pose must agree with the controller's tool pose and TCP offset.

flange_from_tcp = forward(joints)⁻¹ · base_from_tcp, from one and the same sample. It must be the offset that
the controller states, and it must not change. The controller uses the factory calibration of its arm, which
differs from our nominal table by some millimetres. So the check is precise only when controller or
configuration give the calibrated kinematics.

The controller states both on its primary interface (port 30001, read-only), ten times a second. One message =
int32 size, uint8 type (16 = robot state), then sub-packages of int32 size, uint8 type, payload; everything
big-endian. Source: Universal Robots, "Remote control via TCP/IP: client interfaces".
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calibrate.arms.kinematics import RobotModel, forward
from recordings.geometry import Array, difference, inverse, pose_from_vector, vector_from_pose
from recordings.schema.messages import ArmKinematics, RobotState, Vector6
from station.cell.config import vector6
from station.cell.errors import RobotError
from station.cell.stillness import RESTING_RAD_S, fastest_rad_s
from station.devices.ur.stream import Payload, Sample

log = logging.getLogger(__name__)

PORT = 30001
ROBOT_STATE = 16
ROBOT_MESSAGE = 20
KEY_MESSAGE = 7
PROGRAM_STARTED = b"PROGRAM_XXX_STARTED"
CARTESIAN_INFO = 4
KINEMATICS_INFO = 5
MESSAGE_LIMIT = 64 * 1024
SILENCE_S = 3.0
RETRY_S = 0.5
_HEADER = struct.Struct(">iB")
_CARTESIAN = struct.Struct(">12d")
"""TCP pose, then TCP offset: x y z [m], rotation vector [rad] each"""
_KINEMATICS = struct.Struct(">6I24dI")
"""Checksum per joint; theta, a, d, alpha of all joints; calibration status"""
_KEY = struct.Struct(">QbBiiB")
"""Time, source, kind, code, argument, length of the title; title and text follow"""
NOMINAL_TOLERANCE = (0.006, math.radians(1.0))
CALIBRATED_TOLERANCE = (0.0005, math.radians(0.1))
STATED_TOLERANCE = (1e-6, 1e-6)
LATE_TOLERANCE = (1e-4, math.radians(0.01))
FACTORY_LIMIT = (0.02, math.radians(2.0))
LONGEST_M = 1.0
PAYLOAD_TOLERANCE_KG = 0.005
CENTRE_TOLERANCE_M = 0.001
SKEW_S = 0.016
"""Largest time between joints and tool pose of one sample: two cycles of a CB3."""


@dataclass(frozen=True)
class Installation:
    tcp_offset: Vector6 | None = None
    """flange_from_tcp as set on the pendant: metres, rotation vector (rad)"""
    dh: tuple[Vector6, Vector6, Vector6, Vector6] | None = None
    """theta, a, d, alpha of this arm (standard Denavit-Hartenberg), factory corrections included; sent once,
    at the beginning of a connection"""


class PrimaryError(RobotError):
    """Port 30001 does not speak the primary interface."""

    code = "primary-interface"


def read_state(payload: bytes) -> Installation:
    """Parse the sub-packages of a robot state message. PrimaryError for impossible sizes."""
    offset: Vector6 | None = None
    dh: tuple[Vector6, Vector6, Vector6, Vector6] | None = None
    at = 0
    while at + _HEADER.size <= len(payload):
        size, kind = _HEADER.unpack_from(payload, at)
        if size < _HEADER.size or at + size > len(payload):
            raise PrimaryError(reason=f"a part of the robot state claims {size} bytes")
        body = payload[at + _HEADER.size : at + size]
        if kind == CARTESIAN_INFO and len(body) >= _CARTESIAN.size:
            offset = _six(_CARTESIAN.unpack_from(body)[6:])
        elif kind == KINEMATICS_INFO and len(body) >= _KINEMATICS.size:
            v = _KINEMATICS.unpack_from(body)[6:30]
            dh = _six(v[0:6]), _six(v[6:12]), _six(v[12:18]), _six(v[18:24])
        at += size
    return Installation(offset, dh)


def program_started(payload: bytes) -> str:
    """Parse a robot message: name of a program that started; empty for any other message."""
    if len(payload) < _KEY.size:
        return ""
    *_, kind, _, _, length = _KEY.unpack_from(payload)
    title, text = payload[_KEY.size : _KEY.size + length], payload[_KEY.size + length :]
    named = kind == KEY_MESSAGE and title == PROGRAM_STARTED
    return text.decode("utf-8", errors="replace") if named else ""


def _six(values: Sequence[float]) -> Vector6:
    if not all(map(math.isfinite, values)):
        raise PrimaryError(reason="the robot state holds a number that is not finite")
    return vector6(values)


class PrimaryReader:
    """Reads TCP offset and kinematics, by a new connection where one ends. Sends nothing."""

    def __init__(self, host: str) -> None:
        self.installation = Installation()
        self.started = ""
        """Name of the program that started last."""
        self._host = host
        self._first = asyncio.Event()
        self._task = asyncio.create_task(self._run(), name=f"installation of {host}")

    async def first(self) -> Installation:
        """Wait for the first state; empty when the port is closed, or none comes in time (firewall)."""
        with contextlib.suppress(TimeoutError):  # of a controller that sends other messages only
            async with asyncio.timeout(2 * SILENCE_S):
                await self._first.wait()
        return self.installation

    async def _run(self) -> None:
        while True:
            with contextlib.suppress(OSError, EOFError, PrimaryError):
                await self._read()
            self._first.set()
            await asyncio.sleep(RETRY_S)

    async def _read(self) -> None:
        """Read until the connection ends. Raises OSError, EOFError, PrimaryError."""
        async with asyncio.timeout(SILENCE_S):
            reader, writer = await asyncio.open_connection(self._host, PORT, limit=MESSAGE_LIMIT)
        try:
            while True:
                async with asyncio.timeout(SILENCE_S):
                    kind, payload = await _message(reader)
                if kind == ROBOT_STATE:
                    self._learn(read_state(payload))
                elif kind == ROBOT_MESSAGE:
                    self.started = program_started(payload) or self.started
        finally:
            writer.transport.abort()

    def _learn(self, news: Installation) -> None:
        known = self.installation
        self.installation = Installation(news.tcp_offset or known.tcp_offset, news.dh or known.dh)
        self._first.set()

    async def close(self) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)


async def _message(reader: asyncio.StreamReader) -> tuple[int, bytes]:
    size, kind = _HEADER.unpack(await reader.readexactly(_HEADER.size))
    if not _HEADER.size <= size <= MESSAGE_LIMIT:
        raise PrimaryError(reason=f"a message claims {size} bytes")
    return kind, await reader.readexactly(size - _HEADER.size)


class TcpCheck:
    """Check of the TCP offset. `model`: the arm's, with the configured calibration if `calibrated`."""

    def __init__(
        self, model: RobotModel, calibrated: bool, first: RobotState, installation: Installation
    ) -> None:
        """Take the offset at connect. RobotError when pose, kinematics and stated offset do not agree."""
        self._model = model
        self._tolerance = CALIBRATED_TOLERANCE if calibrated else NOMINAL_TOLERANCE
        self._source: Literal["controller", "configuration"] | None = "configuration" if calibrated else None
        self._stated = installation.tcp_offset
        if not calibrated and installation.dh is not None and self._stated is not None:
            theta, a, d, alpha = installation.dh
            stated = replace(model, theta_rad=theta, a_m=a, d_m=d, alpha_rad=alpha)
            self._try_controllers_model(stated, first)
        if self._stated is None and fastest_rad_s(first) > RESTING_RAD_S:
            raise RobotError("tcp-moving")  # derived in motion, it would be millimetres off
        self._first = _flange_from_tcp(self._model, first)
        length_m = float(np.linalg.norm(self._first[:3, 3]))
        if length_m > LONGEST_M:
            raise RobotError("tcp-too-far", model=model.name, distance_m=length_m, limit_m=LONGEST_M)
        if self._stated is not None:
            stated_tool = pose_from_vector(self._stated)
            _compare(self._first, stated_tool, _widened(self._tolerance, first), "tcp-mismatch", model.name)
            self._first = stated_tool

    def _try_controllers_model(self, model: RobotModel, first: RobotState) -> None:
        """Use the controller's own kinematics if they explain its tool pose.

        Raises RobotError when they are of another model: a factory calibration moves the flange by only
        millimetres (though single lengths may differ much, where axes are parallel).
        """
        assert self._stated is not None
        ours, theirs = (forward(m, first.joints_rad) for m in (self._model, model))
        _compare(theirs, ours, FACTORY_LIMIT, "other-kinematics", self._model.name)
        own = _flange_from_tcp(model, first)
        if _exceeds(difference(own, pose_from_vector(self._stated)), _widened(CALIBRATED_TOLERANCE, first)):
            log.warning("the kinematics stated by the controller do not explain its tool pose; using ours")
            return
        self._model, self._tolerance = model, CALIBRATED_TOLERANCE
        self._source = "controller"

    @property
    def stated(self) -> bool:
        """False where the offset was derived, as the controller did not state it."""
        return self._stated is not None

    @property
    def kinematics(self) -> ArmKinematics | None:
        """Calibrated table of this arm that explains the controller's tool pose; None: the published one."""
        m = self._model
        if self._source is None:
            return None
        numbers = (vector6(column) for column in (m.a_m, m.d_m, m.alpha_rad, m.theta_rad))
        return ArmKinematics(m.name, self._source, *numbers)

    @property
    def offset(self) -> Vector6:
        """flange_from_tcp: x y z [m], rotation vector [rad]; stated by the controller, else computed."""
        if self._stated is not None:
            return self._stated
        return vector6(vector_from_pose(self._first))

    def agree(self, stated: Vector6) -> None:
        """Raise RobotError unless the offset that the control program reads is the one taken at connect."""
        _compare(self._first, pose_from_vector(stated), self._tolerance, "tcp-mismatch", self._model.name)

    def check(self, state: RobotState, installation: Installation) -> None:
        """Raise RobotError when the TCP on the pendant differs from that at connect, or from the one derived
        there because the controller did not state it.

        In motion the tolerance of the tool pose is larger, that of the stated offset is not.
        """
        if (offset := installation.tcp_offset) is not None and offset != self.offset:
            tolerance, code = STATED_TOLERANCE, "tcp-changed"
            if self._stated is None:  # first stated after connecting: poses were computed with another one
                tolerance, code = LATE_TOLERANCE, "tcp-late"
            _compare(
                pose_from_vector(offset), pose_from_vector(self.offset), tolerance, code, self._model.name
            )
        now = _flange_from_tcp(self._model, state)
        _compare(now, self._first, _widened(self._tolerance, state), "tcp-changed", self._model.name)


class Tool:
    """What is on the flange, as it was taken at connect: TCP offset, the kinematics behind it, payload.

    It holds over lost connections, until `forget`. `calibrated`: the model's kinematics are the configured
    ones of this arm.
    """

    def __init__(self, host: str, model: RobotModel, calibrated: bool) -> None:
        self._host = host
        self._model = model
        self._calibrated = calibrated
        self._primary: PrimaryReader | None = None
        self._tcp: TcpCheck | None = None
        self._payload: Payload | None = None
        self.relied_on = False
        """A picture or a motion relies on the TCP offset taken at connect."""

    async def open(self) -> Installation:
        """Begin to read what the controller states; return its first statement, which may be empty."""
        self._primary = PrimaryReader(self._host)
        return await self._primary.first()

    async def close(self) -> None:
        """End the connection; what was taken stays."""
        primary, self._primary = self._primary, None
        if primary is not None:
            await primary.close()

    def forget(self) -> None:
        self._tcp = None
        self._payload = None
        self.relied_on = False

    def take(self, first: Sample, stated: Installation) -> None:
        """Take the tool of a new connection, or hold it against the one taken before. Raises RobotError."""
        if self._payload is None:
            self._payload = first.payload
        if self._tcp is None:
            self._tcp = self._checked(first.state, stated)
        else:
            self._tcp.check(first.state, stated)

    def take_late_offset(self, state: Callable[[], RobotState]) -> bool:
        """Take the TCP offset that the controller states after connecting, where nothing relies on ours.

        `state`: asks for the arm's. True: it was taken.
        """
        told = self._primary.installation if self._primary is not None else Installation()
        if told.tcp_offset is None or self._tcp is None or self._tcp.stated or self.relied_on:
            return False
        self._tcp = self._checked(state(), told)
        return True

    def _checked(self, state: RobotState, stated: Installation) -> TcpCheck:
        return TcpCheck(self._model, self._calibrated, state, stated)

    def check(self, sample: Sample) -> None:
        """Raise RobotError when TCP or payload differ from those at connect; works in motion, too."""
        if self._tcp is not None and self._primary is not None:
            self._tcp.check(sample.state, self._primary.installation)
        if self._payload is not None:
            check_payload(sample.payload, self._payload)

    def agree(self, stated: Vector6) -> None:
        """Raise RobotError unless the offset that the control program reads is the one taken at connect."""
        if self._tcp is not None:
            self._tcp.agree(stated)

    @property
    def offset(self) -> Vector6:
        """flange_from_tcp: x y z [m], rotation vector [rad]; zero before it is taken."""
        return self._tcp.offset if self._tcp is not None else (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def kinematics(self) -> ArmKinematics | None:
        return self._tcp.kinematics if self._tcp is not None else None

    @property
    def payload(self) -> tuple[float, ...]:
        """Mass (kg) and centre (m, in `flange`) at connect; empty: not reported."""
        return (self._payload.mass_kg, *self._payload.centre_m) if self._payload is not None else ()

    @property
    def program_started(self) -> str:
        """Name of the program that started last, as far as the robot told."""
        return self._primary.started if self._primary is not None else ""

    def forget_program(self) -> None:
        if self._primary is not None:
            self._primary.started = ""


def check_payload(now: Payload, first: Payload) -> None:
    """Raise RobotError when the payload on the pendant differs from that at connect."""
    centre_off_m = math.dist(now.centre_m, first.centre_m)
    same_mass = abs(now.mass_kg - first.mass_kg) <= PAYLOAD_TOLERANCE_KG
    if not (same_mass and centre_off_m <= CENTRE_TOLERANCE_M):  # nor is NaN the same
        raise RobotError(
            "payload-changed", before_kg=first.mass_kg, now_kg=now.mass_kg, centre_off_m=centre_off_m
        )


def _flange_from_tcp(model: RobotModel, state: RobotState) -> Array:
    return inverse(forward(model, state.joints_rad)) @ pose_from_vector(state.tcp_pose)


def _widened(tolerance: tuple[float, float], state: RobotState) -> tuple[float, float]:
    """Add what joints and tool pose of one sample can be apart while the arm moves."""
    turned_rad = SKEW_S * sum(map(abs, state.joint_speeds_rad_s))
    reach_m = float(np.linalg.norm(state.tcp_pose[:3])) + LONGEST_M
    return tolerance[0] + turned_rad * reach_m, tolerance[1] + turned_rad


def _exceeds(delta: Array, tolerance: tuple[float, float]) -> bool:
    """Tell whether a pose difference (6,), m and rad, is above a tolerance; NaN is above every one."""
    near = np.linalg.norm(delta[:3]) <= tolerance[0] and np.linalg.norm(delta[3:]) <= tolerance[1]
    return not near


def _compare(found: Array, reference: Array, tolerance: tuple[float, float], code: str, model: str) -> None:
    delta = difference(found, reference)
    if _exceeds(delta, tolerance):
        shift_m, turn_rad = float(np.linalg.norm(delta[:3])), float(np.linalg.norm(delta[3:]))
        raise RobotError(
            code,
            model=model,
            shift_m=shift_m,
            limit_m=tolerance[0],
            turn_rad=turn_rad,
            limit_rad=tolerance[1],
        )
