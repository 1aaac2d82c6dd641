"""Serial trigger box.

The only module that uses `serial`. All waiting happens in one worker thread.
"""

from __future__ import annotations

import termios
import time
from functools import reduce
from typing import Any

from recordings.plain_text import device_text
from station.cell.config import TriggerConfig
from station.cell.errors import TriggerError
from station.devices.base import DeviceThread
from station.devices.frames import TriggerPulse

ANSWER_TIMEOUT_S = 1.0
HANDSHAKE_TIMEOUT_S = 3.0
"""Time for the first answer: many boards restart when their port is opened, which takes two seconds."""
_COUNTS = 1 << 32
LINE_LIMIT = 120
"""Longest valid line, bytes."""
BAUD = 115_200
PRODUCT = "calibration-trigger"
PROTOCOL = "1"


def checksum(text: str) -> str:
    """Compute the XOR of all bytes as two hexadecimal digits, as in NMEA 0183."""
    return f"{reduce(lambda a, b: a ^ b, text.encode('ascii'), 0):02X}"


def frame(text: str) -> bytes:
    return f"{text}*{checksum(text)}\n".encode("ascii")


def unframe(line: bytes) -> str | None:
    """Return a line's text, without checksum; None for an invalid line."""
    try:
        # Trailing spaces are part of the checksum, a carriage return follows it.
        text, _, given = line.decode("ascii").rstrip("\r\n").rpartition("*")
    except UnicodeDecodeError:
        return None
    return text if text and given == checksum(text) else None


class SerialTrigger:
    """Trigger box on a serial line; all methods raise TriggerError."""

    def __init__(self, config: TriggerConfig) -> None:
        self._config = config
        self._port: Any = None
        self._worker = DeviceThread("trigger")
        self._boot_id = ""
        self._opened = False
        self._count = self._first_count = 0
        """Pulses now and at opening, unwrapped: the box's own count overflows at 2^32."""

    @property
    def pulses(self) -> int:
        """Pulses since the box was opened, from any cause."""
        return self._count - self._first_count

    async def open(self) -> str:
        return await self._worker.run(self._connect)

    async def fire(self) -> TriggerPulse:
        return await self._worker.run(self._fire)

    async def close(self) -> None:
        self._opened = False
        await self._worker.close(self._disconnect)

    def _connect(self) -> str:
        self._disconnect()
        self._opened = True
        try:
            self._port = _open_port(self._config.port)
        except (OSError, ValueError) as error:
            raise TriggerError("trigger-port", port=self._config.port, reason=str(error)) from error
        self._count = self._first_count = 0
        try:
            return self._handshake()
        except TriggerError:
            self._disconnect()
            raise

    def _handshake(self) -> str:
        end_s = time.monotonic() + HANDSHAKE_TIMEOUT_S
        while True:
            try:
                product, protocol, serial = self._ask("ID?", "ID", 3, timeout_s=ANSWER_TIMEOUT_S / 2)
                break
            except _BoxSilentError as error:
                if time.monotonic() > end_s:
                    found = "does not answer like a trigger box"
                    raise TriggerError("no-trigger-box", port=self._config.port, found=found) from error
        if (product, protocol) != (PRODUCT, PROTOCOL):
            found = f"is '{product}' with protocol {protocol}, not {PRODUCT} with protocol {PROTOCOL}"
            raise TriggerError("no-trigger-box", port=self._config.port, found=found)
        self._boot_id, count = self._status()
        self._count = self._first_count = count
        return f"{product} {device_text(serial)}"

    def _fire(self) -> TriggerPulse:
        if not self._opened:
            raise TriggerError("trigger-not-open")
        if self._port is None:
            self._connect()  # it was lost; counting restarts
        asked_ns = time.monotonic_ns()
        try:
            boot_id, count = self._ask(f"FIRE {self._config.pulse_us}", "FIRED", 2)
        except _BoxSilentError:
            # Ask whether the camera was triggered: its next frame must not be taken for another trigger's.
            before = self._count
            self._settle_count(*self._status())
            if (self._count - before) != 1:
                raise TriggerError("pulse-count", pulses=self._count - before) from None
            bound_s = (time.monotonic_ns() - asked_ns) / 2e9
            return TriggerPulse(self._count, asked_ns + round(bound_s * 1e9), bound_s)
        answered_ns = time.monotonic_ns()
        self._settle_count(boot_id, _number(count))
        return TriggerPulse(self._count, (asked_ns + answered_ns) // 2, (answered_ns - asked_ns) / 2e9)

    def _settle_count(self, boot_id: str, count: int) -> None:
        if boot_id != self._boot_id:
            self._disconnect()
            raise TriggerError("trigger-restarted")
        self._count += (count - self._count) % _COUNTS

    def _status(self) -> tuple[str, int]:
        """Ask for boot id and count of pulses."""
        try:
            boot_id, count = self._ask("STATUS?", "STATUS", 2)
        except _BoxSilentError as error:
            raise TriggerError("trigger-lost", port=self._config.port, reason=str(error)) from error
        return boot_id, _number(count)

    def _ask(self, request: str, answer: str, fields: int, timeout_s: float = ANSWER_TIMEOUT_S) -> list[str]:
        """Send a request; return the first fields of its answer. Other lines are skipped."""
        port = self._port
        end_s = time.monotonic() + timeout_s
        try:
            port.reset_input_buffer()
            port.write(frame(request))
            while time.monotonic() < end_s:
                words = (unframe(port.read_until(b"\n", LINE_LIMIT)) or "").split()
                if words[:1] == [answer] and len(words) > fields:
                    return words[1 : fields + 1]
                if words[:1] == ["ERR"]:
                    raise TriggerError("trigger-refused", request=request, reason=" ".join(words[1:]))
        except (OSError, termios.error) as error:  # pyserial's SerialException is an OSError
            self._disconnect()
            raise TriggerError("trigger-lost", port=self._config.port, reason=str(error)) from error
        raise _BoxSilentError(request=request, limit_s=timeout_s)

    def _disconnect(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            port.close()


class _BoxSilentError(TriggerError):
    code = "no-answer"


def _number(text: str) -> int:
    if not text.isdecimal():
        raise TriggerError("garbled-lines", what=f"'{text}' where a number belongs")
    return int(text)


def _open_port(path: str) -> Any:
    import serial

    port = serial.Serial()
    port.port, port.baudrate = path, BAUD
    port.timeout = port.write_timeout = 0.1
    port.exclusive = True
    port.rts = port.dtr = False
    port.open()
    return port
