"""The controller's state: settings, registers, arm and modes, published once per cycle.

Programs see and change this; `robot` adds what the controller does by itself. The RTDE variables are those of
`variables.csv`; names and types: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". A row's `cb3` and
`e_series` say from which version a controller of that series has it; empty: never.
"""

from __future__ import annotations

import logging
import random
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from station.devices.rtde import (
    DATA_TYPES,
    RobotMode,
    RobotStatusBits,
    RuntimeState,
    SafetyMode,
    SafetyStatus,
)
from station.simulation.controller.arm import History, SimulatedArm
from station.simulation.controller.kinematics import (
    IDENTITY,
    TABLES,
    ArmGeometry,
    Rigid,
    Vector,
    compose,
    forward,
    from_pose,
    read_table,
    to_pose,
    to_rotvec,
    turn_between,
)

log = logging.getLogger(__name__)

ENTRIES = 20_000
CB3_VERSION = (3, 15, 8, 106339)
E_SERIES_VERSION = (5, 11, 1, 108318)
_SAFETY_BITS = {
    SafetyMode.NORMAL: SafetyStatus.NORMAL,
    SafetyMode.REDUCED: SafetyStatus.REDUCED,
    SafetyMode.PROTECTIVE_STOP: SafetyStatus.PROTECTIVE_STOPPED | SafetyStatus.STOPPED_DUE_TO_SAFETY,
    SafetyMode.SAFEGUARD_STOP: SafetyStatus.SAFEGUARD_STOPPED | SafetyStatus.STOPPED_DUE_TO_SAFETY,
    SafetyMode.ROBOT_EMERGENCY_STOP: SafetyStatus.ROBOT_EMERGENCY_STOPPED
    | SafetyStatus.EMERGENCY_STOPPED
    | SafetyStatus.STOPPED_DUE_TO_SAFETY,
}


Six = Annotated[Vector, Meta(min_length=6, max_length=6)]
ZEROS: Vector = (0.0,) * 6


class ArmTruth(msgspec.Struct, frozen=True, kw_only=True):
    """What is true of a simulated arm and its controller, whatever the controller states."""

    start_joints_rad: Six
    seed: int = 0
    robot_sigma_m: float = 0.0
    """Repeatability: 1σ of the flange's position per axis, drawn at every stop."""
    robot_sigma_rad: float = 0.0
    dh_delta_a_m: Six = ZEROS
    """Systematic error: true minus the controller's a, per joint."""
    dh_delta_d_m: Six = ZEROS
    dh_delta_alpha_rad: Six = ZEROS
    dh_delta_theta_rad: Six = ZEROS
    factory_a_m: Six = ZEROS
    """Factory calibration: the controller's minus the published a, per joint."""
    factory_d_m: Six = ZEROS
    factory_alpha_rad: Six = ZEROS
    factory_theta_rad: Six = ZEROS


class Settings(ArmTruth, frozen=True, kw_only=True):
    model: str = "UR10"
    start_joints_rad: Six = (0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0)
    serial: str = "20263000001"
    time_scale: Annotated[float, Meta(gt=0)] = 1.0
    """The arm moves this many times faster than it says; clocks stay real. For tests."""
    remote: bool = True

    def differences(self, of: str) -> list[Vector]:
        return [getattr(self, f"{of}_{column}") for column in ("a_m", "d_m", "alpha_rad", "theta_rad")]

    @property
    def is_e_series(self) -> bool:
        return self.model.endswith("e")

    @property
    def version(self) -> tuple[int, ...]:
        return E_SERIES_VERSION if self.is_e_series else CB3_VERSION

    @property
    def rate_hz(self) -> int:
        return 500 if self.is_e_series else 125


class Journal:
    """The newest entries in full; counts per (source, verb) of all of them, never forgotten."""

    def __init__(self) -> None:
        self._entries: deque[dict[str, Any]] = deque(maxlen=ENTRIES)
        self._counts: Counter[str] = Counter()

    def note(self, source: str, verb: str, **details: object) -> None:
        """source: dashboard, script, upload, rtde or controller (what it did by itself).

        An `error` among the details also goes to standard error: no client is told why its program ended.
        """
        self._counts[f"{source}: {verb}"] += 1
        self._entries.append({"monotonic_ns": time.monotonic_ns(), "source": source, "verb": verb, **details})
        if error := details.get("error"):
            log.warning("%s: %s", verb, error)

    def count(self, source: str, verb: str) -> None:
        """Count what comes many times a second."""
        self._counts[f"{source}: {verb}"] += 1

    @property
    def counts(self) -> dict[str, int]:
        return dict(self._counts)

    def entries(self, since_ns: int = 0) -> list[dict[str, Any]]:
        return [entry for entry in self._entries if entry["monotonic_ns"] >= since_ns]


@dataclass(frozen=True)
class Variable:
    type: str
    series: tuple[bool, bool]
    """Whether controllers of CB3, and of the e-Series, have it."""
    rest: tuple[float, ...]
    """Its value while nothing else is known; () is zero."""


