"""Uploaded programs: URScript's interpreter, and what a script's calls do to this controller's arm.

Done is what the station's two control programs call, `ur_rtde`'s and its own. Of URScript's other functions
the names in `refused.csv` are known, so that a program that holds them is read; a call of one stops it.
Arguments have the names of Universal Robots' manual, "The URScript Programming Language".
"""

from __future__ import annotations

import math

from station.simulation.controller.arm import JointMotion
from station.simulation.controller.kinematics import Vector, read_table
from station.simulation.controller.state import ControllerState
from station.simulation.controller.urscript import (
    Builtin,
    List,
    Pose,
    ScriptRun,
    ScriptRuntimeError,
    Steps,
    Thread,
)
from station.simulation.controller.urscript_parser import NOT_SUPPORTED

REFUSED = tuple(row["name"] for row in read_table("refused.csv"))
KILLED_RAD_S2 = 40.0
"""Deceleration of an arm whose moving thread was killed and that nobody stops: very sudden."""


class InterpretedProgram:
    """A text from a script port, and its hold on the arm: one thread at a time moves it.

    Raises ScriptSyntaxError for a text that this interpreter cannot run.
    """

    def __init__(self, robot: ControllerState, name: str, text: str) -> None:
        self.name = name
        self._robot = robot
        self._mover: Thread | None = None
        """The thread that controls the arm."""
        self._orphan: JointMotion | None = None
        """Motion of a killed thread: another may move or stop in the same cycle, else the arm brakes."""
        counted = {name: self._counted(name) for name in REFUSED} | {
            name: self._counted(name, lambda *_: None)
            for name in ("force_mode_set_damping", "force_mode_set_gain_scaling")
        }
        self._run = ScriptRun(text, counted | self._builtins())

    def step(self) -> bool:
        """One cycle; False when the program has ended. Raises ScriptRuntimeError, UnreachableError."""
        goes_on = self._run.step()
        if self._orphan is not None and not self._orphan.done:
            self._robot.arm.brake(KILLED_RAD_S2)
        self._orphan = None
        return goes_on

    def end(self) -> None:
        """Kills every thread."""
        self._run.end()

    def _counted(self, name: str, function: Builtin | None = None) -> Builtin:
        """Wrap a function, None: one that is refused, with each call in the log."""

        def call(*arguments: object, **named: object) -> object:
            self._robot.journal.count("script", name)
            if function is None:
                raise ScriptRuntimeError(f"{name}: {NOT_SUPPORTED}")
            return function(*arguments, **named)

        return call

    def _builtins(self) -> dict[str, Builtin]:
        robot, out = self._robot, self._robot.outputs

        def sleep(t: float) -> Steps:
            for _ in range(robot.cycles(t)):
                yield

        def register(side: str, kind: str, address: int) -> str:
            found = f"{side}_{kind}_register_{address}"
            if found not in out.types:
                raise ScriptRuntimeError(f"there is no {found}")
            return found

        def write_integer(address: int, value: int) -> None:
            if type(value) is not int or not -(2**31) <= value < 2**31:
                raise ScriptRuntimeError(f"{value!r} is no integer of 32 bits")
            out.set(register("output", "int", address), value)

        def set_watchdog(variable_name: str, min_frequency: float, action: str) -> None:
            known = variable_name in robot.inputs.types and action.lower() == "stop"
            if not known or not 0 < min_frequency < math.inf:
                raise ScriptRuntimeError(f"watchdog on {variable_name}, {min_frequency} Hz: {NOT_SUPPORTED}")
            robot.watchdog_s, robot.watched = 1.0 / min_frequency, variable_name

        return {
            "norm": lambda a: math.hypot(*a) if isinstance(a, list) else abs(a),
            "sync": lambda: sleep(0.0),
            "sleep": sleep,
            "get_steptime": lambda: robot.dt_s,
            "get_actual_joint_positions": lambda: List(robot.arm.actual),
            "get_tcp_offset": lambda: Pose(robot.tcp),
            "textmsg": lambda s1, s2="": robot.journal.note("controller", "textmsg", text=f"{s1}{s2}"),
            "read_input_integer_register": lambda n: int(robot.inputs.get(register("input", "int", n))),
            "read_input_float_register": lambda n: robot.inputs.get(register("input", "double", n)),
            "write_output_integer_register": write_integer,
            "write_output_float_register": lambda n, x: out.set(register("output", "double", n), float(x)),
            "rtde_set_watchdog": self._counted("rtde_set_watchdog", set_watchdog),
            "movej": self._movej,
            "stopj": self._stopj,
        }

    # -- motion -----------------------------------------------------------------------------------------

    def _movej(self, q: list[float], a: float = 1.4, v: float = 1.05, t: float = 0, r: float = 0) -> Steps:
        """Move until the arm rests at the goal. The thread that moves controls the arm as long."""
        goal = _six(q)
        if not (math.isfinite(a) and math.isfinite(v) and a > 0 and v > 0) or t:
            raise ScriptRuntimeError(f"movej to {q} with a={a}, v={v}, t={t}")
        self._take_arm("movej")
        self._robot.journal.note("script", "movej", goal=list(goal), a=a, v=v)
        yield from self._hold(self._robot.arm.start(goal, v, a))

    def _stopj(self, a: float = 2.0) -> Steps:
        if not (math.isfinite(a) and a > 0):
            raise ScriptRuntimeError(f"stopj with a={a}")
        self._take_arm("stopj")
        self._robot.journal.note("script", "stopj", a=a)
        self._robot.arm.brake(a)
        if self._robot.arm.motion is not None:
            yield from self._hold(self._robot.arm.motion)

    def _take_arm(self, name: str) -> None:
        if self._mover not in (None, self._run.thread):
            raise ScriptRuntimeError(f"{name}: another thread is already controlling the robot")

    def _hold(self, motion: JointMotion) -> Steps:
        """Waits for its end. A thread killed meanwhile leaves it to who moves or stops in the same cycle."""
        self._mover, self._orphan = self._run.thread, None
        try:
            while not motion.done:
                yield
        finally:
            self._mover = None
            self._orphan = None if motion.done else motion


def _six(values: list[float]) -> Vector:
    """Raises ScriptRuntimeError unless these are six finite joint angles."""
    joints = isinstance(values, list) and not isinstance(values, Pose) and len(values) == 6
    if not joints or not all(map(math.isfinite, values)):
        raise ScriptRuntimeError(f"{values!r} is not six joint angles")
    return tuple(map(float, values))
