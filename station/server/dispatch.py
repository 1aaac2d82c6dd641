"""Verbs to commands: typed arguments, who may, and what comes back. An allow list, never a name lookup."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, cast

import msgspec

from station.cell.errors import RefusedError
from station.cell.plan import Plan, PlannedPose
from station.cell.session_folder import list_sessions
from station.cell.socket_folder import user_name
from station.protocol.messages import Verb
from station.server.approval import Applicant, ApprovalRule, Process, process
from station.server.control import Peer
from station.server.stop_server import Sender
from station.session.checklist import checklist
from station.session.hovering import HoverRequest
from station.session.recording import software
from station.session.session import Session


class _Args(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class _Hello(_Args, frozen=True):
    who: str = ""


class _Lease(_Args, frozen=True):
    action: str = "take"


class _LoadPlan(_Args, frozen=True):
    plan: Plan


class _MakePlan(_Args, frozen=True):
    poses: int = 25
    seed: int = 0
    lens_known: bool = False


class _Prepare(_Args, frozen=True):
    purpose: str = "run"
    index: int | None = None


class _Go(_Args, frozen=True):
    token: str
    plan_sha256: str = ""
    headless: bool = False
    """Nobody will be asked: poses that do not come to rest are tried once more."""


class _Index(_Args, frozen=True):
    index: int


class _Order(_Args, frozen=True):
    order: list[int]


class _Pose(_Args, frozen=True):
    pose: PlannedPose


class _FreeDrive(_Args, frozen=True):
    on: bool
    auto: bool = False


class _Preview(_Args, frozen=True):
    width: int = 480
    height: int = 384


PLAN_POSES = (4, 200)
_WHO_LIMIT = 60


class _Caller:
    """A connection and what it said about itself."""

    def __init__(self, peer: Peer) -> None:
        self.client_id, self.pid, self.uid = peer.client_id, peer.pid, peer.uid
        self.who = f"uid {peer.uid} (pid {peer.pid})"
        self.began_ticks: int | None = None
        """Of its process, when it first asked for anything."""

    def asks(self, user: str) -> Applicant:
        return Applicant(self.pid, self.uid, user, self.began_ticks)

    def introduce(self, user: str, who: str) -> None:
        """The user's name is the kernel's word; the place is the client's."""
        said = "".join(c for c in who if c.isprintable())[:_WHO_LIMIT] or user
        told = said if said.split(" ")[0] == user else f"{user} ({said})"
        self.who = f"{told} (pid {self.pid})"