def _read() -> dict[str, dict[str, Variable]]:
    found: dict[str, dict[str, Variable]] = {"input": {}, "output": {}}
    for row in read_table("variables.csv"):
        series = bool(row["cb3"]), bool(row["e_series"])
        variable = Variable(row["type"], series, tuple(map(float, row["rest"].split())))
        stem, _, span = row["name"].rpartition("_")
        first, dash, last = span.partition("-")
        numbers = range(int(first), int(last) + 1) if dash else ()
        names = [f"{stem}_{i}" for i in numbers] or [row["name"]]
        found[row["direction"]] |= dict.fromkeys(names, variable)
    return found


VARIABLES = _read()
"""input and output → name → what it is. Registers 0–23 are for field buses, 24–47 for RTDE clients; here
both halves are writable."""


class VariableStore:
    """Values of named variables in one flat list, so that a recipe is packed by one index lookup."""

    def __init__(self, variables: dict[str, Variable], e_series: bool) -> None:
        self.types = {name: v.type for name, v in variables.items() if v.series[e_series]}
        """Variables that clients of this controller may ask for; the others have values too."""
        self._slots: dict[str, slice] = {}
        self.elements: list[float] = []
        for name, variable in variables.items():
            start, codes = len(self.elements), DATA_TYPES[variable.type]
            make = float if codes[0] == "d" else int
            self.elements += map(make, variable.rest or (0,) * len(codes))
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


class ControllerState:
    def __init__(self, settings: Settings, journal: Journal) -> None:
        self.settings = settings
        self.journal = journal
        self.dt_s = 1.0 / settings.rate_hz
        self.table = TABLES[settings.model].plus(*settings.differences("factory"))
        """Factory-calibrated, as port 30001 states it."""
        self.true_table: ArmGeometry = self.table.plus(*settings.differences("dh_delta"))
        self._random = random.Random(settings.seed)
        self.arm = SimulatedArm(self.table, settings.start_joints_rad, self._draw_miss)
        self.tcp: Vector = (0.0,) * 6
        self.payload_kg = 0.0
        self.payload_cog: Vector = (0.0,) * 3
        self.robot_mode = RobotMode.RUNNING
        self.safety_mode = SafetyMode.NORMAL
        self.runtime_state = RuntimeState.STOPPED
        self.remote = settings.remote
        self.watchdog_s = 0.0
        """Longest silence of `watched`, an input variable, that is allowed; 0 = none."""
        self.watched = ""
        self.tell: Callable[[str], None] = lambda program: None
        """Says to the clients of the primary interface that a program started."""
        self.clear()

    def clear(self) -> None:
        """Time 0, empty registers; installation and the arm's place survive."""
        self.ticks, self.time_s, self.slider = 0, 0.0, 1.0
        self.history = History(self.dt_s)
        self._posed: dict[str, tuple[Vector, Vector, Rigid]] = {}
        """Actual or target → joints, TCP and pose of the tool as they were computed last."""
        self.inputs, self.outputs = (
            VariableStore(VARIABLES[side], self.settings.is_e_series) for side in ("input", "output")
        )

    def cycles(self, seconds: float) -> int:
        return max(1, round(seconds / self.dt_s))

    def _draw_miss(self) -> Vector:
        m, rad = self.settings.robot_sigma_m, self.settings.robot_sigma_rad
        return tuple(self._random.gauss(0.0, sigma) for sigma in (m, m, m, rad, rad, rad))

    def _publish_tool(self, side: str, joints: Vector) -> None:
        """Pose and speed of the tool, actual or target; the speed by the pose of the cycle before."""
        before_joints, before_tcp, before = self._posed.get(side, ((), (), IDENTITY))
        speed: Vector = ZEROS
        if before_joints is not joints or before_tcp is not self.tcp:
            tool = compose(forward(self.table, joints), from_pose(self.tcp))
            self._posed[side] = joints, self.tcp, tool
            self.outputs.set(f"{side}_TCP_pose", *to_pose(tool))
            if before_tcp is self.tcp:
                moved = (*(tool[i] - before[i] for i in (3, 7, 11)), *to_rotvec(turn_between(before, tool)))
                speed = tuple(distance / self.dt_s for distance in moved)
        self.outputs.set(f"{side}_TCP_speed", *speed)

    def publish(self) -> None:
        """The present state as RTDE output variables."""
        out, arm = self.outputs, self.arm
        out.set("timestamp", self.time_s)
        out.set("target_q", *arm.command)
        out.set("actual_q", *arm.actual)
        out.set("target_qd", *arm.command_speed)
        out.set("actual_qd", *arm.actual_speed)
        self._publish_tool("actual", arm.actual)
        self._publish_tool("target", arm.command)
        out.set("target_speed_fraction", self.slider)
        out.set("speed_scaling", min(1.0, arm.scale / self.slider) if self.slider > 0 else 1.0)
        out.set("payload", self.payload_kg)
        out.set("payload_cog", *self.payload_cog)
        out.set("tcp_offset", *self.tcp)
        out.set("robot_mode", self.robot_mode)
        out.set("safety_mode", self.safety_mode)
        out.set("safety_status", self.safety_mode)
        out.set("safety_status_bits", _SAFETY_BITS[self.safety_mode])
        out.set("runtime_state", self.runtime_state)
        powered = self.robot_mode in (RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.RUNNING)
        playing = self.runtime_state == RuntimeState.PLAYING
        bits = (RobotStatusBits.POWER_ON if powered else 0) | (
            RobotStatusBits.PROGRAM_RUNNING if playing else 0
        )
        out.set("robot_status_bits", bits)
