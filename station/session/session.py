"""The session's state machine: commands of clients and their effects.

All commands run in the event loop; `stop` and the loss of control interrupt the others at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path

from recordings.errors import RecordingError
from station.analysis.pool import Workers
from station.analysis.result_files import start_reader
from station.analysis.worker import start_worker
from station.cell.errors import RefusedError, RobotError, StationError
from station.cell.layout import approval_sha256
from station.cell.pose_plan import Plan
from station.cell.session_folder import interrupted_session
from station.cell.status import LeaseStatus, MotionPreview, StationState, StationStatus
from station.cell.stillness import StillnessMonitor
from station.devices.base import wait_for_state
from station.devices.cell import Cell
from station.plan.choose import CRITERIA
from station.plan.planner import make_plan
from station.protocol import verbs
from station.protocol.states import LATCHED, RUNNING
from station.protocol.verbs import Purpose, Verb
from station.session.context import RunRequests, SessionContext, StatusStore
from station.session.device_connector import DeviceConnector
from station.session.ending import close_or_seal
from station.session.estimator import Estimator, look_back
from station.session.freedrive import FreedriveCapture
from station.session.latch import Latch, LatchKeeper
from station.session.motion import ApprovalManager, offered, session_motion
from station.session.predictor import Predictor
from station.session.previews import Previewer
from station.session.queue import PoseQueue, refused
from station.session.results import Results
from station.session.run import Run
from station.session.stop_move import stop_motion
from station.session.supervisor import SessionSupervisor
from station.session.threads import DISK

log = logging.getLogger(__name__)

END_RUN_S = 10.0
"""Longest wait for a run to end before what must follow it is refused."""
END_RUN_AT_CLOSE_S, CLOSE_DEVICES_S = 1.0, 1.8
"""Longest waits at the daemon's end for a run and for devices."""
LATCH_WRITTEN_S = 1.0
"""Longest wait, at the daemon's end and for an acknowledgement, until the file of the latch is written."""
STOP_WAIT_S = 1.0
"""Longest time that the answer to STOP, sent after the arm was stopped, waits for data being written."""
PLAN_TIMEOUT_S = 180.0
BEGIN_AGAIN_S = 0.2
"""Pause after a defect in a task of the daemon, so that one that stays does not fill the loop."""


