"""Registers, inputs and outputs, and TCP sockets of a script."""

from __future__ import annotations

import errno
import re
import socket
from collections.abc import Generator

from station.simulation.controller.state import DIGITAL_BANKS, ControllerState
from station.simulation.controller.urscript import ScriptRuntimeError, Value
from station.simulation.controller.urscript_parser import Builtin

Wait = Generator[None, None, Value]
OPEN_S = 2.0
"""Longest time that a connection may take to open."""
READ_LIMIT = 1 << 20
READS_PER_CYCLE = 10
"""Whose data never ends waits a cycle after so many reads: threads share the controller's time."""


# -- registers ------------------------------------------------------------------------------------------


def registers(robot: ControllerState) -> dict[str, Builtin]:
    """`read_input_…_register`, `read_output_…` and `write_output_…` for integers, floats and booleans."""

    def name(side: str, kind: str, address: int) -> str:
        found = f"{side}_{kind}_register_{address}"
        if found not in robot.outputs.types:
            raise ScriptRuntimeError(f"there is no {found}")
        return found

    def bits(side: str, address: int) -> tuple[str, int]:
        """The variable, and the bit in it."""
        if 0 <= address < 64:
            return f"{side}_bit_registers{'0_to_31' if address < 32 else '32_to_63'}", address % 32
        return name(side, "bit", address), 0

    def write_bit(address: int, value: bool) -> None:
        variable, bit = bits("output", address)
        others = int(robot.outputs.get(variable)) & ~(1 << bit)
        robot.outputs.set(variable, others | bool(value) << bit)

    def write_integer(address: int, value: int) -> None:
        if type(value) is not int or not -(2**31) <= value < 2**31:
            raise ScriptRuntimeError(f"{value!r} is no integer of 32 bits")
        robot.outputs.set(name("output", "int", address), value)

    def write_float(address: int, value: float) -> None:
        robot.outputs.set(name("output", "double", address), float(value))

    def read(side: str) -> dict[str, Builtin]:
        store = robot.inputs if side == "input" else robot.outputs

        def boolean(address: int) -> bool:
            variable, bit = bits(side, address)
            return bool(int(robot.outputs.get(variable)) >> bit & 1)

        return {
            f"read_{side}_boolean_register": boolean,
            f"read_{side}_integer_register": lambda address: int(store.get(name(side, "int", address))),
            f"read_{side}_float_register": lambda address: float(store.get(name(side, "double", address))),
        }

    return {
        "write_output_boolean_register": write_bit,
        "write_output_integer_register": write_integer,
        "write_output_float_register": write_float,
        **read("input"),
        **read("output"),
    }


# -- inputs and outputs ---------------------------------------------------------------------------------


def inputs_and_outputs(robot: ControllerState) -> dict[str, Builtin]:
    def digital(bank: str, number: int) -> int:
        first, count = DIGITAL_BANKS[bank]
        if not 0 <= number < count:
            raise ScriptRuntimeError(f"there is no {bank} digital {number}")
        return first + number

    def read(side: str, bank: str, n: int) -> bool:
        return bool(int(robot.outputs.get(f"actual_digital_{side}_bits")) >> digital(bank, n) & 1)

    def write(bank: str, n: int, b: bool) -> None:
        bit = digital(bank, n)
        robot.set_digital_outputs(1 << bit, bool(b) << bit)

    def legacy(n: int) -> tuple[str, int]:
        return ("standard", n) if n < 8 else ("tool", n - 8)

    def domain(port: int, domain: int) -> None:
        types = int(robot.outputs.get("analog_io_types"))
        bit = 1 << 2 + int(port)
        robot.outputs.set("analog_io_types", types | bit if domain else types & ~bit)

    found: dict[str, Builtin] = {
        "set_digital_out": lambda n, b: write(*legacy(n), b),
        "get_digital_out": lambda n: read("output", *legacy(n)),
        "get_digital_in": lambda n: read("input", *legacy(n)),
        "set_standard_analog_out": robot.set_analog_output,
        "set_analog_out": robot.set_analog_output,
        "set_analog_outputdomain": domain,
        "get_standard_analog_in": lambda n: robot.outputs.get(f"standard_analog_input{int(n)}"),
        "get_analog_in": lambda n: robot.outputs.get(f"standard_analog_input{int(n)}"),
        "get_tool_analog_in": lambda n: robot.outputs.get(f"tool_analog_input{int(n)}"),
        "set_tool_voltage": lambda voltage: robot.outputs.set("tool_output_voltage", int(voltage)),
    }
    for bank in DIGITAL_BANKS:
        found[f"set_{bank}_digital_out"] = lambda n, b, bank=bank: write(bank, n, b)
        found[f"get_{bank}_digital_out"] = lambda n, bank=bank: read("output", bank, n)
        found[f"get_{bank}_digital_in"] = lambda n, bank=bank: read("input", bank, n)
    return found


# -- sockets --------------------------------------------------------------------------------------------


