"""A GigE Vision camera of our own, written from the registers and packets of the standard, without Aravis.

It judges the driver: simulator and driver share Aravis, so neither can show the other's faults. It speaks
GVCP (discovery, registers, control privilege, heartbeat, packet resend, test packets) and GVSP (16- and
64-bit ids), and can be told to do wrong. Run it only where there is no network but `lo`.
Facts of the protocol: GigE Vision 2.0 as Wireshark's dissectors (packet-gvcp.c, packet-gvsp.c) name them.
"""

from __future__ import annotations

import itertools
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from tests.gige_vision import description as at
from tests.gige_vision.pixels import encode, numbered_picture

CONTROL_PORT = 3956
_RESEND, _TICK_HZ = 0x0040, 125_000_000
_NOT_IMPLEMENTED, _INVALID_ADDRESS = 0x8001, 0x8003
_ACCESS_DENIED, _UNAVAILABLE, _RESENT = 0x8006, 0x800C, 0x0100
_PRIVILEGE, _HEARTBEAT, _CAPABILITY = 0xA00, 0x938, 0x934
_STREAM_PORT, _STREAM_ADDRESS = 0xD00, 0xD18
_CAPABILITIES = (
    0x4000_0000 | 0x8_0000 | 0b111
)  # serial number, IEEE 1588, resend, write memory, concatenation
_EXTENDED_IDS, _FIRE_TEST, _LATCH = 0x4000_0000, 0x8000_0000, 2
_LEADER, _TRAILER, _PAYLOAD, _EXTENDED = 1, 2, 3, 0x80
_IMAGE = 0x0001
"""Type of payload"""
_IP_UDP = 28
_KEPT_FRAMES = 8
Picture = Callable[[int, int, int], NDArray[np.uint8]]
"""(number, width, height) → grey, (height, width)"""
Packets = list[bytes]


class _RefusedError(Exception):
    """A request that is answered by an error status."""

    def __init__(self, status: int) -> None:
        self.status = status