class Session:
    """Session of a cell, below the folder `root`; independent of sockets and screens."""

    def __init__(self, cell: Cell, root: Path) -> None:
        config = cell.config
        self.store = StatusStore(StationStatus(source=cell.source, cell=config.name, mount=config.mount))
        monitor = StillnessMonitor(config.stillness)
        self.context = SessionContext(cell, self.store, Workers(start_worker), monitor, root)
        # This clock goes on while the computer sleeps: no offer outlives that.
        self.approvals = ApprovalManager(lambda: time.clock_gettime(time.CLOCK_BOOTTIME))
        self.devices = DeviceConnector(self.context)
        self.previews = Previewer(self.context)
        self.freedrive = FreedriveCapture(self.context, self.previews)
        self.results = Results(config, cell.source, root, self.store, Workers(start_reader))
        self._estimator = Estimator(self.context)
        self._predictor = Predictor(self.context)
        self._run: asyncio.Task[None] | None = None
        self._stops = 0
        """Number of STOPs: an acknowledgement is not of one that came after it was asked for."""
        self._ending = False
        """The daemon ends: nobody gets or keeps control."""
        self._tasks: list[asyncio.Task[None]] = []
        cell.arm.subscribe(monitor.add)
        cell.arm.subscribe(self.context.record_state)
        self.store.recorded = self.context.record_event
        self.latch = LatchKeeper(root, cell.source, cell.mover is not None, self._show_latch)
        self.store.latched = self.latch.hold
        self.supervisor = SessionSupervisor(self.context, self.approvals.void, self.latch.hold)
        self.store.watch(self._estimator.poke)
        self.store.watch(self._predictor.poke)

    async def start(self) -> None:
        """Connect devices (read-only, with retries) and restore a session that a crash interrupted."""
        self.context.root.mkdir(parents=True, exist_ok=True)
        left_latched = await DISK.run(self.latch.read)
        self.latch.begin_with(left_latched)
        found = await DISK.run(interrupted_session, self.context.root)
        if found is not None:
            self.context.restore(*found)
        if left_latched is not None:
            self._enter_latched(left_latched)
        if self.context.cell.plan is not None and self.context.queue is None:
            self._replace_plan(self.context.cell.plan)
        watching = self.supervisor.run, self.supervisor.monitor.watch_files, self.results.watch
        figures = self._estimator.run, self._predictor.run
        loops = (*watching, self.latch.run, self.devices.run, *figures, self.freedrive.run)
        self._tasks = [asyncio.create_task(self.kept_going(loop)) for loop in loops]

    def _enter_latched(self, left: Latch) -> None:
        """Begin in the latched state that an earlier daemon on this folder left."""
        store = self.store
        said = f"{left.reason} That was {left.when}, before this daemon began."
        if left.state is None:
            store.event("services-barred", f"Services may not approve motion yet: {said}", "warning")
            return
        if store.state in LATCHED:  # by an interrupted session, which says what is saved
            store.update(reason=f"{store.status.reason} Before that: {left.reason}")
        else:
            store.enter(StationState(left.state), said, left.cause)
            self.latch.begin_with(left)  # the next daemon is told the same, and when it was
        store.event("latched-before", f"Latched: {said}", "warning")

    def _show_latch(self, latch: Latch | None) -> None:
        self.store.update(services_barred=latch.reason if latch is not None and latch.needs_person else "")

    async def kept_going(self, loop: Callable[[], Awaitable[object]]) -> None:
        """Run a task of the daemon's life; a defect in it ends in fault, then it begins again."""
        told = set[str]()

        def tell(error: Exception) -> None:
            if repr(error) not in told:  # one that stays fills no log
                told.add(repr(error))
                log.exception("a task of the daemon failed")

        while True:
            try:
                await loop()
                return
            except Exception as error:
                tell(error)
                defect = StationError("internal", error=repr(error))
            try:
                if self.store.state not in LATCHED:
                    await self._halt(StationState.FAULT, defect.text, defect.code)
            except Exception as error:  # the heartbeat must go on, whatever else fails
                tell(error)
            await asyncio.sleep(BEGIN_AGAIN_S)

    async def close(self) -> None:
        """Stop the arm, finish the recording, then close devices and worker."""
        context, self._ending = self.context, True
        self.approvals.void()
        if self.store.state in RUNNING:
            await self._halt(StationState.STOPPED, "The station is ending.", "station-ending")
        with contextlib.suppress(RefusedError):
            await self._run_ended(END_RUN_AT_CLOSE_S)
        if context.recording is not None and context.recorder is not None:
            with contextlib.suppress(RecordingError):
                path = await context.recording.seal(context.loaded())
                self.store.event("finished", f"finished before the end: {path}", path=str(path))
        await self.latch.settled(LATCH_WRITTEN_S)
        for task in self._tasks:
            task.cancel()
        context.workers.close()
        self.results.close()
        closing = asyncio.create_task(self.devices.close())
        _, left = await asyncio.wait({*self._tasks, closing}, timeout=CLOSE_DEVICES_S)
        if closing in left:
            log.error("the devices did not close within %g s", CLOSE_DEVICES_S)
        else:
            closing.result()

    # -- stopping, by anyone and anything ----------------------------------------------------------------

    async def stop(self, who: str) -> None:
        """Stop the arm now, from any client, in any state; latched until acknowledged.

        How STOP comes here, and goes on: `protocol.stop_client`.
        """
        self._stops += 1
        if self.store.state is StationState.STOPPED:
            await self._stop_arm(f"STOP by {who}")
            return
        sent = "" if self.context.cell.mover is not None else " Nothing was sent: use the arm's own pendant."
        await self._halt(StationState.STOPPED, f"STOP by {who}.{sent}", "stop")

    async def lease_lost(self, client_id: int, how: str = "The connection of {} was lost.") -> None:
        """Stop the arm as the client in control is gone; going on needs a new approval."""
        lease = self.store.status.lease
        if lease.client_id != client_id:
            return
        self.approvals.void()
        self.store.update(lease=LeaseStatus())
        if self.store.state in RUNNING:
            reason = how.format(lease.holder) + " Approve again to continue."
            self.latch.hold(reason, "control-lost")
            await self._halt(self.context.resting, reason, "control-lost")

    async def _halt(self, state: StationState, reason: str, cause: str) -> None:
        """Void the approval, end the run and stop the arm; then let the run write its data, `STOP_WAIT_S`."""
        context, run = self.context, self._run
        self.approvals.void()
        context.requests = RunRequests(halt=True)
        try:
            self.store.enter(state, reason, cause)
        finally:  # a defect in the states must not keep the arm moving
            if run is not None:
                run.cancel()
            await self._stop_arm(reason)
        self.store.event(cause, reason, "warning")
        if run is not None:
            await asyncio.wait({run}, timeout=STOP_WAIT_S)

    async def _stop_arm(self, reason: str) -> None:
        """Decelerate the arm by both ways (`devices.ur.UrRobot.stop`); nothing where a person moves it."""
        if (mover := self.context.cell.mover) is not None:
            await mover.stop(reason)

    async def acknowledge(self, who: str, cause: str = "") -> None:
        """End the latch after a person looked at the cell, and leave `stopped` or `fault`.

        `cause`: only of a state that has this cause; empty: whatever is latched. Whether the client may do it
        was decided before (`server.dispatch`). RefusedError when nothing is latched, or STOP came meanwhile.
        """
        self.require_latched()
        stops = self._stops
        try:
            await wait_for_state(self.context.cell.arm)
            resting = self.context.resting
        except RobotError:
            resting = StationState.DISCONNECTED
        self.require_latched()
        if self._stops != stops or (cause and cause != self.store.status.cause):
            raise RefusedError("stopped-again")
        self.latch.release()
        if self.store.state in LATCHED:
            self.store.enter(resting)
        self.store.event("acknowledged", f"acknowledged by {who}", who=who)
        await self.latch.settled(LATCH_WRITTEN_S)

    def require_latched(self) -> None:
        """Raise RefusedError where there is nothing that a person could acknowledge."""
        self._require_state(verbs.Acknowledge)
        if self.latch.held is None:
            raise verbs.Acknowledge.refused_because(self.store.state, "nothing is stopped", "")

    # -- from a question to a motion ---------------------------------------------------------------------

    async def prepare(
        self, client_id: int, purpose: Purpose = Purpose.RUN, stop_test: verbs.StopTest | None = None
    ) -> MotionPreview:
        """Check the whole path from where the arm is and offer it for approval, once."""
        context = self.context
        self.permit(verbs.Prepare, client_id)
        await self._run_ended()  # its control process may still be ending
        self.approvals.void()
        voids = self.approvals.voids
        if stop_test is not None:
            motion = await stop_motion(context, stop_test)
        else:
            await look_back(context)
            motion = session_motion(context, purpose)
        offer = await offered(context, motion, client_id)
        await context.cell.require_mover().may_start()
        self.permit(verbs.Prepare, client_id)
        if self.approvals.voids != voids:
            raise RefusedError("changed")
        self.approvals.offer(offer)
        return offer.preview

    async def go(self, client_id: int, token: str, approval: str = "", by_person: bool = False) -> None:
        """Start the offered motion, which was approved. RefusedError when anything changed.

        `approval`: who approved and how, for log and recording. `by_person`: a person at a terminal, who has
        looked at the cell and so lets services approve again after a lost connection.
        """
        context = self.context
        self.permit(verbs.Go, client_id)
        joints = (await wait_for_state(context.cell.arm)).joints_rad
        self.permit(verbs.Go, client_id)
        self._require_run_ended()
        if self.freedrive.taking:
            raise RefusedError("still-ending", what="freedrive")
        queue = context.queue
        sha256 = approval_sha256(queue.plan, context.cell.config) if queue else ""
        go = self.approvals.redeem(token, client_id, sha256, joints)
        go = replace(go, approval=approval or f"motion approved by {self.store.status.lease.holder}")
        context.requests = RunRequests()
        run, motion = Run(context, go), go.motion
        if motion.stop_test is None:
            if context.recording is None:
                check = motion.purpose is Purpose.DRIFT_CHECK
                # Its plan was loaded for it alone; else the plan itself stands there again.
                context.begin_session((context.replaced or context.standing) if check else None)
            context.queue = motion.queue
            context.show_poses()
        if by_person:
            self.latch.release_bar()
        self.store.enter(StationState.CHECKING)
        self.store.event("approved", go.said, approval_sha256=go.preview.approval_sha256)
        self._run = asyncio.create_task(run.drive())

    def pause(self, who: str) -> None:
        """Pause after this pose. Any client may, as it never causes motion."""
        self._require_state(verbs.Pause)
        self.context.requests.pause_by = who
        self.supervisor.monitor.refresh()  # the status tells it before the answer does
        self.store.event("pause-wanted", f"{who} asks to pause after this pose", who=who)

    async def finish(self, client_id: int) -> None:
        """Finish the recording, after the pose under way."""
        self.permit(verbs.Finish, client_id)
        self.approvals.void()
        if self.store.state in RUNNING and not self.freedrive.taking:
            self.context.requests.finish = True
            self.supervisor.monitor.refresh()
            self.store.event("finish-wanted", "finish after this pose")
            return
        if self.context.recording is None:
            raise RefusedError("nothing-recorded")
        await asyncio.gather(self._run_ended(), self.freedrive.last_picture())
        self._require_state(verbs.Finish)
        self._run = closing = asyncio.create_task(close_or_seal(self.context))  # as `_run`, it bars new runs
        await asyncio.wait({closing})
        if not closing.cancelled():
            closing.result()

    async def _run_ended(self, wait_s: float | None = None) -> None:
        """Wait for the end of the last run; RefusedError when it does not end in time (None: `END_RUN_S`)."""
        if self._run is not None and not self._run.done():
            await asyncio.wait({self._run}, timeout=END_RUN_S if wait_s is None else wait_s)
        self._require_run_ended()

    def _require_run_ended(self) -> None:
        if self._run is not None and not self._run.done():
            raise RefusedError("still-ending", what="the last run")

    # -- control, plan, freedrive ------------------------------------------------------------------------

    def take_lease(self, client_id: int, who: str) -> None:
        """Give control to a client, which may already have it. RefusedError names another that has it."""
        if self.store.status.lease.client_id is None:
            self.store.update(lease=LeaseStatus(who, client_id))
        self._require_control(client_id)

    def _require_control(self, client_id: int) -> None:
        lease = self.store.status.lease
        if self._ending:
            raise RefusedError("station-ending")
        if lease.client_id is None:
            raise RefusedError("no-control")
        if lease.client_id != client_id:
            raise RefusedError("control-held", holder=lease.holder)

    async def release(self, client_id: int, silent: bool = False) -> None:
        """Release control, as asked or as the terminal is `silent`; a moving arm decelerates."""
        how = "The terminal of {} does not answer." if silent else "{} released control."
        await self.lease_lost(client_id, how)

    def load_plan(self, client_id: int, plan: Plan | None) -> None:
        self.permit(verbs.LoadPlan, client_id)
        self._require_no_session()
        if plan is not None:
            self._replace_plan(plan)
        elif (before := self.context.replaced) is not None:
            self.approvals.void()
            self.context.replaced = None
            self.context.stand_again(before)

    async def make_plan(self, client_id: int, wanted: verbs.MakePlan) -> None:
        """Make a plan in the worker and load it. ConfigError and LimitError say what prevents it."""
        self.permit(verbs.MakePlan, client_id)
        self._require_no_session()
        try:
            start = (await wait_for_state(self.context.cell.arm)).joints_rad
        except RobotError:
            start = None
        self.store.event("planning", f"planning {wanted.poses} poses", poses=wanted.poses)
        plan = await self.context.workers.call(
            make_plan,
            self.context.cell.config,
            start_joints_rad=start,
            seed=wanted.seed,
            count=wanted.poses,
            lens_known=wanted.lens_known,
            criterion=CRITERIA[wanted.aim],
            timeout_s=PLAN_TIMEOUT_S,
        )
        self.load_plan(client_id, plan)

    def _require_no_session(self) -> None:
        if self.context.recording is not None:
            raise RefusedError("session-open")

    def _replace_plan(self, plan: Plan) -> None:
        self.approvals.void()
        self.context.replaced = self.context.standing
        self.context.queue = PoseQueue(plan)
        self.context.forget_session()
        self.context.show_poses()
        count = len(plan.poses)
        self.store.event("plan-loaded", f"plan of {count} poses loaded", poses=count)

    async def edit(self, client_id: int, verb: verbs.Retake | verbs.Skip) -> None:
        """Retake or skip a pose, voiding an offered motion.

        RecordingError: the change is made, but could not be saved.
        """
        self.permit(type(verb), client_id)
        context = self.context
        queue = context.loaded()
        if self.store.state is StationState.FREE_DRIVE:
            await self.freedrive.take_back(verb.index)
            return
        # Not by the state: after a loss of control it is `paused` while the image is still being written.
        busy = self.freedrive.taking or (self._run is not None and not self._run.done())
        under_way = busy and verb.index == self.store.status.session.current
        if under_way and queue.status(verb.index).state == "planned":
            raise refused("pose-busy", verb.index)
        change = queue.retake if isinstance(verb, verbs.Retake) else queue.skip
        change(verb.index)
        self.approvals.void()
        context.show_poses(self.store.status.session.current)
        if context.recording is not None:
            try:
                await context.recording.save_state(queue)
            except RecordingError as error:
                raise RecordingError("change-not-saved", reason=str(error)) from None

    async def switch_free_drive(self, client_id: int, on: bool, check: bool = False) -> None:
        self.permit(verbs.Freedrive, client_id)
        self.approvals.void()
        if on:
            await self._run_ended()
            await self.freedrive.begin(check)
        else:
            self.freedrive.end()

    async def record(self, client_id: int) -> int:
        self.permit(verbs.Record, client_id)
        return await self.freedrive.record()

    def admit(self, verb: type[Verb[object]], client_id: int, who: str) -> None:
        """Permit a request that arrives. If it needs control and nobody has it, its client gets control.

        `Go` gets none: an approval is for the client that had control when the motion was offered.
        """
        if verb.control and verb is not verbs.Go and self.store.status.lease.client_id is None:
            self._require_state(verb)
            self.take_lease(client_id, who)
        self.permit(verb, client_id)

    def permit(self, verb: type[Verb[object]], client_id: int) -> None:
        """Raise RefusedError unless a verb is allowed to this client in the present state.

        Called again after each wait: STOP or the loss of control may have come in between.
        """
        if verb.control:
            self._require_control(client_id)
        self._require_state(verb)

    def _require_state(self, verb: type[Verb[object]]) -> None:
        if verb.moves:
            self.context.cell.require_mover()
        verb.require(self.store.state)
