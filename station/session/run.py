"""Carries out one go: pose after pose, until all are done, a person says otherwise, or something fails."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from recordings.errors import RecordingError
from recordings.recover import recover
from recordings.schema.messages import Image, Vector6
from station.cell.errors import (
    LimitError,
    RefusedError,
    RobotError,
    SafetyStopError,
    StationError,
    TriggerError,
)
from station.cell.limits import check_path, with_plan_speeds
from station.cell.scene import geometry_from
from station.cell.status import Event, StationState
from station.cell.stillness import NotStillError
from station.session.capture import PoseFailedError, take_pose
from station.session.context import SessionContext
from station.session.lease import START_TOLERANCE_RAD, MotionApproval
from station.session.patience import RestingCheck
from station.session.recording import SessionRecording, to_the_end
from station.session.supervisor import JOGGED_RAD

log = logging.getLogger(__name__)

ARRIVED_RAD = 1e-4
"""Nearer to its target than this the arm need not move."""
FAILURES_IN_A_ROW = 3


class Run:
    """The owner calls `drive` as a task; cancelling it ends it where it is, after the disk has its data."""

    def __init__(self, context: SessionContext, go: MotionApproval) -> None:
        self._context = context
        self._go = go
        geometry = geometry_from(context.cell.config, go.start_joints_rad)
        self._geometry = with_plan_speeds(geometry, context.require_queue().plan)
        self._failures, self._why = 0, ""
        self._unsettled: list[int] = []
        """Poses where something still moved."""
        self._tried_again = False

    async def drive(self) -> None:
        """From checking to paused, stopped, fault or idle; raises only when cancelled."""
        try:
            if await self._begin():
                await self._poses()
        except SafetyStopError as error:
            self._halt(StationState.STOPPED, str(error))  # the controller itself holds the arm
        except (RobotError, TriggerError) as error:
            await self._context.cell.robot.stop(str(error))
            self._halt(StationState.FAULT, str(error))
        except RecordingError as error:
            await self._context.cell.robot.stop("the disk failed")
            disk_failed(self._context, error)
        except Exception as error:
            # A defect of this program: the arm must stand, and the state must say so.
            log.exception("the run failed")
            reason = f"internal error ({error!r}): the run was ended; see the log"
            await self._context.cell.robot.stop(reason)
            self._halt(StationState.FAULT, reason)
        finally:
            await self._context.cell.robot.end_control()

    def _halt(self, state: StationState, reason: str) -> None:
        """The run's own end for a reason; nothing when STOP or a lost lease already ended it."""
        context = self._context
        if context.halting:
            return
        context.store.enter(state, reason)
        context.store.event(reason, "error", context.store.status.session.current)
        unmark_busy(context)

    async def _begin(self) -> bool:
        """Opens control and the recording. False when refused: the state is as before the go."""
        context, resting = self._context, self._context.resting
        try:
            if context.recording is not None:
                # Nothing moves by poses that a restart would not find again.
                await context.recording.save_state(context.require_queue())
            await context.cell.robot.start_control()
            self._require_start()
            await self._open_recording()
        except SafetyStopError:
            raise
        except (StationError, RecordingError) as error:
            if not context.halting:
                context.store.enter(resting, str(error))
                context.store.event(f"not started: {error}", "error")
            return False
        return True

    def _require_start(self) -> None:
        """Starting control takes a second or two. RefusedError when the arm was moved meanwhile."""
        here = self._context.cell.robot.latest().joints_rad
        moved_rad = float(np.abs(np.subtract(here, self._go.start_joints_rad)).max())
        if moved_rad > START_TOLERANCE_RAD:
            raise RefusedError(
                f"the arm moved by {np.rad2deg(moved_rad):.1f}° while control was started: prepare again"
            )

    async def _open_recording(self) -> None:
        context = self._context
        queue = context.require_queue()
        recording = context.recording
        if recording is not None and recording.recorder is not None:
            return
        first: Image | None = None
        if context.cell.config.camera.model is None:
            first = await context.cell.camera.capture()
        if recording is not None:
            await recover_parts(context, recording)
        fresh = recording or SessionRecording(
            context.root, context.cell, check=context.store.status.session.check
        )
        # Before it is open: after a STOP in between, what is there must be closed.
        context.recording = fresh
        try:
            await fresh.open(queue, first)
        except RecordingError:
            context.recording = recording
            raise
        context.show_poses()
        context.record_event(Event(time.time_ns(), "info", self._go.said))  # said before it was open
        context.store.event(f"recording to {fresh.folder}, part {fresh.part}")

    async def _poses(self) -> None:
        recording = self._context.require_recording()
        recording.count_time(running=True)
        try:
            await self._all_poses()
        finally:
            recording.count_time(running=False)
        if not self._context.halting:
            await self._rest()

    async def _all_poses(self) -> None:
        context = self._context
        queue = context.require_queue()
        started_s, taken = time.monotonic(), 0
        todo = list(self._go.poses)
        while not context.halting:
            todo = [index for index in todo if index in queue.open] or self._once_more()
            if self._wants_rest() or not todo or self._failures >= FAILURES_IN_A_ROW:
                break
            index = todo.pop(0)
            context.require_recording().require_space()
            await self._pose(index)
            taken += 1
            self._show_times((time.monotonic() - started_s) / taken * len(todo))

    def _once_more(self) -> list[int]:
        """Poses that did not come to rest, once, under the same go, where nobody can be asked.

        The same places that the go covers; every way is checked anew from where the arm stands.
        """
        queue = self._context.require_queue()
        found = [index for index in self._unsettled if queue.status(index).state == "failed"]
        if not self._go.again or self._tried_again or self._wants_rest() or not found:
            return []
        self._tried_again, self._unsettled, self._failures = True, [], 0
        for index in found:
            queue.mark(index, "planned", "did not come to rest: tried once more")
        self._context.store.event(f"once more, by the same go: {_numbers(found)}, which did not come to rest")
        return found

    def _wants_rest(self) -> bool:
        return bool(self._context.pause_wanted) or self._context.finish_wanted

    async def _pose(self, index: int) -> None:
        context = self._context
        queue = context.require_queue()
        attempt = queue.start_attempt(index)
        try:
            await self._move_to(index)
            await take_pose(context, index, attempt)
            self._failures = 0
        except (PoseFailedError, NotStillError, LimitError) as error:
            self._failures, self._why = self._failures + 1, str(error)
            if isinstance(error, NotStillError):
                self._unsettled.append(index)
            queue.mark(index, "failed", str(error))
            context.store.event(str(error), "warning", index)
            await context.require_recording().save_state(queue)
            context.show_poses(index)

    async def _move_to(self, index: int) -> None:
        """From where the arm really is. LimitError when that way is not free."""
        context = self._context
        robot, queue = context.cell.robot, context.require_queue()
        await RestingCheck(robot.check).news()
        here, target = robot.latest().joints_rad, queue.pose(index).joints_rad
        queue.mark(index, "moving")
        context.store.enter(StationState.MOVING)
        context.show_poses(index)
        if np.abs(np.subtract(target, here)).max() < ARRIVED_RAD:
            return
        await self._drive(here, target, f"pose {index + 1}")

    async def _drive(self, here: Vector6, target: Vector6, name: str) -> None:
        """LimitError when the way from `here`, where the arm stands, is not free."""
        robot = self._context.cell.robot
        # In a thread: neither the heartbeat nor STOP waits for it.
        check = await asyncio.to_thread(check_path, self._geometry, here, target, name)
        if check.problems:
            raise LimitError("; ".join(map(str, check.problems)))
        await RestingCheck(robot.check).news()
        moved_rad = float(np.abs(np.subtract(robot.latest().joints_rad, here)).max())
        if moved_rad > JOGGED_RAD:  # after a swing it may settle by less than that
            raise LimitError(f"the arm moved by {np.rad2deg(moved_rad):.1f}° while its way was checked")
        await robot.move(target, check.joint_speed_rad_s, check.joint_acceleration_rad_s2)

    def _show_times(self, remaining_s: float) -> None:
        """Elapsed, the session's runs before this one included; remaining, by this one's average."""
        elapsed_s = round(self._context.require_recording().elapsed_s, 1)
        session = msgspec.structs.replace(
            self._context.store.status.session, elapsed_s=elapsed_s, remaining_s=round(remaining_s, 1)
        )
        self._context.store.update(session=session)

    async def _rest(self) -> None:
        """Where the session stands when its go is used up."""
        context = self._context
        queue = context.require_queue()
        await context.cell.robot.end_control()  # before sealing: heartbeats end with the run
        if context.halting:
            return
        if context.finish_wanted or (not queue.open and not queue.failed):
            await seal(context)
            return
        if context.pause_wanted:
            reason = f"paused by {context.pause_wanted}: give a new go to go on"
        elif self._failures >= FAILURES_IN_A_ROW:
            reason = f"{self._failures} poses in a row failed ({self._why}): mend that, then go on, or finish"
        elif queue.open:
            count = len(queue.open)
            left = "1 pose is left" if count == 1 else f"{count} poses are left"
            reason = f"{left}: give a new go to go on"
        elif unsettled := [index for index in self._unsettled if index in queue.failed]:
            reason = (
                f"{_numbers(unsettled)} did not come to rest ({queue.status(unsettled[0]).reason}): "
                "take again (retake) or leave out (skip), or finish"
            )
        else:
            why = queue.status(queue.failed[0]).reason
            reason = f"{_numbers(queue.failed)} failed ({why}): retake or skip, or finish"
        context.pause_wanted = ""
        context.store.enter(StationState.PAUSED, reason)
        context.store.event(reason)
        context.show_poses()


