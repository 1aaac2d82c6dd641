"""ur_rtde's control script, as this controller runs it: commands arrive in registers.

Registers are relative to the script's offset: input int 0 = command id, input doubles = arguments,
output int 0 = state (1 ready, 2 done), output int 1 / doubles = results, output int 2 = async word.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite

from station.simulation.controller.arm import JointMotion, MakePath, SimulatedArm
from station.simulation.controller.kinematics import (
    JOINT_LIMIT_RAD,
    Rigid,
    Six,
    compose,
    forward,
    from_pose,
    inverse_nearest,
    invert,
    to_pose,
)
from station.simulation.controller.paths import JointPath, LinePath, UnreachableError
from station.simulation.controller.programs import PathStep, ScriptError, Upload
from station.simulation.controller.state import ControllerState

READY, DONE = 1, 2
STEADY_RAD_S = 1e-3
END_PROGRAM = 255

COMMANDS = {
    1: "moveJ", 2: "moveJ_IK", 3: "moveL", 4: "moveL_FK", 6: "forceMode", 7: "forceModeStop",
    8: "zeroFtSensor", 9: "speedJ", 10: "speedL", 11: "servoJ", 12: "servoC", 15: "speedStop",
    16: "servoStop",
    17: "setPayload",
    18: "teachMode", 19: "endTeachMode", 20: "forceModeSetDamping", 21: "forceModeSetGainScaling",
    24: "servoL", 25: "toolContact", 26: "getStepTime", 27: "getActualJointPositionsHistory",
    28: "getTargetWaypoint", 29: "setTcp", 30: "getInverseKinematics", 31: "triggerProtectiveStop",
    33: "stopL", 34: "stopJ", 35: "setWatchdog", 36: "isPoseWithinSafetyLimits",
    37: "isJointsWithinSafetyLimits", 38: "getJointTorques", 39: "poseTrans", 40: "getTCPOffset",
    41: "jogStart", 42: "jogStop", 43: "getForwardKinematics", 44: "getForwardKinematics", 45: "movePath",
    46: "getInverseKinematics", 47: "isSteady", 51: "moveUntilContact", 52: "freedriveMode",
    53: "endFreedriveMode", 54: "getFreedriveStatus", 55: "setExternalForceTorque", 56: "ftRtdeInputEnable",
    57: "enableExternalFtSensor", 58: "getActualToolFlangePose", 59: "setGravity",
    60: "getInverseKinematicsHasSolution", 61: "getInverseKinematicsHasSolution",
    62: "startContactDetection", 63: "readContactDetection", 64: "stopContactDetection",
    65: "setTargetPayload", 66: "getMassMatrix", 67: "getMassMatrix", 68: "getCoriolis",
    69: "getTargetJointAccelerations", 70: "getJacobian", 71: "getJacobianTimeDerivative",
    END_PROGRAM: "stopScript",
}  # fmt: skip
REALTIME = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, *range(66, 72)})
"""Processed every cycle while the id stands in the register."""


class AsyncWord:
    """bits 24–30 operation id, 16–22 change counter, 15 running, 0–14 progress."""

    def __init__(self, write: Callable[[int], None]) -> None:
        self._write = write
        self._operation = 0
        self._change = 0

    def start(self) -> None:
        self._operation = (self._operation + 1) & 0x7F
        self.progress(0)

    def progress(self, value: int) -> None:
        self._put(True, value & 0x7FFF)

    def finish(self) -> None:
        self._put(False, 0)

    def _put(self, running: bool, progress: int) -> None:
        self._change = (self._change + 1) & 0x7F
        self._write(self._operation << 24 | self._change << 16 | running << 15 | progress)


@dataclass(frozen=True)
class MoveStep:
    make_path: MakePath
    speed: float
    acceleration: float


class Operation:
    """Moves and progress marks, one after the other. With a word it reports itself there, from the cycle
    after it was asked for; the arm begins at once."""

    def __init__(self, arm: SimulatedArm, steps: list[MoveStep | int], word: AsyncWord | None) -> None:
        self._arm = arm
        self._steps = list(steps)
        self._word = word
        self._motion: JointMotion | None = None
        self._started = word is None
        if self._steps and isinstance(self._steps[0], MoveStep):
            self._begin_move()

    def _begin_move(self) -> None:
        step = self._steps.pop(0)
        assert isinstance(step, MoveStep)
        self._motion = self._arm.start(step.make_path, step.speed, step.acceleration)

    def kill(self) -> None:
        """Another move or a stop takes over."""
        if self._word is not None:
            if not self._started:
                self._word.start()
            self._word.finish()

    def step(self) -> bool:
        """One cycle; True when everything is done. Raises UnreachableError."""
        if not self._started:
            self._started = True
            assert self._word is not None
            self._word.start()
            return False
        while True:
            if self._motion is not None and not self._motion.done:
                return False
            self._motion = None
            if self._arm.moving:
                return False
            if not self._steps:
                break
            if isinstance(self._steps[0], MoveStep):
                self._begin_move()
                continue
            mark = self._steps.pop(0)
            if self._word is not None and isinstance(mark, int):
                self._word.progress(mark)
        if self._word is not None:
            self._word.finish()
        return True


class ControlScript:
    def __init__(self, robot: ControllerState, upload: Upload) -> None:
        self.name = upload.name
        self._robot = robot
        self.offset_int = upload.offset("int")
        self._offset_double = upload.offset("float")
        self._path = upload.path()
        self._executing = False
        self._until: Callable[[], bool] | None = None
        """A blocking command is under way: nothing else is answered."""
        self._word = AsyncWord(lambda value: self._put_int(2, value))
        self._operation: Operation | None = None
        self._async_stop_seen = False
        self._last_realtime = 0
        self._commands = self._table()

    def begin(self) -> None:
        self._word.finish()
        self._put_int(0, READY)

    def step(self) -> bool:
        if self._operation is not None and self._operation.step():
            self._operation = None
        if self._until is not None:
            if not self._until():
                return True
            self._until = None
            self._put_int(0, DONE)
        command = int(self._robot.inputs.get(f"input_int_register_{self.offset_int}"))
        if command == 0:
            self._executing = False
            self._last_realtime = 0
            self._put_int(0, READY)
        elif command in REALTIME:
            if command != self._last_realtime:
                self._note(command)
                self._last_realtime = command
            self._process(command)
            self._put_int(0, READY)
        elif not self._executing:
            self._note(command)
            if command == END_PROGRAM:
                return False
            self._executing = True
            self._process(command)
            if self._until is None:
                self._put_int(0, DONE)
        return True

    def _note(self, command: int) -> None:
        name = COMMANDS.get(command, f"command {command}")
        has_effect = command in self._commands or command == END_PROGRAM
        self._robot.journal.note(
            "script", name, id=command, arguments=list(self._doubles(0, 8)), has_effect=has_effect
        )

    def _process(self, command: int) -> None:
        """Unknown ids and those without an effect here are acknowledged like the real script does."""
        action = self._commands.get(command)
        if action is not None:
            action()

    def _table(self) -> dict[int, Callable[[], None]]:
        robot = self._robot
        return {
            1: lambda: self._move(self._to_joints(self._doubles(0, 6))),
            2: lambda: self._move(self._to_joints(self._solve(self._doubles(0, 6), robot.arm.command))),
            3: lambda: self._move(self._to_pose(from_pose(self._doubles(0, 6)))),
            4: lambda: self._move(self._to_pose(self._tool(self._doubles(0, 6)))),
            17: self._set_payload,
            26: lambda: self._put_doubles((robot.dt_s,)),
            29: self._set_tcp,
            30: lambda: self._put_doubles(self._solve(self._doubles(0, 6), self._doubles(6, 6))),
            31: lambda: robot.protective_stop("triggerProtectiveStop"),
            33: self._stop,
            34: self._stop,
            35: self._set_watchdog,
            36: lambda: self._put_int(1, self._has_solution(robot.arm.command)),
            37: lambda: self._put_int(1, all(abs(q) <= JOINT_LIMIT_RAD for q in self._doubles(0, 6))),
            39: lambda: self._put_rigid(
                compose(from_pose(self._doubles(0, 6)), from_pose(self._doubles(6, 6)))
            ),
            40: lambda: self._put_doubles(robot.tcp),
            43: lambda: self._put_rigid(self._tool(robot.arm.actual)),
            44: self._forward,
            45: self._move_path,
            46: lambda: self._put_doubles(self._solve(self._doubles(0, 6), robot.arm.command)),
            47: lambda: self._put_int(1, self._is_steady()),
            58: lambda: self._put_rigid(forward(robot.table, robot.arm.actual)),
            60: lambda: self._put_int(1, self._has_solution(robot.arm.command)),
            61: lambda: self._put_int(1, self._has_solution(self._doubles(6, 6))),
        }

    def _doubles(self, first: int, count: int) -> Six:
        first += self._offset_double
        return tuple(
            self._robot.inputs.get(f"input_double_register_{i}") for i in range(first, first + count)
        )

    def _is_asynchronous(self) -> bool:
        return bool(self._robot.inputs.get(f"input_int_register_{self.offset_int + 1}"))

    def _put_int(self, index: int, value: int) -> None:
        self._robot.outputs.set(f"output_int_register_{self.offset_int + index}", int(value))

    def _put_doubles(self, values: Six) -> None:
        for i, value in enumerate(values):
            self._robot.outputs.set(f"output_double_register_{self._offset_double + i}", value)

    def _put_rigid(self, T: Rigid) -> None:
        self._put_doubles(to_pose(T))

    def _to_joints(self, joints: Six) -> MakePath:
        _check(joints)
        return lambda start: JointPath(start, joints)

    def _to_pose(self, base_from_tcp: Rigid) -> MakePath:
        _check(base_from_tcp)
        table, tcp = self._robot.table, from_pose(self._robot.tcp)
        return lambda start: LinePath(table, tcp, start, base_from_tcp)

    def _move(self, make_path: MakePath) -> None:
        speed, acceleration = self._doubles(6, 2)
        self._operate([MoveStep(make_path, speed, acceleration)])

    def _move_path(self) -> None:
        self._operate([self._path_step(step) for step in self._path])

    def _path_step(self, step: PathStep) -> MoveStep | int:
        if step.progress is not None:
            return step.progress
        if step.move == "movej":
            make_path = (
                self._to_joints(self._solve(step.target, self._robot.arm.command))
                if step.is_pose
                else self._to_joints(step.target)
            )
        else:
            make_path = self._to_pose(from_pose(step.target) if step.is_pose else self._tool(step.target))
        return MoveStep(make_path, step.speed, step.acceleration)

    def _operate(self, steps: list[MoveStep | int]) -> None:
        """Runs moves and progress marks, in its own thread (async) or blocking the loop."""
        for step in steps:
            if isinstance(step, MoveStep):
                _check((step.speed, step.acceleration))
                if step.speed <= 0 or step.acceleration <= 0:
                    raise ScriptError(f"speed {step.speed} or acceleration {step.acceleration} is not > 0")
        self._kill_operation()
        asynchronous = self._is_asynchronous()
        operation = Operation(self._robot.arm, steps, self._word if asynchronous else None)
        if asynchronous:
            self._operation = operation
        else:
            self._until = lambda: operation.step()
            operation.step()

    def _kill_operation(self) -> None:
        if self._operation is not None:
            self._operation.kill()
            self._operation = None

    def _stop(self) -> None:
        """The script ignores which of the two was asked for: a synchronous stop is a stopj until the first
        asynchronous one of this run, stopl afterwards; an asynchronous one is always stopl."""
        (deceleration,) = self._doubles(0, 1)
        _check((deceleration,))
        if deceleration <= 0:
            raise ScriptError(f"deceleration {deceleration} is not > 0")
        arm = self._robot.arm
        self._kill_operation()
        if self._is_asynchronous():
            self._async_stop_seen = True
            arm.brake_tool(deceleration)
            self._operation = Operation(arm, [], self._word)
            return
        if self._async_stop_seen:
            arm.brake_tool(deceleration)
        else:
            arm.brake(deceleration)
        self._until = lambda: not arm.moving

    def _set_tcp(self) -> None:
        pose = self._doubles(0, 6)
        _check(pose)
        self._robot.tcp = pose

    def _set_payload(self) -> None:
        mass, *cog = self._doubles(0, 4)
        self._robot.payload_kg, self._robot.payload_cog = mass, tuple(cog)

    def _set_watchdog(self) -> None:
        (minimum_hz,) = self._doubles(0, 1)
        if not (minimum_hz > 0 and isfinite(minimum_hz)):
            raise ScriptError(f"watchdog frequency {minimum_hz} is not > 0")
        self._robot.watchdog_s = 1.0 / minimum_hz

    def _tool(self, joints: Six) -> Rigid:
        _check(joints)
        return compose(forward(self._robot.table, joints), from_pose(self._robot.tcp))

    def _forward(self) -> None:
        """Arguments 6–11 are used as the TCP whether or not this call sent them, like the real script."""
        flange = forward(self._robot.table, self._doubles(0, 6))
        self._put_rigid(compose(flange, from_pose(self._doubles(6, 6))))

    def _solve(self, base_from_tcp: Six, near: Six) -> Six:
        _check(base_from_tcp)
        flange = compose(from_pose(base_from_tcp), invert(from_pose(self._robot.tcp)))
        joints = inverse_nearest(self._robot.table, flange, near)
        if joints is None:
            raise ScriptError(f"get_inverse_kin found no solution for {base_from_tcp}")
        return joints

    def _has_solution(self, near: Six) -> bool:
        try:
            self._solve(self._doubles(0, 6), near)
        except (ScriptError, UnreachableError):
            return False
        return True

    def _is_steady(self) -> bool:
        arm = self._robot.arm
        return not arm.moving and max(map(abs, arm.actual_speed)) < STEADY_RAD_S


def _check(values: Six) -> None:
    if not all(map(isfinite, values)):
        raise ScriptError(f"not a finite number among {values}")
