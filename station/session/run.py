"""Run: carries out one approval, pose after pose."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence

import numpy as np

from recordings.errors import RecordingError
from recordings.schema.messages import Vector6
from station.cell.config import vector6
from station.cell.errors import LimitError, SafetyStopError, StationError
from station.cell.layout import cell_geometry
from station.cell.limits import check_path, with_plan_speeds
from station.cell.status import Event, StationState
from station.cell.stillness import JOGGED_RAD, NotStillError
from station.devices.base import wait_for_state
from station.session.capture import PoseFailedError, take_pose
from station.session.context import SessionContext
from station.session.ending import failed, seal
from station.session.motion import MotionApproval, require_start
from station.session.stop_move import stop_half_way
from station.session.threads import DISK, MOTION

log = logging.getLogger(__name__)

ARRIVED_RAD = 1e-4
"""Distance to the target within which no move is made."""
FAILURES_IN_A_ROW = 3


class Run:
    """Execution of one approval. Run `drive` as a task; when cancelled it ends after writing its data."""

    def __init__(self, context: SessionContext, go: MotionApproval) -> None:
        self._context, self._mover = context, context.cell.require_mover()
        self._go = go
        self._queue = go.motion.queue
        self._geometry = with_plan_speeds(cell_geometry(context.cell.config), self._queue.plan)
        self._failures, self._why = 0, ""
        self._unsettled: list[int] = []
        """Numbers of poses that did not settle."""

    async def drive(self) -> None:
        """Carry out the approval, ending in paused, stopped, fault or idle; raises only when cancelled."""
        try:
            if await self._begin():
                await self._motion()
        except SafetyStopError as error:
            failed(self._context, error)  # the controller itself stopped the arm
        except Exception as error:
            await self._mover.stop(str(error))
            failed(self._context, error)
        finally:
            try:
                await self._mover.end_control()
            finally:  # no pose is under way any more
                self._context.show_poses()
                self._context.end_check()

    async def _begin(self) -> bool:
        """Start control and open the recording. False when refused: the state is as before the approval."""
        context, resting = self._context, self._context.resting
        try:
            if self._go.motion.stop_test is None:
                context.require_same_cell(connected=False)
            if context.recording is not None:
                # Save the poses before anything moves, so that a restart finds them.
                await context.recording.save_state(self._queue)
            await self._mover.start_control()
            # Starting control takes a second or two.
            here = (await wait_for_state(context.cell.arm)).joints_rad
            require_start(here, self._go.start_joints_rad, "while control was started")
            if self._go.motion.stop_test is None:
                await self._open_recording()
        except SafetyStopError:
            raise
        except (StationError, RecordingError) as error:
            if not context.requests.halt:
                context.store.enter(resting, error)
                context.store.problem(error, "error", said="not started: {}")
            return False
        return True

    async def _open_recording(self) -> None:
        context = self._context
        if context.recorder is not None:
            return
        await context.open_recording(self._queue, context.store.status.session.check)
        context.show_poses()
        recording = context.require_recording()
        context.record_event(Event(time.time_ns(), "info", self._go.said, code="approved"))
        text = f"recording to {recording.folder}, segment {recording.segment}"
        context.store.event("recording", text, segment=recording.segment)

    async def _motion(self) -> None:
        """Drive what was approved, to the state that follows it."""
        if (test := self._go.motion.stop_test) is not None:
            here = vector6((await self._context.ready_state()).joints_rad)
            move = self._drive(here, vector6(self._queue.pose(0).joints_rad), "stop test")
            await stop_half_way(self._context, test, here, move)
            return
        recording = self._context.require_recording()
        recording.count_time(running=True)
        try:
            await self._all_poses()
        finally:
            recording.count_time(running=False)
        if not self._context.requests.halt:
            await self._rest()

    async def _all_poses(self) -> None:
        context, queue = self._context, self._queue
        started_s, taken = time.monotonic(), 0
        todo = list(self._go.motion.poses)
        while not context.requests.halt:
            todo = [index for index in todo if index in queue.open]
            asked = context.requests
            if asked.pause_by or asked.finish or not todo or self._failures >= FAILURES_IN_A_ROW:
                break
            index = todo.pop(0)
            await DISK.run(context.require_recording().require_space)
            await self._pose(index)
            taken += 1
            # By the average of this run, while elapsed time includes the session's earlier runs.
            remaining_s = round((time.monotonic() - started_s) / taken * len(todo), 1)
            elapsed_s = round(context.require_recording().elapsed_s, 1)
            context.store.update_session(elapsed_s=elapsed_s, remaining_s=remaining_s)

    async def _pose(self, index: int) -> None:
        context, queue = self._context, self._queue
        attempt = queue.start_attempt(index)
        try:
            await self._move_to(index)
            await take_pose(context, index, attempt)
            self._failures = 0
        except (PoseFailedError, NotStillError, LimitError) as error:
            self._failures, self._why = self._failures + 1, str(error)
            if isinstance(error, NotStillError):
                self._unsettled.append(index)
            queue.mark(index, "failed", error)
            context.store.problem(error, "warning", index)
            await context.require_recording().save_state(queue)
            context.show_poses(index)

    async def _move_to(self, index: int) -> None:
        """Move to a pose from where the arm is. LimitError when the path is not free."""
        context, queue = self._context, self._queue
        here, target = (vector6(at.joints_rad) for at in (await context.ready_state(), queue.pose(index)))
        context.store.enter(StationState.MOVING)
        context.show_poses(index)
        if np.abs(np.subtract(target, here)).max() < ARRIVED_RAD:
            return
        await self._drive(here, target, f"pose {index + 1}")

    async def _drive(self, here: Vector6, target: Vector6, name: str) -> None:
        """Check the path from `here`, where the arm stands, and move. LimitError when it is not free."""
        # In a thread, so that heartbeat and STOP need not wait.
        check = await MOTION.run(check_path, self._geometry, here, target, name)
        if check.problems:
            raise LimitError("path", listed="; ".join(map(str, check.problems)))
        now = (await self._context.ready_state()).joints_rad
        moved_rad = float(np.abs(np.subtract(now, here)).max())
        if not moved_rad <= JOGGED_RAD:  # less may be settling; NaN is nowhere
            when = "while its path was checked"
            raise LimitError("arm-moved", when=when, moved_rad=moved_rad, limit_rad=JOGGED_RAD, advice="")
        await self._mover.move(target, check.joint_speed_rad_s, check.joint_acceleration_rad_s2)

    async def _rest(self) -> None:
        """Enter the state after the last pose of the approval: finished, or paused with the reason."""
        context, queue = self._context, self._queue
        await self._mover.end_control()  # before finishing, as heartbeats end with the run
        if context.requests.halt:
            return
        if context.requests.finish or (not queue.open and not queue.failed):
            await seal(context)
            return
        cause, reason = self._why_paused()
        context.requests.pause_by = ""
        context.store.enter(StationState.PAUSED, reason, cause)
        context.store.event(cause, reason)
        context.show_poses()

    def _why_paused(self) -> tuple[str, str]:
        """Say why the session is paused: code and sentence."""
        queue, pausing = self._queue, self._context.requests.pause_by
        if pausing:
            return "paused", f"Paused by {pausing}. Approve again to continue."
        if self._failures >= FAILURES_IN_A_ROW:
            remedy = "Mend the cause, then continue or finish."
            return "failures", f"{self._failures} poses in a row failed: {self._why.rstrip('.')}. {remedy}"
        if queue.open:
            count = len(queue.open)
            left = "1 pose is" if count == 1 else f"{count} poses are"
            return "poses-left", f"{left} left. Approve again to continue."
        unsettled = [index for index in self._unsettled if index in queue.failed]
        shown = unsettled or queue.failed
        why = queue.status(shown[0]).reason.rstrip(".")
        what = "did not settle" if unsettled else "failed"
        cause = "unsettled" if unsettled else "poses-failed"
        return cause, f"{_numbers(shown)} {what} ({why}). Retake, skip, or finish."


def _numbers(indices: Sequence[int]) -> str:
    """Name poses with numbers from 1: 'pose 4', 'poses 4, 7'."""
    return f"pose{'s' * (len(indices) > 1)} " + ", ".join(str(index + 1) for index in indices)