class SessionDispatcher:
    """Behind `station.server.control.Handler`."""

    def __init__(self, session: Session, see: Callable[[int], Process | None] = process) -> None:
        self._session, self._see = session, see
        cell = session.bench.cell
        self._rule = ApprovalRule(cell.config.approval, cell.simulated, see)
        self._callers: dict[int, _Caller] = {}
        self._leaving: set[asyncio.Task[None]] = set()
        self._names: dict[int, str] = {}
        """Users by their number, once they were looked up."""
        self._table: dict[Verb, tuple[type[msgspec.Struct], Callable[[_Caller, Any], Awaitable[Any]]]] = {
            "hello": (_Hello, self._hello),
            "lease": (_Lease, self._lease),
            "acknowledge": (_Args, self._acknowledge),
            "plan": (_Args, self._plan),
            "load_plan": (_LoadPlan, self._load_plan),
            "make_plan": (_MakePlan, self._make_plan),
            "prepare": (_Prepare, self._prepare),
            "hover": (HoverRequest, self._hover),
            "go": (_Go, self._go),
            "pause": (_Args, self._pause),
            "finish": (_Args, self._finish),
            "retake": (_Index, self._retake),
            "skip": (_Index, self._skip),
            "reorder": (_Order, self._reorder),
            "add": (_Pose, self._add),
            "drop": (_Index, self._drop),
            "free_drive": (_FreeDrive, self._free_drive),
            "record": (_Args, self._record),
            "preview": (_Preview, self._preview),
            "doctor": (_Args, self._doctor),
            "sessions": (_Args, self._sessions),
        }

    def stop_now(self, peer: Peer) -> Awaitable[None]:
        """STOP is on its way to the arm before anything else is looked at."""
        caller = self._callers.get(peer.client_id) or _Caller(peer)  # the house may be full: nobody is kept
        return self._to_the_end(self._session.stop(caller.who))

    def stop_from(self, sender: Sender) -> None:
        """STOP without a connection; who has one as well is known by what was said there."""
        known = (c for c in self._callers.values() if (c.pid, c.uid) == (sender.pid, sender.uid))
        caller = next(known, None)
        user = self._names.get(sender.uid, f"uid {sender.uid}")
        who = caller.who if caller else f"{user} (pid {sender.pid})"
        self._to_the_end(self._session.stop(who))
        if sender.uid not in self._names:
            self._to_the_end(self._name(sender.uid))

    async def _name(self, uid: int) -> str:
        if uid not in self._names:
            # In a thread: where users come from the network, a name may take seconds.
            self._names[uid] = await asyncio.to_thread(user_name, uid)
        return self._names[uid]

    def gone(self, peer: Peer) -> None:
        """The arm decelerates at once when this was the commander."""
        self._callers.pop(peer.client_id, None)
        self._to_the_end(self._session.lease_lost(peer.client_id))

    def _to_the_end(self, work: Coroutine[Any, Any, Any]) -> asyncio.Future[None]:
        """A client that leaves takes its requests with it, but not these."""
        task = asyncio.create_task(work)
        self._leaving.add(task)
        task.add_done_callback(self._leaving.discard)
        return asyncio.shield(task)

    async def handle(self, peer: Peer, verb: str, args: dict[str, Any]) -> Any:
        """RefusedError for arguments that do not fit the verb."""
        if verb == "watch":
            return {}
        kind, handler = self._table[cast(Verb, verb)]
        try:
            typed = msgspec.convert(args, kind)
        except msgspec.ValidationError as error:
            raise RefusedError(f"{verb}: wrong arguments ({error})") from None
        result = await handler(self._caller(peer), typed)
        return {} if result is None else msgspec.to_builtins(result)

    def _caller(self, peer: Peer) -> _Caller:
        if peer.client_id not in self._callers:
            caller = self._callers[peer.client_id] = _Caller(peer)
            seen = self._see(peer.pid)
            caller.began_ticks = seen.began_ticks if seen else None
        return self._callers[peer.client_id]

    async def _hello(self, caller: _Caller, args: _Hello) -> Any:
        caller.introduce(await self._name(caller.uid), args.who)
        root = str(self._session.bench.root)
        return {"version": software()["calibration-station"], "pid": os.getpid(), "root": root}

    async def _lease(self, caller: _Caller, args: _Lease) -> Any:
        if args.action == "take":
            return self._session.take_lease(caller.client_id, caller.who)
        if args.action == "release":
            return await self._to_the_end(self._session.release_lease(caller.client_id))
        if args.action == "lost":
            return await self._to_the_end(self._session.lease_lost(caller.client_id))
        raise RefusedError(f"lease: take, release or lost, not '{args.action}'")

    async def _acknowledge(self, caller: _Caller, args: _Args) -> None:
        self._session.acknowledge(caller.who)

    async def _plan(self, caller: _Caller, args: _Args) -> Any:
        queue = self._session.bench.queue
        return None if queue is None else {"plan": queue.plan, "sha256": queue.sha256}

    async def _load_plan(self, caller: _Caller, args: _LoadPlan) -> Any:
        self._session.load_plan(caller.client_id, args.plan)
        return {"sha256": self._session.bench.require_queue().sha256}

    async def _make_plan(self, caller: _Caller, args: _MakePlan) -> Any:
        low, high = PLAN_POSES
        if not low <= args.poses <= high:
            raise RefusedError(f"a plan has {low} to {high} poses, not {args.poses}")
        plan = await self._session.make_plan(caller.client_id, args.poses, args.seed, args.lens_known)
        return {"poses": len(plan.poses), "sha256": self._session.bench.require_queue().sha256}

    async def _prepare(self, caller: _Caller, args: _Prepare) -> Any:
        if args.purpose in ("improve", "best"):
            self._rule.by_person(await self._asks(caller), "a plan that is changed on the way")
        return await self._session.prepare(caller.client_id, args.purpose, args.index)

    async def _hover(self, caller: _Caller, args: HoverRequest) -> Any:
        self._rule.by_person(await self._asks(caller), "a move over the board")
        return await self._session.prepare_hover(caller.client_id, args)

    async def _go(self, caller: _Caller, args: _Go) -> None:
        asks, waiting = await self._asks(caller), self._session.waiting_go
        if waiting is not None and waiting.hover is not None:
            how = self._rule.by_person(asks, "a move over the board")
        else:
            how = self._rule.approve(asks, args.plan_sha256, waiting.summary.plan_sha256 if waiting else "")
        approval = f"motion approved by {caller.who}, {how}"
        self._session.go(caller.client_id, args.token, approval, again=args.headless)

    async def _asks(self, caller: _Caller) -> Applicant:
        return caller.asks(await self._name(caller.uid))

    async def _pause(self, caller: _Caller, args: _Args) -> None:
        self._session.pause(caller.who)

    async def _finish(self, caller: _Caller, args: _Args) -> None:
        await self._to_the_end(self._session.finish(caller.client_id))

    async def _retake(self, caller: _Caller, args: _Index) -> None:
        await self._session.edit(caller.client_id, "retake", lambda queue: queue.retake(args.index))

    async def _skip(self, caller: _Caller, args: _Index) -> None:
        await self._session.edit(caller.client_id, "skip", lambda queue: queue.skip(args.index))

    async def _reorder(self, caller: _Caller, args: _Order) -> None:
        await self._session.edit(caller.client_id, "reorder", lambda queue: queue.reorder(args.order))

    async def _add(self, caller: _Caller, args: _Pose) -> Any:
        return {
            "index": await self._session.edit(caller.client_id, "add", lambda queue: queue.add(args.pose))
        }

    async def _drop(self, caller: _Caller, args: _Index) -> None:
        await self._session.edit(caller.client_id, "drop", lambda queue: queue.drop(args.index))

    async def _free_drive(self, caller: _Caller, args: _FreeDrive) -> None:
        await self._to_the_end(self._session.switch_free_drive(caller.client_id, args.on, args.auto))

    async def _record(self, caller: _Caller, args: _Args) -> Any:
        return {"index": await self._session.record(caller.client_id)}

    async def _preview(self, caller: _Caller, args: _Preview) -> Any:
        return await self._session.previews.preview(args.width, args.height)

    async def _doctor(self, caller: _Caller, args: _Args) -> Any:
        return await checklist(self._session.bench, self._session.troubles)

    async def _sessions(self, caller: _Caller, args: _Args) -> Any:
        # In a thread: hundreds of files are read, and the arm's heartbeat does not wait.
        return await asyncio.to_thread(list_sessions, self._session.bench.root)
