"""Motion in a script: kinematics, moves, streams and torques.

Arguments have the names of Universal Robots' manual, "The URScript Programming Language".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import hypot, inf, isfinite, sqrt

from station.simulation.controller.arm import JOINT_SPEED_RAD_S, JointMotion, Speeds
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
    place,
    plus,
    to_pose,
    to_rotvec,
)
from station.simulation.controller.paths import ArcPath, JointPath, LinePath, Path, UnreachableError
from station.simulation.controller.script_io import Wait
from station.simulation.controller.script_pure import pose_of, rigid, six, text_of
from station.simulation.controller.state import ControllerState, twist_between
from station.simulation.controller.urscript import Pose, ScriptRuntimeError, Thread
from station.simulation.controller.urscript_parser import Builtin

KILLED_RAD_S2 = 40.0
"""Deceleration of an arm whose moving thread was killed and that nobody stops: very sudden."""
ROTATION_WEIGHT_M = 0.1
"""servoc turns a radian in the time in which it goes so far."""
ARRIVED_M = 1e-5
JOINT_RAD_S2 = 40.0
"""The largest acceleration that the configuration message states."""
TOOL_M_S = 1.0
"""All that optimovel goes; the ramps take as long as those of optimovej."""


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
        return {name: getattr(self, name) for name in names} | self._new()

    # -- kinematics -------------------------------------------------------------------------------------

    def _tool(self, joints: Vector) -> Rigid:
        return compose(forward(self._robot.table, joints), from_pose(self._robot.tcp))

    def get_forward_kin(self, q: list[float] | None = None, tcp: Pose | None = None) -> Pose:
        joints = self._robot.arm.actual if q is None else six(q)
        offset = self._robot.tcp if tcp is None else six(tcp)
        return pose_of(compose(forward(self._robot.table, joints), from_pose(offset)))

    def _solved(self, pose: Rigid, near: Vector, tcp: list[float] | None = None) -> Vector | None:
        offset = from_pose(self._robot.tcp if tcp is None else six(tcp))
        return inverse_nearest(self._robot.table, compose(pose, invert(offset)), near)

    def get_inverse_kin(
        self,
        x: Pose,
        qnear: list[float] | None = None,
        maxPositionError: float = 1e-10,
        maxOrientationError: float = 1e-10,
        tcp: Pose | None = None,
    ) -> list[float]:
        joints = self._solved(rigid(x), self._robot.arm.command if qnear is None else six(qnear), tcp)
        if joints is None:
            raise ScriptRuntimeError(f"get_inverse_kin found no solution for {text_of(x)}")
        return list(joints)

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

    # -- motion -----------------------------------------------------------------------------------------

    def _joints(self, target: list[float]) -> Vector:
        return tuple(self.get_inverse_kin(target)) if isinstance(target, Pose) else six(target)

    def _pose(self, target: list[float]) -> Rigid:
        return rigid(target) if isinstance(target, Pose) else self._tool(six(target))

    def movej(self, q: list[float], a: float = 1.4, v: float = 1.05, t: float = 0, r: float = 0) -> Wait:
        return self._turn("movej", q, a, v, t)

    def movel(self, pose: list[float], a: float = 1.2, v: float = 0.25, t: float = 0, r: float = 0) -> Wait:
        return self._line("movel", pose, a, v, t)

    def movep(self, pose: list[float], a: float = 1.2, v: float = 0.25, r: float = 0) -> Wait:
        return self._line("movep", pose, a, v)

    def movec(
        self,
        pose_via: list[float],
        pose_to: list[float],
        a: float = 1.2,
        v: float = 0.25,
        r: float = 0,
        mode: float = 0,
    ) -> Wait:
        via, goal, tcp = self._pose(pose_via), self._pose(pose_to), from_pose(self._robot.tcp)
        make_path = lambda start: ArcPath(self._robot.table, tcp, start, via, goal)  # noqa: E731
        return self._move("movec", to_pose(goal), make_path, a, v, 0)

    def _turn(self, name: str, target: list[float], a: float, v: float, t: float = 0) -> Wait:
        goal = self._joints(target)
        return self._move(name, goal, lambda start: JointPath(start, goal), a, v, t)

    def _line(self, name: str, target: list[float], a: float, v: float, t: float = 0) -> Wait:
        goal, tcp = self._pose(target), from_pose(self._robot.tcp)
        make_path = lambda start: LinePath(self._robot.table, tcp, start, goal)  # noqa: E731
        return self._move(name, to_pose(goal), make_path, a, v, t)

    def _move(
        self, name: str, goal: Vector, make_path: Callable[[Vector], Path], a: float, v: float, t: float
    ) -> Wait:
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

    def servoj(
        self,
        q: list[float],
        a: float = 0,
        v: float = 0,
        t: float = 0.002,
        lookahead_time: float = 0.1,
        gain: float = 300,
    ) -> Wait:
        """Follows the goal with the lookahead as its time constant; `gain` has no effect."""
        goal, lag_s = six(q), max(0.03, min(0.2, lookahead_time))

        def wanted(joints: Vector, dt_s: float) -> Vector:
            return tuple((g - c) / max(lag_s, dt_s) for g, c in zip(goal, joints, strict=True))

        return self._flow("servoj", wanted, inf, t, lambda: True)

    def speedj(self, qd: list[float], a: float = 1.4, t: float = 0) -> Wait:
        speeds, arm = six(qd), self._robot.arm
        return self._flow("speedj", lambda _, __: speeds, a, t, lambda: arm.stream_speeds == speeds)

    def speedl(self, xd: list[float], a: float = 1.2, t: float = 0, aRot: object = "a") -> Wait:
        goal = six(xd)
        tool = _ToolSpeed(self._robot, lambda _: goal, a)
        return self._flow("speedl", tool.joint_speeds, inf, t, lambda: tool.twist == goal)

    def servoc(self, pose: Pose, a: float = 1.2, v: float = 0.25, r: float = 0) -> Wait:
        """Straight towards the pose, until it is reached or as near as the blend radius."""
        goal, robot = rigid(pose), self._robot

        def way(tool: Rigid) -> tuple[Vector, float]:
            """Return what is left: a twist that would do it in 1 s, and its length [m]."""
            move = plus(place(goal), place(tool), -1)
            turn = to_rotvec(compose(goal, invert(tool)))
            return (*move, *turn), max(hypot(*move), ROTATION_WEIGHT_M * hypot(*turn))

        def towards(tool: Rigid) -> Vector:
            twist, distance_m = way(tool)
            speed = min(v, sqrt(2 * a * distance_m), distance_m / (4 * robot.dt_s))
            return tuple(x * speed / distance_m for x in twist) if distance_m > 0 else twist

        tool = _ToolSpeed(robot, towards, a)
        near_m = max(r, ARRIVED_M)
        return self._flow("servoc", tool.joint_speeds, inf, 0, lambda: way(tool.place)[1] < near_m)

    def _flow(self, name: str, wanted: Speeds, a: float, t: float, arrived: Callable[[], bool]) -> Wait:
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

    def _optimovej(self, goal: list[float], a: float = 0.3, v: float = 0.3, r: float = 0) -> Wait:
        """a and v are shares of what the arm can do, as in optimovel."""
        return self._turn("optimovej", goal, a * JOINT_RAD_S2, v * JOINT_SPEED_RAD_S)

    def _optimovel(self, goal: list[float], a: float = 0.3, v: float = 0.3, r: float = 0) -> Wait:
        slower = JOINT_RAD_S2 * TOOL_M_S / JOINT_SPEED_RAD_S
        return self._line("optimovel", goal, a * slower, v * TOOL_M_S)

    def stopj(self, a: float = 2.0) -> Wait:
        return self._stop("stopj", self._robot.arm.brake, a)

    def stopl(self, a: float = 2.0, aRot: object = "a") -> Wait:
        return self._stop("stopl", self._robot.arm.brake_tool, a)

    def _stop(self, name: str, brake: Callable[[float], None], a: float) -> Wait:
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

    def _hold(self, motion: JointMotion, over: Callable[[], bool] = lambda: False) -> Wait:
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

    # -- torques ----------------------------------------------------------------------------------------

    def _new(self) -> dict[str, Builtin]:
        """List functions that e-Series has from 5.21 or 5.23 on; the scales of friction came with 5.25.1."""
        robot, arm, settings = self._robot, self._robot.arm, self._robot.settings
        if not settings.is_e_series or settings.version < (5, 21):
            return {}
        optimal: dict[str, Builtin] = {"optimovej": self._optimovej, "optimovel": self._optimovel}
        if settings.version < (5, 23):
            return optimal
        from station.simulation.controller.dynamics import DRIVES, Body, Posture  # needs NumPy: slow to load

        drives = DRIVES[settings.model]

        def posture() -> Posture:
            return Posture(robot.table, arm.actual, arm.actual_speed)

        def bodies() -> list[Body]:
            x, y, z = robot.payload_cog
            return [*drives.bodies, Body(6, robot.payload_kg, (x, y, z))]

        def turn(torque: Sequence[float]) -> Wait:
            asked, load = six(torque), bodies()

            def wanted(joints: Vector, dt_s: float) -> Vector:
                speeds = arm.stream_speeds
                rates = Posture(robot.table, joints, speeds).accelerations(load, drives.most_nm, asked)
                faster = tuple(v + dt_s * float(r) for v, r in zip(speeds, rates, strict=True))
                if max(map(abs, faster)) > JOINT_SPEED_RAD_S:
                    raise UnreachableError("a joint exceeds its speed limit")
                return faster

            return self._flow("direct_torque", wanted, inf, robot.dt_s, lambda: True)

        def scaled(
            torque: Sequence[float],
            viscous_scale: Sequence[float] = (1.0,) * 6,
            coulomb_scale: Sequence[float] = (1.0,) * 6,
            friction_comp: bool = True,
        ) -> Wait:
            for scale in (viscous_scale, coulomb_scale):
                if len(scale) != 6 or not all(0 <= s <= 1 for s in scale):
                    raise ScriptRuntimeError(f"direct_torque with a scale of {text_of(list(scale))}")
            return turn(torque)

        return optimal | {
            "direct_torque": scaled
            if settings.version >= (5, 25, 1)
            else lambda torque, friction_comp=True: turn(torque),
            "get_mass_matrix": lambda: posture().mass_matrix(bodies()).tolist(),
            "get_coriolis_and_centrifugal_torques": lambda: posture().coriolis(bodies()).tolist(),
            "get_jacobian": lambda: posture().jacobian(self._tool(arm.actual)).tolist(),
            "get_jacobian_time_derivative": lambda: posture().jacobian_rate(self._tool(arm.actual)).tolist(),
            "get_target_joint_accelerations": lambda: list(robot.outputs.vector("target_qdd")),
        }


class _ToolSpeed:
    """Joint speeds for a tool speed that changes by at most the acceleration (m/s² and rad/s²)."""

    def __init__(
        self, robot: ControllerState, wanted: Callable[[Rigid], Vector], acceleration: float
    ) -> None:
        if not (isfinite(acceleration) and acceleration > 0):
            raise ScriptRuntimeError(f"an acceleration of {acceleration}")
        self._robot, self._wanted, self._acceleration = robot, wanted, acceleration
        self._flange_from_tcp = from_pose(robot.tcp)
        step_s, arm = 1e-4, robot.arm
        ahead = tuple(q + step_s * v for q, v in zip(arm.command, arm.stream_speeds, strict=True))
        self.place = self._at(arm.command)
        """base_from_tcp"""
        self.twist = twist_between(self.place, self._at(ahead), 1 / step_s)
        """m/s and rad/s, in base"""

    def _at(self, joints: Vector) -> Rigid:
        return compose(forward(self._robot.table, joints), self._flange_from_tcp)

    def joint_speeds(self, joints: Vector, dt_s: float) -> Vector:
        """Raises UnreachableError."""
        self.place = place = self._at(joints)
        goal = self._wanted(place)
        change = max(abs(g - x) for g, x in zip(goal, self.twist, strict=True))
        most = self._acceleration * dt_s
        share = most / change if change > most else 1.0
        self.twist = goal if share == 1.0 else between(self.twist, goal, share)
        x, y, z, *turn = (v * dt_s for v in self.twist)
        moved = compose(from_rotvec(*turn), place)
        goes = (*moved[:3], place[3] + x, *moved[4:7], place[7] + y, *moved[8:11], place[11] + z)
        solved = inverse_nearest(self._robot.table, compose(goes, invert(self._flange_from_tcp)), joints)
        if solved is None:
            raise UnreachableError("the tool's way leaves the arm's reach")
        return tuple((b - a) / dt_s for a, b in zip(joints, solved, strict=True))
