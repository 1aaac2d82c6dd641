"""Capture in freedrive: the operator moves the arm by hand, the station guides and records."""

from __future__ import annotations

import asyncio
import logging

import msgspec
import numpy as np

from recordings.errors import CodedError
from recordings.schema.messages import NO_PICTURE, View
from station.analysis.hand_guide import HandGuide
from station.cell.config import matrix4
from station.cell.errors import RefusedError, StaleStateError
from station.cell.pose_plan import Plan, PlannedPose
from station.cell.status import GuidanceStatus, StationState
from station.cell.stillness import NotStillError
from station.devices.base import wait_for_state
from station.protocol.verbs import Freedrive, Record
from station.session.capture import PoseFailedError, take_pose
from station.session.context import SessionContext
from station.session.ending import failed
from station.session.estimator import look_back
from station.session.previews import PREVIEW_PERIOD_S, Previewer
from station.session.queue import PoseQueue

log = logging.getLogger(__name__)

_GUIDE = "Guide the arm by hand. The station does not move it."


class FreedriveCapture:
    """Capture in freedrive. Never moves the arm, so it needs no approval."""

    def __init__(self, context: SessionContext, previews: Previewer) -> None:
        self._context, self._previews = context, previews
        self.guide: HandGuide | None = None
        """Of the freedrive under way, or of the last one."""
        self._taking = asyncio.Lock()
        context.store.watch(self._note_guiding)

    async def run(self) -> None:
        """Guide the person, and take views by themselves, until cancelled."""
        store, told = self._context.store, ""
        while True:
            await asyncio.sleep(PREVIEW_PERIOD_S)
            if store.state is not StationState.FREE_DRIVE or self.taking:
                if store.state in (StationState.IDLE, StationState.PAUSED):
                    store.update(guidance=GuidanceStatus())
                    told = ""
                continue
            try:
                await self._look()
            except CodedError as error:  # a lost image, a late state: the next look may see more
                log.debug("no guidance: %s", error)
            except Exception as error:  # capture by hand goes on without it
                if told != (told := repr(error)):
                    log.exception("the guidance failed")
                    store.problem(error, said=f"the guidance failed: {error!r}")

    async def _look(self) -> None:
        context, store, config = self._context, self._context.store, self._context.cell.config
        looked, recording, guide = await self._previews.look(), context.recording, self.guide
        if looked is None or guide is None or recording is None or recording.camera is None:
            return
        lens, known = config.camera.model or recording.camera, context.cell.camera_model is not None
        cell, views = (config.mount, config.board, lens, known), list(context.seen.values())
        guidance = await guide.look(cell, views, *looked)
        if store.state is not StationState.FREE_DRIVE:
            return
        session, precise = store.status.session, store.status.estimate.enough
        enough = len(context.seen) >= session.least_by_hand and (precise or session.check)
        store.update(guidance=msgspec.structs.replace(guidance, enough=enough))
        if guide.take:
            guide.taken(await self.record(asked=False) in context.seen)

    def _note_guiding(self) -> None:
        """Tell the robot driver whether a person may move the arm, for its limits on late states."""
        state = self._context.store.state
        if state not in (StationState.SETTLING, StationState.CAPTURING, StationState.WRITING):
            self._context.cell.arm.guided = state is StationState.FREE_DRIVE

    async def begin(self, check: bool = False) -> None:
        """Begin freedrive; open a recording if none is open, of a drift check where `check`."""
        if self.taking:
            raise RefusedError("still-ending", what="the last image")
        context, store = self._context, self._context.store
        if check and context.recording is not None:
            raise RefusedError("session-open")
        await context.ready_state()
        context.require_same_cell(connected=False)
        await look_back(context)
        Freedrive.require(store.state)  # STOP may have come in between
        context.requests.halt = False
        arm = context.cell.arm
        self.guide = HandGuide(arm.state, context.stillness, arm.identity, context.workers.call)
        # Enter the state at once: while the file is opened no motion is offered and no image begun.
        store.enter(StationState.FREE_DRIVE, "The recording is being opened.")
        async with self._taking:
            try:
                await self._open_recording(check)
            except BaseException:
                if store.state in (StationState.FREE_DRIVE, StationState.PAUSED):
                    store.enter(context.resting)
                raise
        if store.state is StationState.IDLE:  # acknowledged before there was a recording to pause
            store.enter(context.resting)
        Record.require(store.state)  # STOP, or the end of freedrive, may have come in between
        store.enter(StationState.FREE_DRIVE, _GUIDE)

    async def _open_recording(self, check: bool) -> None:
        context, new = self._context, self._context.recording is None
        config = context.cell.config
        if context.queue is None:
            context.queue = PoseQueue(Plan(config.robot.model, config.mount, ()))
        queue = context.queue.anew(guided=False) if new else context.queue
        await context.open_recording(queue, check=check)
        if new:
            context.begin_session(context.standing if check else None)
        context.queue = queue
        context.show_poses()

    def end(self) -> None:
        """End freedrive: to paused; the recording stays open."""
        if self._context.store.state is StationState.FREE_DRIVE:
            self._context.store.enter(
                StationState.PAUSED, "Freedrive ended. Resume or finish.", "freedrive-ended"
            )

    @property
    def taking(self) -> bool:
        """True while an image is being taken."""
        return self._taking.locked()

    async def last_picture(self) -> None:
        """Wait for the image under way."""
        async with self._taking:
            pass

    async def take_back(self, index: int) -> None:
        """Let an image count no more, in the recording too. RefusedError, RecordingError."""
        if self.taking:
            raise RefusedError("still-ending", what="the last image")
        context, queue, recording = self._context, self._context.loaded(), self._context.recording
        async with self._taking:
            queue.take_back(index)
            view = context.seen.pop(index, None)
            flange = matrix4(np.eye(4) if view is None else view.base_from_flange)
            attempt, name = queue.start_attempt(index), queue.pose(index).name
            if recording is not None:
                recording.require_open().view(
                    View(index, name, NO_PICTURE, flange, attempt=attempt, taken_back=True)
                )
                await recording.sync()
                await recording.save_state(queue)
            context.show_poses(index)

    async def record(self, asked: bool = True) -> int:
        """Take an image now; return its pose number. RefusedError while one is being taken.

        `asked`: by a person; otherwise a pose without an image leaves no trace.
        """
        if self._taking.locked():
            raise RefusedError("still-ending", what="the last image")
        async with self._taking:
            return await self._record(asked)

    async def _record(self, asked: bool) -> int:
        context = self._context
        queue, store = context.loaded(), context.store
        joints = (await wait_for_state(context.cell.arm)).joints_rad
        Record.require(store.state)  # STOP, or the end of freedrive, may have come in between
        index = queue.add(
            PlannedPose(f"hand-{len(queue.statuses) + 1:02d}", joints, why="guided by hand", guided=True)
        )
        attempt = queue.start_attempt(index)
        try:
            await take_pose(context, index, attempt, unchecked=asked)
        except (PoseFailedError, NotStillError, StaleStateError) as error:  # late states: no move to stop
            if asked:
                queue.mark(index, "failed", error)
            else:
                queue.drop_last()
            if asked or not isinstance(error, NotStillError):
                store.problem(error, "warning", index)
        except Exception as error:
            failed(context, error)
            return index
        if not context.requests.halt and store.state is not StationState.FAULT:
            store.enter(StationState.FREE_DRIVE, _GUIDE)
        context.show_poses(min(index, len(queue.statuses) - 1) if queue.statuses else None)
        if context.requests.pause_by:
            context.requests.pause_by = ""
            self.end()
        return index