class EmulatedCamera:
    """One camera at a loopback address, from `with` on. What is public may be changed while it runs."""

    def __init__(
        self,
        address: str = "127.0.0.1",
        serial: str = "EMU00001",
        *,
        size: tuple[int, int] = (1280, 1024),
        picture: Picture = numbered_picture,
        ids: Iterable[int] | None = None,
        extended_ids: bool = False,
    ) -> None:
        """`ids`: of the frames; by default 1 … 65535 and again."""
        self.address, self.serial, self.size = address, serial, size
        self.picture = picture
        self.ids = iter(itertools.cycle(range(1, 65_536)) if ids is None else ids)
        self.mangle: Callable[[Packets], Iterable[bytes]] = lambda packets: packets
        """Lose, reorder or copy a frame's packets as they are sent first."""
        self.stamp_error_ns = 0
        """Added to every stamp"""
        self.mtu = 9000
        """Larger packets do not arrive."""
        self.acknowledges_only = False
        """Triggers are acknowledged and ignored."""
        self.frozen = False
        """It hears nothing and sends nothing."""
        self.forgets = False
        """Nothing can be sent again."""
        self.frames = self.resent = self.unavailable = self.refused = 0
        self.exposed_ns: list[tuple[int, int]] = []
        """Host monotonic start and end of every exposure"""
        self._memory = bytearray(at.XML_AT)
        self._xml = at.zipped()
        self._controller: tuple[str, int] | None = None
        self._heard_s = 0.0
        self._kept: dict[int, Packets] = {}
        self._triggered = threading.Event()
        self._exposing = False
        self._ending, self._end = socket.socketpair()
        self._ended = threading.Event()
        self._fill(extended_ids)

    def __enter__(self) -> EmulatedCamera:
        self._control = _bound(self.address)
        self._broadcasts = _bound("255.255.255.255")
        self._stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stream.bind((self.address, 0))
        self._stream.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8 << 20)
        self._threads = [threading.Thread(target=run, daemon=True) for run in (self._answer, self._expose)]
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Cut its power: nobody is told."""
        self._ended.set()
        self._triggered.set()
        self._end.close()
        for thread in self._threads:
            thread.join()
        for link in (self._control, self._broadcasts, self._stream, self._ending):
            link.close()

    # -- registers

    def register(self, address: int, length: int = 4) -> int:
        return int.from_bytes(self._memory[address : address + length], "big")

    def set_register(self, address: int, value: int, length: int = 4) -> None:
        self._memory[address : address + length] = value.to_bytes(length, "big")

    def number(self, address: int) -> float:
        return float(struct.unpack_from(">d", self._memory, address)[0])

    def set_number(self, address: int, value: float) -> None:
        struct.pack_into(">d", self._memory, address, value)

    def pulse(self) -> None:
        """An edge on the line that is chosen as the trigger."""
        if self.register(at.TRIGGER_SOURCE) != at.TRIGGER_SOURCES["Software"]:
            self._trigger()

    @property
    def controlled(self) -> bool:
        """A client has the control privilege, and its heartbeat is not overdue."""
        return self._controller is not None

    def _ticks(self, host_ns: int) -> int:
        """The free-running clock as stamps and latch show it."""
        return (host_ns + 7_000_000_000_000) * _TICK_HZ // 1_000_000_000

    def _fill(self, extended_ids: bool) -> None:
        width, height = self.size
        for address, value in (
            (0x000, 0x0002_0000), (0x004, 0x8000_0001), (0x008, 0x0000_0200), (0x010, 0b111), (0x014, 0b001),
            (0x034, 0xFF00_0000), (0x600, 1), (0x904, 1), (0x92C, 0x4000_0000), (_CAPABILITY, _CAPABILITIES),
            (_HEARTBEAT, 3000), (at.PACKET_SIZE, 1400),
            (at.GVSP_CONFIGURATION, _EXTENDED_IDS * extended_ids),
            (at.WIDTH, width), (at.HEIGHT, height), (at.SENSOR_WIDTH, width), (at.SENSOR_HEIGHT, height),
            (at.PIXEL_FORMAT, at.PIXEL_FORMATS["Mono8"]), (at.ACQUISITION_MODE, 2), (at.EXPOSURE_AUTO, 2),
            (at.GAIN_AUTO, 2), (at.LINE_SELECTOR, 1),
        ):  # fmt: skip
            self.set_register(address, value)
        for address, number in ((at.EXPOSURE, 5000.0), (at.GAIN, 0.0)):
            self.set_number(address, number)
        self.set_register(at.TICK_HZ, _TICK_HZ, 8)
        last = int(self.address.rsplit(".", 1)[1])
        self.set_register(0x00C, 0x0000_0000 | last)
        self._memory[0x24:0x28] = socket.inet_aton(self.address)
        url = f"Local:camera.zip;{at.XML_AT:X};{len(self._xml):X}"
        for address, text in (
            (0x48, "Judge"), (0x68, "Emulated"), (0x88, "1.0"), (0xA8, "emulated for tests"),
            (0xD8, self.serial), (0x200, url),
        ):  # fmt: skip
            self._memory[address : address + len(text)] = text.encode()

    # -- control

    def _answer(self) -> None:
        while True:
            ready, _, _ = select.select([self._ending, self._control, self._broadcasts], [], [], 0.1)
            if self._ending in ready:
                return
            overdue_s = self.register(_HEARTBEAT) / 1e3
            if self._controller is not None and time.monotonic() - self._heard_s > overdue_s:
                self._release()
            for link in ready:
                request, client = link.recvfrom(2048)
                if not self.frozen and len(request) >= 8 and request[0] == 0x42:
                    self._answer_one(request, client)

    def _answer_one(self, request: bytes, client: tuple[str, int]) -> None:
        flags, command, _, number = struct.unpack_from(">xBHHH", request)
        if client == self._controller:
            self._heard_s = time.monotonic()
        try:
            status, data = 0, self._carry_out(command, flags, request[8:], client)
        except _RefusedError as refused:
            status, data = refused.status, b""
            self.refused += 1
        if flags & 1 and command != _RESEND:
            self._control.sendto(struct.pack(">HHHH", status, command + 1, len(data), number) + data, client)

    def _carry_out(self, command: int, flags: int, data: bytes, client: tuple[str, int]) -> bytes:
        match command:
            case 0x0002:
                return bytes(self._memory[:0xF8])
            case 0x0080:
                return b"".join(self._read(a, 4) for (a,) in struct.iter_unpack(">I", data))
            case 0x0082:
                pairs = list(struct.iter_unpack(">I4s", data))
                for address, value in pairs:
                    self._write(address, value, client)
                return struct.pack(">HH", 0, len(pairs))
            case 0x0084:
                address, length = struct.unpack(">I2xH", data)
                return struct.pack(">I", address) + self._read(address, length)
            case 0x0086:
                self._write(struct.unpack_from(">I", data)[0], data[4:], client)
                return struct.pack(">HH", 0, len(data) - 4)
            case 0x0040:
                self._send_again(data, extended=bool(flags & 0x10))
                return b""
        raise _RefusedError(_NOT_IMPLEMENTED)

    def _read(self, address: int, length: int) -> bytes:
        if address >= at.XML_AT:
            found = self._xml[address - at.XML_AT : address - at.XML_AT + length]
            return found.ljust(length, b"\0")
        if address % 4 or address + length > len(self._memory):
            raise _RefusedError(_INVALID_ADDRESS)
        if address <= at.PAYLOAD_SIZE < address + length:
            self.set_register(at.PAYLOAD_SIZE, self._image_size())
        return bytes(self._memory[address : address + length])

    def _write(self, address: int, data: bytes, client: tuple[str, int]) -> None:
        value = int.from_bytes(data, "big")
        if address == _PRIVILEGE:
            self._grant(value, client)
            return
        if client != self._controller:
            raise _RefusedError(_ACCESS_DENIED)
        if address % 4 or address + len(data) > len(self._memory):
            raise _RefusedError(_INVALID_ADDRESS)
        self._memory[address : address + len(data)] = data
        match address:
            case at.TIMESTAMP_CONTROL if value & _LATCH:
                self.set_register(at.TIMESTAMP, self._ticks(time.monotonic_ns()), 8)
            case at.PACKET_SIZE if value & _FIRE_TEST:
                self.set_register(at.PACKET_SIZE, value & ~_FIRE_TEST)
                if value & 0xFFFF <= self.mtu:
                    self._stream.sendto(bytes((value & 0xFFFF) - _IP_UDP), self._client())
            case at.TRIGGER_SOFTWARE:
                if self.register(at.TRIGGER_SOURCE) == at.TRIGGER_SOURCES["Software"]:
                    self._trigger()
            case at.ACQUISITION:
                self._triggered.clear()

    def _grant(self, value: int, client: tuple[str, int]) -> None:
        if self._controller not in (None, client):
            raise _RefusedError(_ACCESS_DENIED)
        if value & 0b11:
            self._controller, self._heard_s = client, time.monotonic()
            self.set_register(_PRIVILEGE, value)
        else:
            self._release()

    def _release(self) -> None:
        """Reset as the standard asks when control is given up or its heartbeat fails."""
        self._controller = None
        for address in (_PRIVILEGE, at.ACQUISITION, _STREAM_PORT):
            self.set_register(address, 0)

    # -- stream

    def _client(self) -> tuple[str, int]:
        return socket.inet_ntoa(self._memory[_STREAM_ADDRESS : _STREAM_ADDRESS + 4]), self.register(
            _STREAM_PORT
        ) & 0xFFFF

    def _trigger(self) -> None:
        armed = self.register(at.ACQUISITION) and self.register(at.TRIGGER_MODE)
        if armed and not self._exposing and not self.acknowledges_only:
            self._triggered.set()

    def _expose(self) -> None:
        while not self._ended.is_set():
            if not self.register(at.ACQUISITION) or self.frozen:
                self._ended.wait(0.005)
            elif self._triggered.wait(0.05) and not self._ended.is_set():
                self._exposing = True
                self._triggered.clear()
                self._frame()
                self._exposing = False

    def _frame(self) -> None:
        exposure_us = self.number(at.EXPOSURE)
        start_ns = time.monotonic_ns()
        ticks = self._ticks(start_ns)
        width, height = self.register(at.WIDTH), self.register(at.HEIGHT)
        grey = self.picture(self.frames, width, height)
        self._ended.wait(max(0.0, exposure_us * 1e-6 - (time.monotonic_ns() - start_ns) / 1e9))
        self.exposed_ns.append((start_ns, start_ns + round(exposure_us * 1e3)))
        self._ended.wait(0.002)
        ticks += self.stamp_error_ns * _TICK_HZ // 1_000_000_000
        frame_id = next(self.ids)
        self.frames += 1
        packets = self._packets(frame_id, ticks, encode(np.ascontiguousarray(grey), self._format()))
        self._kept[frame_id] = packets
        while len(self._kept) > _KEPT_FRAMES:
            self._kept.pop(next(iter(self._kept)))
        self._send(self.mangle(list(packets)))

    def _format(self) -> str:
        value = self.register(at.PIXEL_FORMAT)
        return next(name for name, number in at.PIXEL_FORMATS.items() if number == value)

    def _image_size(self) -> int:
        bits = self.register(at.PIXEL_FORMAT) >> 16 & 0xFF
        return (self.register(at.WIDTH) * self.register(at.HEIGHT) * bits + 7) // 8

    def _packets(self, frame_id: int, ticks: int, image: bytes) -> Packets:
        extended = bool(self.register(at.GVSP_CONFIGURATION) & _EXTENDED_IDS)
        infos = [at.PIXEL_FORMAT, at.WIDTH, at.HEIGHT, at.OFFSET_X, at.OFFSET_Y]
        leader = struct.pack(
            ">HHQ5IHH", 0, _IMAGE, ticks & (1 << 64) - 1, *(self.register(a) for a in infos), 0, 0
        )
        room = (self.register(at.PACKET_SIZE) & 0xFFFF) - _IP_UDP - (20 if extended else 8)
        blocks = [image[i : i + room] for i in range(0, len(image), room)]
        trailer = struct.pack(">HHI", 0, _IMAGE, self.register(at.HEIGHT))
        parts = [(_LEADER, leader), *((_PAYLOAD, b) for b in blocks), (_TRAILER, trailer)]
        return [_packet(0, frame_id, kind, n, part, extended) for n, (kind, part) in enumerate(parts)]

    def _send(self, packets: Iterable[bytes]) -> None:
        client, delay_s = self._client(), self.register(at.PACKET_DELAY) / _TICK_HZ
        owed_s = 0.0
        for packet in packets:
            if not client[1] or self._ended.is_set():
                return
            if len(packet) + _IP_UDP <= self.mtu:
                self._stream.sendto(packet, client)
            owed_s += delay_s
            if owed_s > 0.001:
                time.sleep(owed_s)
                owed_s = 0.0

    def _send_again(self, data: bytes, *, extended: bool) -> None:
        if extended:
            first, last, frame_id = struct.unpack_from(">4xIIQ", data)
        else:
            frame_id, first, last = struct.unpack_from(">2xHII", data)
            first, last = first & 0xFF_FFFF, last & 0xFF_FFFF
        packets = self._kept.get(frame_id, [])
        for number in range(first, min(last, first + 5000) + 1):
            if number < len(packets) and not self.forgets:
                self.resent += 1
                self._stream.sendto(_marked_as_resent(packets[number], extended), self._client())
            else:
                self.unavailable += 1
                lost = _packet(_UNAVAILABLE, frame_id, _PAYLOAD, number, b"", extended)
                self._stream.sendto(lost, self._client())


def _packet(status: int, frame_id: int, kind: int, number: int, data: bytes, extended: bool) -> bytes:
    if extended:
        return struct.pack(">HHIQI", status, 0, (_EXTENDED | kind) << 24, frame_id, number) + data
    return struct.pack(">HHI", status, frame_id & 0xFFFF, kind << 24 | number) + data


def _marked_as_resent(packet: bytes, extended: bool) -> bytes:
    """By a flag beside 64-bit ids, else by the status."""
    return packet[:3] + b"\x01" + packet[4:] if extended else struct.pack(">H", _RESENT) + packet[2:]


def _bound(address: str) -> socket.socket:
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, address == "255.255.255.255")
    link.bind((address, CONTROL_PORT))
    return link
