"""Uploaded programs that run as they are written: URScript's interpreter joined to this controller's arm."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import suppress
from math import isfinite

from station.simulation.controller.arm import JointMotion
from station.simulation.controller.kinematics import Six, from_pose
from station.simulation.controller.paths import JointPath, LinePath, Path
from station.simulation.controller.programs import ScriptError
from station.simulation.controller.state import ControllerState
from station.simulation.controller.urscript import (
    Builtin,
    Pose,
    ScriptRun,
    ScriptRuntimeError,
    ScriptSyntaxError,
    Thread,
)
from station.simulation.controller.urscript_parser import parse

KILLED_RAD_S2 = 40.0
"""Deceleration of an arm whose moving thread was killed and that nobody stops: very sudden."""
STEADY_RAD_S = 1e-3

Wait = Generator[None, None, None]


class InterpretedProgram:
    """A text from a script port. Raises ScriptSyntaxError for one that this interpreter cannot run."""

    def __init__(self, robot: ControllerState, name: str, text: str) -> None:
        self.name = name
        self._robot = robot
        self._run = ScriptRun(parse(text, self._builtins()))
        self._mover: Thread | None = None
        """The thread that controls the arm."""
        self._orphan: JointMotion | None = None
        """A motion whose thread was killed in this cycle."""

    def begin(self) -> None:
        pass

    def step(self) -> bool:
        try:
            goes_on = self._run.step()
        except ScriptRuntimeError as error:
            raise ScriptError(str(error)) from None
        if not goes_on:
            self._run.end()
        if self._orphan is not None and not self._orphan.done:
            self._robot.arm.brake(KILLED_RAD_S2)
        self._orphan = None
        return goes_on

    def _builtins(self) -> dict[str, Builtin]:
        """What can be called besides what only computes; arguments have the names of the manual."""
        robot, arm = self._robot, self._robot.arm
        return {
            "sync": self._sync,
            "sleep": self._sleep,
            "get_steptime": lambda: robot.dt_s,
            "movej": self._movej,
            "movel": self._movel,
            "stopj": self._stopj,
            "stopl": self._stopl,
            "is_steady": lambda: not arm.moving and max(map(abs, arm.actual_speed)) < STEADY_RAD_S,
            "get_actual_joint_positions": lambda: list(arm.actual),
            "get_target_joint_positions": lambda: list(arm.command),
            "get_actual_joint_speeds": lambda: list(arm.actual_speed),
            "get_actual_tcp_pose": lambda: Pose(robot.outputs.vector("actual_TCP_pose")),
            "get_tcp_offset": lambda: Pose(robot.tcp),
            "read_input_integer_register": lambda address: int(self._input("int", address)),
            "read_input_float_register": lambda address: self._input("double", address),
            "read_output_integer_register": lambda address: int(self._output("int", address)),
            "read_output_float_register": lambda address: self._output("double", address),
            "write_output_integer_register": self._write_integer,
            "write_output_float_register": self._write_float,
            "textmsg": lambda s1, s2="": robot.journal.note("controller", "textmsg", text=f"{s1}{s2}"),
        }

    # -- time -------------------------------------------------------------------------------------------

    def _sync(self) -> Wait:
        yield

    def _sleep(self, t: float) -> Wait:
        for _ in range(max(1, round(t / self._robot.dt_s))):
            yield

    # -- registers --------------------------------------------------------------------------------------

    def _input(self, kind: str, address: int) -> float:
        return self._robot.inputs.get(self._register("input", kind, address))

    def _output(self, kind: str, address: int) -> float:
        return self._robot.outputs.get(self._register("output", kind, address))

    def _register(self, side: str, kind: str, address: int) -> str:
        name = f"{side}_{kind}_register_{address}"
        if name not in self._robot.inputs.types and name not in self._robot.outputs.types:
            raise ScriptRuntimeError(f"there is no {name}")
        return name

    def _write_integer(self, address: int, value: int) -> None:
        if type(value) is not int or not -(2**31) <= value < 2**31:
            raise ScriptRuntimeError(f"{value!r} is no integer of 32 bits")
        self._robot.outputs.set(self._register("output", "int", address), value)

    def _write_float(self, address: int, value: float) -> None:
        self._robot.outputs.set(self._register("output", "double", address), float(value))

    # -- motion -----------------------------------------------------------------------------------------

    def _movej(self, q: list[float], a: float = 1.4, v: float = 1.05, t: float = 0, r: float = 0) -> Wait:
        if isinstance(q, Pose):
            raise ScriptRuntimeError("movej to a pose is not simulated")
        yield from self._move("movej", q, a, v, t)

    def _movel(self, pose: list[float], a: float = 1.2, v: float = 0.25, t: float = 0, r: float = 0) -> Wait:
        if not isinstance(pose, Pose):
            raise ScriptRuntimeError("movel to joints is not simulated")
        yield from self._move("movel", pose, a, v, t)

    def _move(self, name: str, values: list[float], a: float, v: float, t: float) -> Wait:
        """Until the arm rests at the goal. The thread that moves controls the arm as long."""
        robot = self._robot
        goal: Six = tuple(map(float, values))
        if len(goal) != 6 or not all(map(isfinite, (*goal, a, v))) or a <= 0 or v <= 0 or t != 0:
            raise ScriptRuntimeError(f"{name} to {goal} with a={a}, v={v}, t={t}")

        def path(start: Six) -> Path:
            if name == "movej":
                return JointPath(start, goal)
            return LinePath(robot.table, from_pose(robot.tcp), start, from_pose(goal))

        self._take_arm(name)
        robot.journal.note("script", name, goal=list(goal), a=a, v=v)
        yield from self._hold(robot.arm.start(path, v, a))

    def _stopj(self, a: float) -> Wait:
        yield from self._stop("stopj", a)

    def _stopl(self, a: float, aRot: float = 0) -> Wait:
        yield from self._stop("stopl", a)

    def _stop(self, name: str, a: float) -> Wait:
        if not (isfinite(a) and a > 0):
            raise ScriptRuntimeError(f"{name} with a={a}")
        self._take_arm(name)
        self._robot.journal.note("script", name, a=a)
        arm = self._robot.arm
        (arm.brake if name == "stopj" else arm.brake_tool)(a)
        if arm.motion is not None:
            yield from self._hold(arm.motion)

    def _take_arm(self, name: str) -> None:
        if self._mover not in (None, self._run.thread):
            raise ScriptRuntimeError(f"{name}: another thread is already controlling the robot")

    def _hold(self, motion: JointMotion) -> Wait:
        """Waits for its end. A thread killed meanwhile leaves it to whoever stops it in the same cycle."""
        self._mover, self._orphan = self._run.thread, None
        try:
            while not motion.done:
                yield
        finally:
            self._mover = None
            if not motion.done:
                self._orphan = motion


def interpreted(robot: ControllerState, name: str, text: str) -> InterpretedProgram | None:
    """None for a text that the interpreter cannot run."""
    with suppress(ScriptSyntaxError):
        return InterpretedProgram(robot, name, text)
    return None
