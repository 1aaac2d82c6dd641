"""What a client may ask of the session: who may, and what each verb of `station.protocol.verbs` calls."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine

import msgspec

from station.cell.errors import RefusedError, RobotError, StationError
from station.cell.socket_folder import user_name
from station.cell.status import StationState, StationStatus
from station.cell.stillness import RESTING_RAD_S, fastest_rad_s
from station.protocol import verbs
from station.protocol.stop_client import ArmMotion
from station.protocol.verbs import VERBS, Verb
from station.server.approval import Approval, ApprovalRule, Peer, Process, process
from station.server.quitting import require_nothing_left, require_started_by
from station.session.checklist import checklist
from station.session.session import Session
from station.session.threads import NAMES


class SessionDispatcher:
    """The session as the connections of `server.connections` reach it."""

    def __init__(
        self,
        session: Session,
        see: Callable[[int], Process | None] = process,
        end: Callable[[], None] = lambda: None,
        service: str = "",
    ) -> None:
        """`end`: begins the daemon's end. `service`: `way_of_service`, empty where a person started it."""
        self._session = session
        self._end, self._service = end, service
        cell = session.context.cell
        self._rule = ApprovalRule(cell.config.approval, cell.source == "simulated", see)
        self._leaving: set[asyncio.Task[object]] = set()
        self._names: dict[int, str] = {}
        """User id → name, once looked up."""

    @property
    def status(self) -> StationStatus:
        return self._session.store.status

    @property
    def latched(self) -> bool:
        """Tell whether STOP is latched."""
        return self.status.state is StationState.STOPPED

    @property
    def motion(self) -> ArmMotion:
        """Tell whether the arm moves now.

        While STOP is latched an arm rests only by a state that is from after STOP arrived at its controller.
        """
        cell = self._session.context.cell
        try:
            state = cell.arm.state()
        except RobotError:
            return ArmMotion.UNKNOWN
        if not state.joint_speeds_rad_s:
            return ArmMotion.UNKNOWN
        if not fastest_rad_s(state) <= RESTING_RAD_S:
            return ArmMotion.MOVES
        if self.latched and cell.mover is not None and not cell.mover.after_stop(state):
            return ArmMotion.MOVES
        return ArmMotion.RESTS

    def left_out(self, section: str) -> None:
        """Tell that a section of the status reaches no client, where a defect made it unreadable."""
        defect = StationError("status-unreadable", section=section)
        self._session.store.problem(defect, "error")

    def stop_by_client(self, peer: Peer) -> Awaitable[object]:
        """Begin STOP at once; return an awaitable for its end."""
        return self._to_the_end(self._session.stop(peer.who))

    def stop_by_datagram(self, sender: Peer) -> None:
        """Begin STOP for a sender without a connection."""
        self._rule.meet(sender)
        sender.user = self._names.get(sender.uid, "")
        self._to_the_end(self._session.stop(sender.who))
        self._to_the_end(self._name(sender.uid))

    async def _name(self, uid: int) -> str:
        if uid not in self._names:
            # In a thread: where users come from a directory server, a name may take seconds.
            self._names[uid] = await NAMES.run(user_name, uid)
        return self._names[uid]

    def gone(self, peer: Peer) -> None:
        """Handle the end of a connection; the arm decelerates at once if it had control."""
        self._to_the_end(self._session.lease_lost(peer.client_id))

    def _to_the_end(self, work: Coroutine[object, object, object]) -> asyncio.Future[object]:
        """Run work that goes on when the client disconnects."""
        task = asyncio.create_task(work)
        self._leaving.add(task)
        task.add_done_callback(self._leaving.discard)
        return asyncio.shield(task)

    async def handle(self, caller: Peer, verb: str, args: msgspec.Raw) -> object:
        """Carry out a verb. RefusedError for wrong arguments, in a wrong state, or without control."""
        kind = VERBS[verb]
        try:
            request = msgspec.json.decode(args, type=kind)
        except msgspec.DecodeError as error:
            raise RefusedError("wrong-arguments", verb=verb, problem=str(error)) from None
        self._rule.meet(caller)
        if kind is verbs.Quit:
            require_started_by(caller, self._service)
        self._session.admit(kind, caller.client_id, caller.who)
        result = await self._carry_out(caller, request)
        return verbs.Done() if result is None else result

    async def _carry_out(self, caller: Peer, verb: Verb[object]) -> object:
        """Call what a verb is of; None: it has no result. `_to_the_end`: also if the client disconnects."""
        session, context, client = self._session, self._session.context, caller.client_id
        match verb:
            case verbs.Hello():
                await self._named(caller)
                return verbs.Welcome(client, str(context.root), context.cell.config)
            case verbs.Release():
                await self._to_the_end(session.release(client, verb.silent))
            case verbs.Acknowledge():
                session.require_latched()
                if session.latch.needs_person:
                    self._rule.by_person(await self._named(caller), "Acknowledging STOP or a fault")
                await session.acknowledge(caller.who, verb.cause)
            case verbs.GetPlan():
                queue = context.queue
                return verbs.LoadedPlan(queue.plan if queue else None)
            case verbs.LoadPlan():
                session.load_plan(client, verb.plan)
            case verbs.MakePlan():
                await session.make_plan(client, verb)
            case verbs.Prepare():
                if verb.stop_test is not None:
                    self._rule.by_person(await self._named(caller), "A stop test")
                return await session.prepare(client, verb.purpose, verb.stop_test)
            case verbs.Go():
                approval = await self._approval(caller, verb.approval_sha256)
                said = f"motion approved by {caller.who}, {approval.how}"
                await session.go(client, verb.token, said, by_person=approval.by_person)
            case verbs.Pause():
                session.pause(caller.who)
            case verbs.Finish():
                await self._to_the_end(session.finish(client))
            case verbs.Retake() | verbs.Skip():
                await session.edit(client, verb)
            case verbs.Freedrive():
                await self._to_the_end(session.switch_free_drive(client, verb.on, verb.check))
            case verbs.Record():
                await session.record(client)
            case verbs.Preview():
                return await session.previews.preview(verb.width, verb.height)
            case verbs.Observe():
                return await session.previews.observe(verb.tag)
            case verbs.Doctor():
                return await checklist(context, session.devices.troubles)
            case verbs.Quit():
                require_nothing_left(session, self.motion)
                context.store.event("quit", f"ended by {caller.who}", who=caller.who)
                self._end()
            case verbs.GetResult():
                return await session.results.result(verb.session)
            case verbs.GetSessions():
                return await session.results.sessions()
            case verbs.GetInstalled():
                return await session.results.installed()
            case _:
                return await self._change_results(caller, verb)
        return None

    async def _change_results(self, caller: Peer, verb: Verb[object]) -> object:
        """Install, undo, withdraw or note touch tests, to its end also if the client disconnects."""
        results, by = self._session.results, await self._named(caller)
        match verb:
            case verbs.Install():
                if verb.override:
                    self._rule.by_person(by, "Installing in spite of a refusal")
                work: Coroutine[object, object, object] = results.install(verb, by.user)
            case verbs.Rollback():
                work = results.rollback(verb, by.user)
            case verbs.Withdraw():
                work = results.withdraw(verb, by.user)
            case verbs.NoteTouches():
                work = results.note_touches(verb, by.user)
            case _:
                return None
        return await self._to_the_end(work)

    async def _approval(self, caller: Peer, sha256: str) -> Approval:
        """Check that this client may approve what is offered. RefusedError where it may not."""
        asks = await self._named(caller)
        waiting = self._session.approvals.waiting
        if waiting is not None and waiting.motion.stop_test is not None:
            return Approval(self._rule.by_person(asks, "A stop test"), by_person=True)
        offered_sha256 = waiting.preview.approval_sha256 if waiting is not None else ""
        return self._rule.approve(asks, sha256, offered_sha256, self._session.latch.bars_services)

    async def _named(self, caller: Peer) -> Peer:
        caller.user = await self._name(caller.uid)
        return caller
