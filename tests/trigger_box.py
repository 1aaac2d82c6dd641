"""Simulated trigger box on a pseudo terminal, with the faults of real ones."""

from __future__ import annotations

import os
import select
import threading
import time
import tty
from collections.abc import Callable

from station.devices.serial_trigger import PRODUCT, PROTOCOL, frame, unframe

_COUNTS = 1 << 32
_SERIAL = "SIM1"


class SimulatedTriggerBox:
    """Trigger box served by a thread. `port` is the path to open; `on_pulse` is called for every pulse.

    Faults are attributes that last until set back.
    """

    def __init__(self, on_pulse: Callable[[], None] = lambda: None) -> None:
        self.on_pulse = on_pulse
        self.product = PRODUCT
        """Product name; another one simulates another device on this port"""
        self.count = 0
        self.silent = False
        self.garbage = b""
        """Bytes sent before every answer"""
        self.cut_answers = 0
        """Number of next answers that are cut in the middle, without a newline"""
        self._boot_id = "00000001"
        self._start_s = time.monotonic()
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._stop_read, self._stop_write = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="trigger box", daemon=True)
        self._thread.start()

    def reset(self) -> None:
        """Simulate a short power failure: the count is 0, the boot id changes."""
        self._boot_id = f"{int(self._boot_id, 16) + 1:08x}"
        self.count = 0
        self._start_s = time.monotonic()

    def unplug(self) -> None:
        """Remove the port. Idempotent."""
        if self._thread.is_alive():
            os.write(self._stop_write, b"x")
            self._thread.join()
            for descriptor in (self._master, self._slave, self._stop_read, self._stop_write):
                os.close(descriptor)

    def __enter__(self) -> SimulatedTriggerBox:
        return self

    def __exit__(self, *_: object) -> None:
        self.unplug()

    def _serve(self) -> None:
        rest = b""
        while True:
            ready, _, _ = select.select([self._master, self._stop_read], [], [])
            if self._stop_read in ready:
                return
            *lines, rest = (rest + os.read(self._master, 4096)).split(b"\n")
            for text in filter(None, map(unframe, lines)):
                answer = self._answer(text.split())
                if not self.silent:
                    self._send(frame(answer))

    def _send(self, line: bytes) -> None:
        if self.cut_answers > 0:
            self.cut_answers -= 1
            line = line[: len(line) // 2]
        os.write(self._master, self.garbage + line)

    def _answer(self, words: list[str]) -> str:
        match words:
            case ["ID?"]:
                return f"ID {self.product} {PROTOCOL} {_SERIAL}"
            case ["STATUS?"]:
                return f"STATUS {self._boot_id} {self.count}"
            case ["FIRE", width] if width.isdecimal() and 10 <= int(width) <= 100_000:
                self.count = (self.count + 1) % _COUNTS
                self.on_pulse()
                return f"FIRED {self._boot_id} {self.count} {self._uptime_us()}"
        return f"ERR {' '.join(words)}"

    def _uptime_us(self) -> int:
        return int((time.monotonic() - self._start_s) * 1e6)
