"""Motion in a script: kinematics, moves and streams.

Arguments have the names of Universal Robots' manual, "The URScript Programming Language".
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf, isfinite

from station.simulation.controller.arm import JointMotion, Speeds
from station.simulation.controller.kinematics import (
    JOINT_LIMIT_RAD,
    Rigid,
    Vector,
    between,
    compose,
    forward,
    from_pose,
    from_rotvec,
    inverse_nearest,
    invert,
    moved_to,
    plus,
    position,
    to_pose,
)
from station.simulation.controller.paths import JointPath, LinePath, Path, UnreachableError
from station.simulation.controller.script_functions import pose_of, rigid, six, text_of
from station.simulation.controller.state import ControllerState, twist_between
from station.simulation.controller.urscript import Builtin, List, Pose, ScriptRuntimeError, Steps, Thread
from station.simulation.controller.urscript_parser import NOT_SUPPORTED

KILLED_RAD_S2 = 40.0
"""Deceleration of an arm whose moving thread was killed and that nobody stops: very sudden."""


class ArmMotions:
    """A program's hold on the arm: one thread at a time moves it."""

    def __init__(self, robot: ControllerState, thread: Callable[[], Thread | None]) -> None:
        """thread: the one whose turn it is."""
        self._robot, self._thread = robot, thread
        self._mover: Thread | None = None
        """The thread that controls the arm."""
        self._orphan: JointMotion | None = None
        """A motion that no thread waits for any more: for whoever moves or stops in the same cycle."""

    def brake_orphan(self) -> None:
        """Called when every thread had its turn."""
        if self._orphan is not None and not self._orphan.done:
            self._robot.arm.brake(KILLED_RAD_S2)
        self._orphan = None

    def builtins(self) -> dict[str, Builtin]:
        """What has no underscore below is called so by scripts."""
        names = [n for n in vars(ArmMotions) if n[0] != "_" and n not in ("brake_orphan", "builtins")]
        return {name: getattr(self, name) for name in names}

    # -- kinematics -------------------------------------------------------------------------------------

    def get_forward_kin(self, q: list[float] | None = None, tcp: Pose | None = None) -> Pose:
        joints = self._robot.arm.actual if q is None else six(q)
        return pose_of(self._tool(joints, self._robot.tcp if tcp is None else six(tcp)))

    def _tool(self, joints: Vector, tcp: Vector) -> Rigid:
        return compose(forward(self._robot.table, joints), from_pose(tcp))

    def get_inverse_kin(
        self,
        x: Pose,
        qnear: list[float] | None = None,
        maxPositionError: float = 1e-10,
        maxOrientationError: float = 1e-10,
        tcp: Pose | None = None,
    ) -> list[float]:
        offset = from_pose(self._robot.tcp if tcp is None else six(tcp))
        near = self._robot.arm.command if qnear is None else six(qnear)
        joints = inverse_nearest(self._robot.table, compose(rigid(x), invert(offset)), near)
        if joints is None:
            raise ScriptRuntimeError(f"get_inverse_kin found no solution for {text_of(x)}")
        return List(joints)

    def get_inverse_kin_has_solution(self, *arguments: object, **named: object) -> bool:
        try:
            self.get_inverse_kin(*arguments, **named)  # type: ignore[arg-type]
        except ScriptRuntimeError:
            return False
        return True

    def is_within_safety_limits(self, pose: list[float]) -> bool:
        if isinstance(pose, Pose):
            return self.get_inverse_kin_has_solution(pose)
        return all(abs(q) <= JOINT_LIMIT_RAD for q in pose)

    # -- moves ------------------------------------------------------------------------------------------

    def movej(self, q: list[float], a: float = 1.4, v: float = 1.05, t: float = 0, r: float = 0) -> Steps:
        goal = tuple(self.get_inverse_kin(q)) if isinstance(q, Pose) else six(q)
        return self._move("movej", goal, lambda start: JointPath(start, goal), a, v, t)

    def movel(self, pose: list[float], a: float = 1.2, v: float = 0.25, t: float = 0, r: float = 0) -> Steps:
        table, tcp = self._robot.table, self._robot.tcp
        goal = rigid(pose) if isinstance(pose, Pose) else self._tool(six(pose), tcp)
        return self._move(
            "movel", to_pose(goal), lambda start: LinePath(table, from_pose(tcp), start, goal), a, v, t
        )

    def movep(self, pose: list[float], a: float = 1.2, v: float = 0.25, r: float = 0) -> Steps:
        return self.movel(pose, a, v)

    def _move(
        self, name: str, goal: Vector, make_path: Callable[[Vector], Path], a: float, v: float, t: float
    ) -> Steps:
        """Move until the arm rests at the goal. The thread that moves controls the arm as long."""
        arm = self._robot.arm
        if not all(map(isfinite, (*goal, a, v, t))) or t < 0 or (t == 0 and (a <= 0 or v <= 0)):
            raise ScriptRuntimeError(f"{name} to {text_of(list(goal))} with a={a}, v={v}, t={t}")
        if t > 0:  # in this time, a quarter of it for each ramp
            v = max(make_path(arm.command).length, 1e-9) / (0.75 * t)
            a = v / (0.25 * t)
        self._take_arm(name)
        self._robot.journal.note("script", name, goal=list(goal), a=a, v=v)
        yield from self._hold(arm.start(make_path, v, a))

    # -- streams ----------------------------------------------------------------------------------------

    def servoj(
        self,
        q: list[float],
        a: float = 0,
        v: float = 0,
        t: float = 0.002,
        lookahead_time: float = 0.1,
        gain: float = 300,
    ) -> Steps:
        """Follows the goal with the lookahead as its time constant; `gain` has no effect."""
        goal, lag_s = six(q), max(0.03, min(0.2, lookahead_time))

        def wanted(joints: Vector, dt_s: float) -> Vector:
            return tuple((g - c) / max(lag_s, dt_s) for g, c in zip(goal, joints, strict=True))

        return self._flow("servoj", wanted, inf, t, lambda: True)

    def speedj(self, qd: list[float], a: float = 1.4, t: float = 0) -> Steps:
        speeds, arm = six(qd), self._robot.arm
        return self._flow("speedj", lambda _, __: speeds, a, t, lambda: arm.stream_speeds == speeds)

    def speedl(self, xd: list[float], a: float = 1.2, t: float = 0, aRot: object = "a") -> Steps:
        tool = _ToolSpeed(self._robot, six(xd), a)
        return self._flow("speedl", tool.joint_speeds, inf, t, lambda: tool.twist == tool.goal)

    def servoc(self, *_: object, **__: object) -> None:
        raise ScriptRuntimeError(f"servoc: {NOT_SUPPORTED}")

    def _flow(self, name: str, wanted: Speeds, a: float, t: float, arrived: Callable[[], bool]) -> Steps:
        """Lets the arm follow: for the time t, else until it has arrived. The next call must take over."""
        if not (a > 0 and isfinite(t)):
            raise ScriptRuntimeError(f"{name} with a={a}, t={t}")
        self._take_arm(name)
        self._robot.journal.count("script", name)
        left = self._robot.cycles(t) if t > 0 else 0

        def over() -> bool:
            nonlocal left
            left -= 1
            return left <= 0 if t > 0 else arrived()

        yield from self._hold(self._robot.arm.stream(wanted, a), over)

    # -- stops ------------------------------------------------------------------------------------------

    def stopj(self, a: float = 2.0) -> Steps:
        return self._stop("stopj", self._robot.arm.brake, a)

    def stopl(self, a: float = 2.0, aRot: object = "a") -> Steps:
        return self._stop("stopl", self._robot.arm.brake_tool, a)

    def _stop(self, name: str, brake: Callable[[float], None], a: float) -> Steps:
        if not (isfinite(a) and a > 0):
            raise ScriptRuntimeError(f"{name} with a={a}")
        self._take_arm(name)
        self._robot.journal.note("script", name, a=a)
        brake(a)
        if self._robot.arm.motion is not None:
            yield from self._hold(self._robot.arm.motion)

    def _take_arm(self, name: str) -> None:
        if self._mover not in (None, self._thread()):
            raise ScriptRuntimeError(f"{name}: another thread is already controlling the robot")

    def _hold(self, motion: JointMotion, over: Callable[[], bool] = lambda: False) -> Steps:
        """Waits for its end, or until it is over. Then whoever moves or stops in the same cycle has it."""
        self._mover, self._orphan = self._thread(), None
        try:
            while not motion.done:
                yield
                if over():
                    return
        finally:
            self._mover = None
            self._orphan = None if motion.done else motion


