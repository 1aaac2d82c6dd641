"""Registers, inputs and outputs of a script."""

from __future__ import annotations

from collections.abc import Generator

from station.simulation.controller.state import DIGITAL_BANKS, ControllerState
from station.simulation.controller.urscript import ScriptRuntimeError, Value
from station.simulation.controller.urscript_parser import Builtin

Wait = Generator[None, None, Value]


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
