"""The trigger box's lines: ASCII, ended by a newline, each with a checksum. See docs/trigger-box.md."""

from __future__ import annotations

from functools import reduce

LINE_LIMIT = 120
"""Bytes; a longer line is garbage."""
BAUD = 115_200
PRODUCT = "calibration-trigger"
PROTOCOL = "1"


def checksum(text: str) -> str:
    """XOR of all bytes as two hexadecimal digits, as in NMEA 0183."""
    return f"{reduce(lambda a, b: a ^ b, text.encode('ascii'), 0):02X}"


def frame(text: str) -> bytes:
    return f"{text}*{checksum(text)}\n".encode("ascii")


class LineReader:
    """Bytes in, good lines out. Whatever else comes is counted and skipped up to the next newline."""

    def __init__(self) -> None:
        self.bad_lines = 0
        self._pending = bytearray()
        self._overlong = False

    def feed(self, data: bytes) -> list[str]:
        """Contents of the complete good lines, without checksum. Never raises; memory is bounded."""
        good = []
        *ended_pieces, rest = data.split(b"\n")
        for piece, ended in [*((p, True) for p in ended_pieces), (rest, False)]:
            if len(self._pending) + len(piece) > LINE_LIMIT:
                self._overlong = True
                self._pending.clear()
            elif not self._overlong:
                self._pending += piece
            if not ended:
                continue
            text = None if self._overlong else _checked(bytes(self._pending))
            self._pending.clear()
            self._overlong = False
            if text is None:
                self.bad_lines += 1
            else:
                good.append(text)
        return good

    def restart(self) -> None:
        """Forgets a line that has only begun: what comes next starts a new one."""
        self.bad_lines += bool(self._pending) or self._overlong
        self._pending.clear()
        self._overlong = False


def _checked(line: bytes) -> str | None:
    try:
        # A space is under the checksum; a carriage return stands behind it.
        text, _, given = line.decode("ascii").rstrip("\r").rpartition("*")
    except UnicodeDecodeError:
        return None
    return text if text and given == checksum(text) else None
