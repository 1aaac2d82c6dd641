"""Dispatch of the verbs of `station.protocol.verbs` to the session: one method for each verb, by its name."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable, Coroutine
from operator import methodcaller

import msgspec

from station.cell.config import StationConfig
from station.cell.errors import RefusedError
from station.cell.session_folder import SessionSummary, list_sessions
from station.cell.socket_folder import user_name
from station.cell.status import MotionPreview
from station.protocol import verbs
from station.protocol.verbs import VERBS, Verb
from station.server.approval import ApprovalRule, Peer, Process, process
from station.session.checklist import checklist
from station.session.recording import software
from station.session.session import Session
from station.session.threads import ASKED, NAMES

CONNECTION = {"watch", "stop"}
"""Verbs that `server.control` carries out itself."""
_WHO_LIMIT = 60


class SessionDispatcher:
    """Implementation of `server.control.Handler` by a session."""

    def __init__(self, session: Session, see: Callable[[int], Process | None] = process) -> None:
        self._session, self._see = session, see
        cell = session.context.cell
        self._rule = ApprovalRule(cell.config.approval, cell.simulated, see)
        self._version = software()["calibration-station"]
        self._callers: dict[int, Peer] = {}
        self._leaving: set[asyncio.Task[object]] = set()
        self._names: dict[int, str] = {}
        """User id → name, once looked up."""
        self._methods = {name: getattr(self, f"_{name}") for name in VERBS.keys() - CONNECTION}

    def stop_now(self, peer: Peer) -> Awaitable[object]:
        """Begin STOP at once; return an awaitable for its end."""
        return self._to_the_end(self._session.stop(peer.who))

    def stop_from(self, sender: Peer) -> None:
        """Begin STOP for a sender without a connection, named by the connection of its process if any."""
        known = (c for c in self._callers.values() if (c.pid, c.uid) == (sender.pid, sender.uid))
        caller = next(known, None)
        user = self._names.get(sender.uid, f"uid {sender.uid}")
        who = caller.who if caller else f"{user} (pid {sender.pid})"
        self._to_the_end(self._session.stop(who))
        if sender.uid not in self._names:
            self._to_the_end(self._name(sender.uid))

    async def _name(self, uid: int) -> str:
        if uid not in self._names:
            # In a thread: where users come from a directory server, a name may take seconds.
            self._names[uid] = await NAMES.run(user_name, uid)
        return self._names[uid]

    def gone(self, peer: Peer) -> None:
        """Handle the end of a connection; the arm decelerates at once if it had control."""
        self._callers.pop(peer.client_id, None)
        self._to_the_end(self._session.lease_lost(peer.client_id))

    def _to_the_end(self, work: Coroutine[object, object, object]) -> asyncio.Future[object]:
        """Run work that goes on when the client disconnects."""
        task = asyncio.create_task(work)
        self._leaving.add(task)
        task.add_done_callback(self._leaving.discard)
        return asyncio.shield(task)

    async def handle(self, peer: Peer, verb: str, args: msgspec.Raw) -> object:
        """Carry out a verb. RefusedError for wrong arguments, in a wrong state, or without control."""
        if verb == "watch":
            return {}
        kind = VERBS[verb]
        try:
            request = msgspec.json.decode(args, type=kind)
        except msgspec.DecodeError as error:
            raise RefusedError(f"{verb}: wrong arguments ({error})", code="wrong-arguments") from None
        caller = self._caller(peer)
        self._session.admit(kind, caller.client_id, caller.who)
        result = await self._methods[verb](caller, request)
        return msgspec.to_builtins(verbs.Done() if result is None else result)

    def _caller(self, peer: Peer) -> Peer:
        if peer.client_id not in self._callers:
            self._callers[peer.client_id] = peer
            seen = self._see(peer.pid)
            peer.began_ticks = seen.began_ticks if seen else None
        return peer

    async def _hello(self, caller: Peer, args: verbs.Hello) -> verbs.Welcome:
        user = caller.user = await self._name(caller.uid)  # from the kernel; `who` is the client's own claim
        said = "".join(c for c in args.who if c.isprintable())[:_WHO_LIMIT] or user
        caller.told = said if said.split(" ")[0] == user else f"{user} ({said})"
        context = self._session.context
        config = context.cell.config
        rule_days = config.validity.max_age_days
        return verbs.Welcome(
            self._version, os.getpid(), caller.client_id, str(context.root), config.camera.name, rule_days
        )

    async def _release(self, caller: Peer, args: verbs.Release) -> None:
        await self._to_the_end(self._session.release(caller.client_id, args.silent))

    async def _acknowledge(self, caller: Peer, args: verbs.Acknowledge) -> None:
        await self._session.acknowledge(caller.who)

    async def _plan(self, caller: Peer, args: verbs.GetPlan) -> verbs.LoadedPlan:
        queue = self._session.context.queue
        return verbs.LoadedPlan() if queue is None else verbs.LoadedPlan(queue.plan, queue.sha256)

    async def _load_plan(self, caller: Peer, args: verbs.LoadPlan) -> verbs.PlanFacts:
        self._session.load_plan(caller.client_id, args.plan)
        return self._plan_facts()

    async def _make_plan(self, caller: Peer, args: verbs.MakePlan) -> verbs.PlanFacts:
        await self._session.make_plan(caller.client_id, args.poses, args.seed, args.lens_known, args.aim)
        return self._plan_facts()

    def _plan_facts(self) -> verbs.PlanFacts:
        queue = self._session.context.require_queue()
        return verbs.PlanFacts(len(queue.statuses), queue.sha256)

    async def _prepare(self, caller: Peer, args: verbs.Prepare) -> MotionPreview:
        if args.stop_test is not None:
            self._rule.by_person(await self._asks(caller), "A stop test")
        return await self._session.prepare(caller.client_id, args.purpose, args.index, args.stop_test)

    async def _go(self, caller: Peer, args: verbs.Go) -> None:
        asks, waiting = await self._asks(caller), self._session.approvals.waiting
        if waiting is not None and waiting.motion.stop_test is not None:
            how = self._rule.by_person(asks, "A stop test")
        else:
            how = self._rule.approve(asks, args.plan_sha256, waiting.preview.plan_sha256 if waiting else "")
        approval = f"motion approved by {caller.who}, {how}"
        await self._session.go(caller.client_id, args.token, approval, again=args.headless)

    async def _asks(self, caller: Peer) -> Peer:
        caller.user = await self._name(caller.uid)
        return caller

    async def _pause(self, caller: Peer, args: verbs.Pause) -> None:
        self._session.pause(caller.who)

    async def _finish(self, caller: Peer, args: verbs.Finish) -> None:
        await self._to_the_end(self._session.finish(caller.client_id))

    async def _edit(self, caller: Peer, args: Verb[object]) -> verbs.PoseNumber | None:
        """Change the poses by the queue's method that has the verb's name and arguments."""
        change = methodcaller(args.verb(), *msgspec.structs.astuple(args))
        index: int | None = await self._session.edit(type(args), caller.client_id, change)
        return None if index is None else verbs.PoseNumber(index)

    _retake = _skip = _reorder = _add = _drop = _edit

    async def _free_drive(self, caller: Peer, args: verbs.Freedrive) -> None:
        await self._to_the_end(self._session.switch_free_drive(caller.client_id, args.on, args.auto))

    async def _record(self, caller: Peer, args: verbs.Record) -> verbs.PoseNumber:
        return verbs.PoseNumber(await self._session.record(caller.client_id))

    async def _preview(self, caller: Peer, args: verbs.Preview) -> verbs.PreviewImage:
        return await self._session.previews.preview(args.width, args.height)

    async def _observe(self, caller: Peer, args: verbs.Observe) -> verbs.Observation:
        return await self._session.previews.observe(args.tag)

    async def _doctor(self, caller: Peer, args: verbs.Doctor) -> list[verbs.Check]:
        return await checklist(self._session.context, self._session.devices.troubles)

    async def _configuration(self, caller: Peer, args: verbs.Configuration) -> StationConfig:
        return self._session.context.cell.config

    async def _sessions(self, caller: Peer, args: verbs.Sessions) -> list[SessionSummary]:
        # In a thread: reading hundreds of files must not delay the arm's heartbeat.
        return await ASKED.run(list_sessions, self._session.context.root)
