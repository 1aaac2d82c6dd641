"""Move of the acceptance test: one joint turns, slowly, and is stopped half way in one way.

Nothing is recorded here: the stop is judged from another connection to the arm (`cli.accept`).
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Coroutine, Iterator

import numpy as np

from calibrate.arms.kinematics import JOINT_NAMES
from recordings.schema.messages import Vector6
from station.cell.arm_acceptance import STOP_GIVEN, STOP_TESTED, StopTestMove, StopWay
from station.cell.config import vector6
from station.cell.errors import LimitError, RefusedError, RobotError, SafetyStopError, StaleStateError
from station.cell.layout import cell_geometry, pose_at
from station.cell.limits import MoveCheck, check_path, check_plan, slower
from station.cell.pose_plan import Plan
from station.cell.status import StationState
from station.protocol.verbs import Purpose, StopTest
from station.session.context import SessionContext
from station.session.motion import Motion
from station.session.queue import PoseQueue
from station.session.threads import MOTION

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


async def stop_motion(context: SessionContext, test: StopTest) -> Motion:
    """Find the move of a stop test from where the arm stands. Nothing moves yet.

    RefusedError, LimitError and RobotError say what prevents it.
    """
    if context.recording is not None:
        raise RefusedError("session-open")
    state = await context.ready_state()
    if (fraction := state.target_speed_fraction) < _SLIDER_FULL:
        raise RefusedError("slider-low", fraction=fraction)
    plan = await MOTION.run(_free_move, context, test, vector6(state.joints_rad))
    move = StopTestMove(
        test.way,
        context.cell.subject,
        test.joint,
        plan.poses[0].joints_rad[test.joint],
        plan.joint_speed_rad_s,
    )
    return Motion(Purpose.RUN, PoseQueue(plan), (0,), move)


def _free_move(context: SessionContext, test: StopTest, start: Vector6) -> Plan:
    """Plan the first turn with a free path; longer turns, and the wanted direction, are tried first."""
    config = context.cell.config
    geometry = slower(cell_geometry(config), speed_m_s=test.speed_m_s)
    joint, refused = JOINT_NAMES[test.joint], ""

    def turned(turn_rad: float) -> tuple[Vector6, MoveCheck]:
        target = vector6(np.array(start) + turn_rad * np.eye(6)[test.joint])
        return target, check_path(geometry, start, target)

    for turn_rad in _turns(turned(_PROBE_RAD)[1], test.forward):
        target, move = turned(turn_rad)
        plan = Plan(
            config.robot.model,
            config.mount,
            (pose_at(geometry.model, test.way.value, target),),
            joint_speed_rad_s=move.joint_speed_rad_s,
            joint_acceleration_rad_s2=move.joint_acceleration_rad_s2,
            note=f"stop test: {joint} turns {np.rad2deg(move.step_rad):.0f}° and {_WORDS[test.way]}",
        )
        check = check_plan(plan, start, geometry)
        if not check.problems:
            return plan
        refused = refused or str(check.problems[0])
    raise LimitError("stop-test-path", joint=joint, problem=refused)


def _turns(near: MoveCheck, forward: bool) -> Iterator[float]:
    """Yield turns (rad) of the joint: those of the wanted duration, then shorter ones."""
    sign, speed = 1.0 if forward else -1.0, near.joint_speed_rad_s
    ramp_s = speed / near.joint_acceleration_rad_s2
    whole = float(np.clip(speed * (MOVE_S - ramp_s), _PROBE_RAD, LONGEST_TURN_RAD))
    for share in (1.0, 0.7):
        yield from (sign * share * whole, -sign * share * whole)


async def stop_half_way(
    context: SessionContext,
    test: StopTestMove,
    start_rad: Vector6,
    move: Coroutine[object, object, None],
) -> None:
    """Run the move, stop it in the middle, and enter `idle` however it ended. Raises SafetyStopError."""
    context.store.enter(StationState.MOVING)
    driving = asyncio.create_task(move)
    try:
        await _give_stop(context, test, start_rad, driving)
        await driving
        said, ended_by = "The arm arrived.", ""
    except SafetyStopError:
        raise
    except (RobotError, LimitError) as error:
        await context.cell.require_mover().stop("stop test")
        said, ended_by = str(error), error.code
    finally:
        driving.cancel()
        with contextlib.suppress(asyncio.CancelledError, RobotError, LimitError):
            await driving
    if not context.requests.halt:
        context.store.event(STOP_TESTED, said, ended_by=ended_by)
        context.store.enter(StationState.IDLE, said, STOP_TESTED)


async def _give_stop(
    context: SessionContext, test: StopTestMove, start_rad: Vector6, driving: asyncio.Task[None]
) -> None:
    """Trigger the stop in mid-move and note its exact time. RobotError where the way is missing."""
    arm = context.cell.arm
    start, turn_rad = start_rad[test.joint], test.target_rad - start_rad[test.joint]
    while not driving.done():
        with contextlib.suppress(StaleStateError):  # the move itself reports states that are too old
            if abs(arm.state().joints_rad[test.joint] - start) >= _MIDDLE * abs(turn_rad):
                break
        await asyncio.sleep(_LOOK_S)
    else:
        return  # the move ended before, and reports why
    moment_ns = time.monotonic_ns()
    if test.way is StopWay.FROZEN:
        time.sleep(FROZEN_S)  # blocks the event loop on purpose, and with it heartbeat and STOP
    else:
        context.cell.require_mover().stop_one_way(test.way)
    context.store.event(STOP_GIVEN, f"stop given: {test.way.value}", moment_ns=moment_ns)
