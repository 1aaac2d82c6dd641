"""Move of the acceptance test: short, slow, checked, separately approved, stopped in its middle in one way.

Nothing is recorded here: the stop is judged from another connection to the arm (`operate.acceptance`).
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Iterator

import numpy as np

from calibrate.kinematics import JOINT_NAMES
from recordings.schema.messages import Vector6
from station.cell.acceptance import STOP_GIVEN, STOP_TESTED, StopTestOffer, StopWay
from station.cell.collision import CellGeometry
from station.cell.config import vector6
from station.cell.errors import LimitError, RefusedError, RobotError, SafetyStopError, StaleStateError
from station.cell.limits import PlanCheck, check_path, check_plan, slower
from station.cell.plan import Plan, plan_sha256
from station.cell.scene import geometry_from, pose_at
from station.cell.status import StationState
from station.protocol import verbs
from station.session.context import SessionContext, displacement
from station.session.lease import Drive, MotionApproval
from station.session.run import Run
from station.session.summary import motion_preview, motion_warnings
from station.session.threads import MOTION

ACCELERATION_RAD_S2 = 1.4
LONGEST_TURN_RAD = 0.4
_PROBE_RAD = 0.05
FROZEN_S = 1.0
_MIDDLE = 0.5
"""Share of the turn after which the stop is triggered."""
_LOOK_S = 0.002
_SLIDER_FULL = 0.99
MOVE_S = 3.0
"""Wanted duration of the whole move; shorter where its path is not free."""
_WORDS = {
    StopWay.CONTROL: "is stopped by the control process alone",
    StopWay.DASHBOARD: "is stopped by the dashboard alone",
    StopWay.KILLED: "ends as the control process is killed",
    StopWay.FROZEN: "ends as the daemon stands still for 1 s: the watchdog alone stops it",
}


async def prepare_stop_test(context: SessionContext, request: verbs.StopTest) -> tuple[Drive, StopTestOffer]:
    """Check a move for the stop test; return its execution and the offer. Nothing moves yet.

    RefusedError, LimitError and RobotError say what prevents it.
    """
    state = await context.arm()
    if (fraction := state.target_speed_fraction) < _SLIDER_FULL:
        raise RefusedError(
            f"The speed slider stands at {100 * fraction:.0f} % (wanted: 100 %).",
            code="slider-low",
            remedy="Raise it to 100 %: the test itself is slow.",
            fraction=fraction,
        )
    start = state.joints_rad
    target, check, geometry, plan = await MOTION.run(_free_move, context, request, start)
    move = check.moves[0]
    joint = JOINT_NAMES[request.joint]
    preview = motion_preview(
        check,
        start,
        purpose=f"stop test: {joint} turns {np.rad2deg(move.step_rad):.0f}° and {_WORDS[request.way]}",
        plan_sha256=plan_sha256(plan),
        poses=1,
        first_move=displacement(context, start, target),
        warnings=tuple(await motion_warnings(context, state)),
    )
    offer = StopTestOffer(
        preview, context.cell.subject, request.joint, target[request.joint], move.joint_speed_rad_s
    )
    return lambda go: StopTestRun(context, go, geometry, request.way, target).drive(), offer


def _free_move(
    context: SessionContext, request: verbs.StopTest, start: Vector6
) -> tuple[Vector6, PlanCheck, CellGeometry, Plan]:
    """Find the first turn with a free path; longer turns, and the wanted direction, are tried first."""
    geometry = geometry_from(context.cell.config, start)
    geometry = slower(geometry, request.speed_m_s, joint_acceleration_rad_s2=ACCELERATION_RAD_S2)
    refused: PlanCheck | None = None
    for turn_rad in _turns(geometry, request, start):
        target = vector6(np.array(start) + turn_rad * np.eye(6)[request.joint])
        pose = pose_at(geometry.model, request.way.value, target)
        plan = Plan(
            context.cell.config.robot.model,
            context.cell.config.mount,
            (pose,),
            joint_speed_rad_s=geometry.limits.joint_speed_rad_s,
            joint_acceleration_rad_s2=geometry.limits.joint_acceleration_rad_s2,
            note="stop test",
        )
        check = check_plan(plan, start, geometry)
        if not check.problems:
            return target, check, geometry, plan
        refused = refused or check
    assert refused is not None
    raise LimitError(
        f"{JOINT_NAMES[request.joint]} has no free path from here: {refused.problems[0]}",
        code="stop-test-path",
        remedy="Jog the arm to where it has room, or choose another joint (--joint).",
    )


def _turns(geometry: CellGeometry, request: verbs.StopTest, start: Vector6) -> Iterator[float]:
    """Yield turns (rad) of the joint: those of the wanted duration, then shorter ones."""
    sign = 1.0 if request.forward else -1.0
    near = vector6(np.array(start) + sign * _PROBE_RAD * np.eye(6)[request.joint])
    speed = check_path(geometry, start, near).joint_speed_rad_s
    ramp_s = speed / geometry.limits.joint_acceleration_rad_s2
    whole = float(np.clip(speed * (MOVE_S - ramp_s), _PROBE_RAD, LONGEST_TURN_RAD))
    for share in (1.0, 0.7):
        yield from (sign * share * whole, -sign * share * whole)


class StopTestRun(Run):
    """Execution of an approved stop test: one move, no image, nothing recorded."""

    def __init__(
        self,
        context: SessionContext,
        go: MotionApproval,
        geometry: CellGeometry,
        way: StopWay,
        target_rad: Vector6,
    ) -> None:
        super().__init__(context, go, geometry)
        self._way, self._target_rad = way, target_rad

    async def _poses(self) -> None:
        context, robot = self._context, self._context.cell.robot
        here = (await context.arm()).joints_rad
        context.store.enter(StationState.MOVING)
        driving = asyncio.create_task(self._drive(here, self._target_rad, "stop test"))
        try:
            await self._give_stop(driving)
            await driving
            said, ended_by = "The arm arrived.", ""
        except SafetyStopError:
            raise
        except (RobotError, LimitError) as error:
            await robot.stop("stop test")
            said, ended_by = str(error), error.code
        finally:
            driving.cancel()
            with contextlib.suppress(asyncio.CancelledError, RobotError, LimitError):
                await driving
        if not context.requests.halt:
            context.store.event(STOP_TESTED, said, ended_by=ended_by)
            context.store.enter(StationState.IDLE, said, STOP_TESTED)

    async def _give_stop(self, driving: asyncio.Task[None]) -> None:
        """Trigger the stop in mid-move and note its exact time. RobotError where the way is missing."""
        robot, way = self._context.cell.robot, self._way
        start, target = (np.array(q) for q in (self._go.start_joints_rad, self._target_rad))
        while not driving.done():
            with contextlib.suppress(StaleStateError):  # the move itself reports states that are too old
                if np.abs(robot.latest().joints_rad - start).max() >= _MIDDLE * np.abs(target - start).max():
                    break
            await asyncio.sleep(_LOOK_S)
        else:
            return  # the move ended before, and reports why
        moment_ns = time.monotonic_ns()
        if way is StopWay.FROZEN:
            time.sleep(FROZEN_S)  # blocks the event loop on purpose, and with it heartbeat and STOP
        else:
            robot.stop_one_way(way)
        self._context.store.event(STOP_GIVEN, f"stop given: {way.value}", moment_ns=moment_ns)
