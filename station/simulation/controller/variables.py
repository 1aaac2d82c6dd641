"""The RTDE variables this controller has, and the flat store of their present values.

Names and types: Universal Robots, "Real-Time Data Exchange (RTDE) Guide".
"""

from __future__ import annotations

from collections.abc import Sequence

from station.devices.rtde import DATA_TYPES

REGISTERS = 48
"""Per kind: 0–23 for field buses, 24–47 for RTDE clients; both halves are writable here."""

_OUTPUTS = {
    "DOUBLE": """timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum
        actual_main_voltage actual_robot_voltage actual_robot_current standard_analog_input0
        standard_analog_input1 standard_analog_output0 standard_analog_output1 io_current payload
        tcp_force_scalar tool_analog_input0 tool_analog_input1 tool_output_current""",
    "VECTOR6D": """target_q target_qd target_qdd target_current target_moment actual_q actual_qd
        actual_current joint_control_output actual_TCP_pose actual_TCP_speed actual_TCP_force
        target_TCP_pose target_TCP_speed joint_temperatures actual_joint_voltage ft_raw_wrench
        payload_inertia""",
    "VECTOR3D": "actual_tool_accelerometer payload_cog elbow_position elbow_velocity",
    "UINT64": "actual_digital_input_bits actual_digital_output_bits",
    "INT32": "robot_mode safety_mode safety_status tool_output_voltage",
    "UINT32": "runtime_state robot_status_bits safety_status_bits output_bit_registers0_to_31 "
    "output_bit_registers32_to_63 tool_mode",
    "VECTOR6INT32": "joint_mode",
}
OUTPUT_TYPES: dict[str, str] = {n: t for t, names in _OUTPUTS.items() for n in names.split()}
OUTPUT_TYPES |= {f"output_int_register_{i}": "INT32" for i in range(REGISTERS)}
OUTPUT_TYPES |= {f"output_double_register_{i}": "DOUBLE" for i in range(REGISTERS)}

E_SERIES_ONLY = frozenset({"ft_raw_wrench"})

INPUT_TYPES: dict[str, str] = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "external_force_torque": "VECTOR6D",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "input_bit_registers0_to_31": "UINT32",
    "input_bit_registers32_to_63": "UINT32",
}
INPUT_TYPES |= {
    f"{name}_output{mask}": "UINT8"
    for name in ("standard_digital", "configurable_digital", "tool_digital")
    for mask in ("_mask", "")
}
INPUT_TYPES |= {f"standard_analog_output_{name}": "UINT8" for name in ("mask", "type")}
INPUT_TYPES |= {f"input_int_register_{i}": "INT32" for i in range(REGISTERS)}
INPUT_TYPES |= {f"input_double_register_{i}": "DOUBLE" for i in range(REGISTERS)}


class VariableStore:
    """Values of named variables in one flat list, so that a recipe is packed by one index lookup."""

    def __init__(self, types: dict[str, str]) -> None:
        self.types = types
        self._slots: dict[str, slice] = {}
        self.elements: list[float] = []
        for name, type_name in types.items():
            start = len(self.elements)
            self.elements += [0.0 if DATA_TYPES[type_name].code == "d" else 0] * DATA_TYPES[type_name].count
            self._slots[name] = slice(start, len(self.elements))

    def indices(self, names: Sequence[str]) -> list[int]:
        """Places of the names' elements, in order."""
        return [i for name in names for i in range(self._slots[name].start, self._slots[name].stop)]

    def set(self, name: str, *values: float) -> None:
        self.elements[self._slots[name]] = values

    def get(self, name: str) -> float:
        """A scalar's value."""
        value: float = self.elements[self._slots[name].start]
        return value

    def vector(self, name: str) -> tuple[float, ...]:
        return tuple(self.elements[self._slots[name]])

    def write(self, names: Sequence[str], elements: Sequence[float]) -> None:
        """Elements of a received data packet, in the recipe's order."""
        start = 0
        for name in names:
            slot = self._slots[name]
            count = slot.stop - slot.start
            self.elements[slot] = elements[start : start + count]
            start += count