class Sockets:
    """A program's connections by name. Nothing here blocks: who waits does so cycle by cycle."""

    def __init__(self, robot: ControllerState) -> None:
        self._robot = robot
        self._reads = (0, 0)
        """In which cycle, and how many."""
        self._open: dict[str, tuple[socket.socket, bytearray]] = {}

    def close(self) -> None:
        for link, _ in self._open.values():
            link.close()
        self._open.clear()

    def builtins(self) -> dict[str, Builtin]:
        return {name: getattr(self, name) for name in vars(Sockets) if name.startswith("socket_")}

    def socket_send_int(self, value: int, socket_name: str = "socket_0") -> bool:
        return self._send(int(value).to_bytes(4, "big", signed=True), socket_name)

    def socket_send_byte(self, value: int, socket_name: str = "socket_0") -> bool:
        return self._send(bytes([int(value) & 255]), socket_name)

    def socket_send_string(self, str: object, socket_name: str = "socket_0") -> bool:
        return self._send(f"{str}".encode(), socket_name)

    def socket_send_line(self, str: object, socket_name: str = "socket_0") -> bool:
        return self._send(f"{str}\n".encode(), socket_name)

    def socket_set_var(self, name: str, value: object, socket_name: str = "socket_0") -> bool:
        return self._send(f"SET {name} {value}\n".encode(), socket_name)

    def socket_open(self, address: str, port: int, socket_name: str = "socket_0") -> Wait:
        self.socket_close(socket_name)
        link = socket.socket()
        link.setblocking(False)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            for _ in range(self._robot.cycles(OPEN_S)):
                state = link.connect_ex((str(address), int(port)))
                if state in (0, errno.EISCONN):
                    self._open[socket_name] = (link, bytearray())
                    return True
                if state not in (errno.EINPROGRESS, errno.EALREADY):
                    break
                yield
        except OSError:
            pass  # the name means nothing here
        finally:
            if socket_name not in self._open:
                link.close()
        return False

    def socket_close(self, socket_name: str = "socket_0") -> None:
        if socket_name in self._open:
            self._open.pop(socket_name)[0].close()

    def _send(self, data: bytes, name: str) -> bool:
        if name not in self._open:
            return False
        try:
            return self._open[name][0].send(data) == len(data)
        except OSError:
            return False

    def _fill(self, name: str) -> bytearray:
        """Read what has arrived. A connection that the other side ended is gone once all of it was read."""
        if name not in self._open:
            return bytearray()
        link, buffer = self._open[name]
        try:
            while len(buffer) < READ_LIMIT and (data := link.recv(65536)):
                buffer += data
        except BlockingIOError:
            return buffer
        except OSError:
            pass
        if not buffer:
            self.socket_close(name)
        return buffer

    def _take(self, name: str, timeout: float, pattern: bytes | int) -> Generator[None, None, bytes | None]:
        """The next so many bytes, or up to what matches; None when they do not come in time (0: for ever)."""
        left = self._robot.cycles(timeout) if timeout > 0 else 0
        cycle, count = self._reads
        self._reads = (self._robot.ticks, count + 1 if cycle == self._robot.ticks else 1)
        if self._reads[1] > READS_PER_CYCLE:
            yield
        while True:
            buffer = self._fill(name)
            if isinstance(pattern, int):
                end = pattern if len(buffer) >= pattern else 0
            else:
                match = re.search(pattern, buffer)
                end = match.end() if match else 0
            if end:
                taken = bytes(buffer[:end])
                del buffer[:end]
                return taken
            if timeout > 0 and left == 0:
                return None
            left -= 1
            yield
            if name not in self._open:
                return None

    def socket_read_binary_integer(
        self, number: int, socket_name: str = "socket_0", timeout: float = 2
    ) -> Wait:
        taken = yield from self._take(socket_name, timeout, 4 * int(number))
        if taken is None:
            return [0, *[-1] * int(number)]
        parts = (taken[i : i + 4] for i in range(0, len(taken), 4))
        return [int(number), *(int.from_bytes(part, "big", signed=True) for part in parts)]

    def socket_read_byte_list(self, number: int, socket_name: str = "socket_0", timeout: float = 2) -> Wait:
        taken = yield from self._take(socket_name, timeout, int(number))
        return [0, *[-1] * int(number)] if taken is None else [int(number), *taken]

    def socket_read_ascii_float(self, number: int, socket_name: str = "socket_0", timeout: float = 2) -> Wait:
        taken = yield from self._take(socket_name, timeout, rb"\([^)]*\)\s*")
        try:
            values = [float(v) for v in taken.decode().strip(" \r\n()").split(",")] if taken else []
        except ValueError:
            values = []
        return [len(values), *values] if len(values) == int(number) else [0, *[float("nan")] * int(number)]

    def socket_read_line(self, socket_name: str = "socket_0", timeout: float = 2) -> Wait:
        taken = yield from self._take(socket_name, timeout, rb"\n")
        return "" if taken is None else taken.decode(errors="replace").rstrip("\r\n")

    def socket_read_string(
        self,
        socket_name: str = "socket_0",
        prefix: str = "",
        suffix: str = "",
        interpret_escape: bool = False,
        timeout: float = 2,
    ) -> Wait:
        begin, end = (re.escape(text.encode()) for text in (prefix, suffix))
        inside = rb"[\s\S]*?" if suffix else rb"[\s\S]+"
        taken = yield from self._take(socket_name, timeout, begin + inside + end)
        if taken is None:
            return ""
        text = taken.decode(errors="replace")
        text = text[text.find(prefix) + len(prefix) :]
        return text.removesuffix(suffix)

    def socket_get_var(self, name: str, socket_name: str = "socket_0", timeout: float = 2) -> Wait:
        self._send(f"GET {name}\n".encode(), socket_name)
        answer = yield from self.socket_read_line(socket_name, timeout)
        words = answer.split()
        return int(float(words[1])) if len(words) == 2 else 0