class _ToolSpeed:
    """Joint speeds for a tool speed that changes by at most the acceleration (m/s² and rad/s²)."""

    def __init__(self, robot: ControllerState, goal: Vector, acceleration: float) -> None:
        """goal: m/s and rad/s, in base."""
        if not (isfinite(acceleration) and acceleration > 0):
            raise ScriptRuntimeError(f"an acceleration of {acceleration}")
        self.goal, self._acceleration = goal, acceleration
        self._table, self._flange_from_tcp = robot.table, from_pose(robot.tcp)
        step_s, arm = 1e-4, robot.arm
        ahead = tuple(q + step_s * v for q, v in zip(arm.command, arm.stream_speeds, strict=True))
        self.twist = twist_between(self._at(arm.command), self._at(ahead), 1 / step_s)

    def _at(self, joints: Vector) -> Rigid:
        return compose(forward(self._table, joints), self._flange_from_tcp)

    def joint_speeds(self, joints: Vector, dt_s: float) -> Vector:
        """Raises UnreachableError."""
        tool = self._at(joints)
        change = max(abs(g - x) for g, x in zip(self.goal, self.twist, strict=True))
        most = self._acceleration * dt_s
        share = most / change if change > most else 1.0
        self.twist = self.goal if share == 1.0 else between(self.twist, self.goal, share)
        x, y, z, *turn = (v * dt_s for v in self.twist)
        goes = moved_to(compose(from_rotvec(*turn), tool), plus(position(tool), (x, y, z)))
        solved = inverse_nearest(self._table, compose(goes, invert(self._flange_from_tcp)), joints)
        if solved is None:
            raise UnreachableError("the tool's way leaves the arm's reach")
        return tuple((b - a) / dt_s for a, b in zip(joints, solved, strict=True))