def _numbers(indices: Sequence[int]) -> str:
    """'pose 4', 'poses 4, 7', as people count."""
    return f"pose{'s' * (len(indices) > 1)} " + ", ".join(str(index + 1) for index in indices)


async def recover_parts(context: SessionContext, recording: SessionRecording) -> None:
    """Of an interrupted session: what its crash left open is made whole before another part follows."""
    await recording.released()
    async with recording.recovering:
        if recording.unsealed_parts:
            for found in await context.workers.call(recover, recording.folder):
                context.store.event(f"recovered {found.text}")
        recording.count_parts()


async def seal(context: SessionContext) -> None:
    """sealing → idle. A disk that fails leaves a fault; the `.part` file is kept for recovery."""
    context.store.enter(StationState.SEALING)
    context.show_poses()
    context.pause_wanted, context.finish_wanted = "", False
    await to_the_end(_seal(context))


async def _seal(context: SessionContext) -> None:
    sealed(context, await context.require_recording().seal(context.require_queue()))


def sealed(context: SessionContext, path: Path) -> None:
    """The session is whole. A STOP meanwhile stays latched; was it acknowledged, nothing is left paused."""
    queue = context.require_queue()
    context.recording = None
    session = msgspec.structs.replace(context.store.status.session, recording=str(path), remaining_s=0.0)
    context.store.update(session=session)
    # What matters first: a narrow screen cuts the end.
    context.store.event(f"sealed with {queue.done} of {len(queue.statuses)} poses: {path}")
    if context.store.state in (StationState.SEALING, StationState.PAUSED):
        context.store.enter(StationState.IDLE)


def disk_failed(context: SessionContext, error: RecordingError) -> None:
    """The `.part` file is left for recovery; told in every state, and a STOP meanwhile stays latched."""
    if context.recording is not None:
        context.recording.abandon()
    reason = f"recording: {error}. What was saved before is safe."
    if context.halting:
        context.store.update(reason=f"{context.store.status.reason} — {reason}")
    else:
        context.store.enter(StationState.FAULT, reason)
    context.store.event(reason, "error", context.store.status.session.current)
    unmark_busy(context)


def unmark_busy(context: SessionContext) -> None:
    """After a halt: what was not written is planned again."""
    queue = context.queue
    if queue is None:
        return
    for status in queue.statuses:
        if status.state in ("moving", "settling", "capturing", "writing"):
            queue.mark(status.index, "planned", "interrupted")
    context.show_poses()
