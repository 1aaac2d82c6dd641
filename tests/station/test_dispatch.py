"""Verbs over the socket: typed arguments, who may, and the rule for arms that are real."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from station import dispatch
from station.client import Client
from station.control import ControlServer, Peer
from station.dispatch import SessionDispatcher
from station.errors import RefusedError
from station.plan.model import Plan, plan_sha256
from station.status import StationState
from tests.station.session_rig import POSES, NewRig, Rig


class Served:
    def __init__(self, rig: Rig, path: Path) -> None:
        self.rig, self.path = rig, path
        self.control = ControlServer(path, SessionDispatcher(rig.session))

    async def client(self, interactive: bool = True) -> Client:
        return await Client.connect(self.path, "tty1", interactive=interactive)


@pytest.fixture
async def served(new_rig: NewRig, tmp_path: Path) -> AsyncIterator[Served]:
    rig = await new_rig(with_plan=False)
    await rig.until(StationState.IDLE)
    made = Served(rig, tmp_path / "s")
    await made.control.start()
    yield made
    await made.control.close()


async def test_a_capture_over_the_socket(served: Served, small_plan: Plan) -> None:
    async with await served.client() as anna:
        lease = await anna.request("lease", action="take")
        assert "tty1" in lease["holder"] and "pid" in lease["holder"]
        answer = await anna.request("load_plan", plan=msgspec.to_builtins(small_plan))
        assert answer["sha256"] == plan_sha256(small_plan)
        summary = await anna.request("prepare", purpose="run")
        assert summary["poses"] == POSES
        assert any("SIMULATED" in warning for warning in summary["warnings"])
        await anna.request("go", token=summary["token"])
        await served.rig.until_true(lambda: bool(served.rig.session.store.status.session.recording))
        sessions = await anna.request("sessions")
        assert sessions[0]["sealed"] and sessions[0]["views"] == POSES
        checks = {check["name"]: check for check in await anna.request("doctor")}
        assert checks["robot"]["state"] == checks["disk"]["state"] == "ok"
        preview = await anna.request("preview", width=160, height=128)
        assert (preview["width"], preview["height"]) == (160, 128)
        assert all(0 <= x <= 1 and 0 <= y <= 1 for x, y in preview["corners"])


async def test_poses_of_a_check_are_planned_for_a_known_lens(
    served: Served, small_plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []

    async def call(function: object, *args: object, timeout_s: float) -> Plan:
        asked.append(args[-1])
        return small_plan

    monkeypatch.setattr(served.rig.session.bench.workers, "call", call)
    async with await served.client() as anna:
        await anna.request("lease", action="take")
        await anna.request("make_plan", poses=6, lens_known=True)
        await anna.request("make_plan", poses=25)
    assert asked == [True, False]


async def test_the_second_operator_may_watch_pause_and_stop_only(served: Served, small_plan: Plan) -> None:
    async with await served.client() as anna, await served.client() as bert:
        await anna.request("lease", action="take")
        for verb, args in (
            ("lease", {"action": "take"}),
            ("load_plan", {"plan": msgspec.to_builtins(small_plan)}),
            ("prepare", {}),
            ("finish", {}),
            ("skip", {"index": 0}),
            ("free_drive", {"on": True}),
        ):
            with pytest.raises(RefusedError, match=r"held by .*tty1"):
                await bert.request(verb, **args)
        await bert.request("stop")
        assert served.rig.state is StationState.STOPPED
        await anna.request("lease", action="release")
        await bert.request("lease", action="take")


async def test_a_screen_at_which_nobody_is_may_say_that_it_is_lost(served: Served, small_plan: Plan) -> None:
    async with await served.client() as anna:
        await anna.request("lease", action="take")
        await anna.request("load_plan", plan=msgspec.to_builtins(small_plan))
        served.rig.arm.slow = True
        offer = await anna.request("prepare")
        await anna.request("go", token=offer["token"], plan_sha256=offer["plan_sha256"])
        await served.rig.until(StationState.MOVING)
        await anna.request("lease", action="lost")
        assert served.rig.state is StationState.PAUSED
        assert "tty1" in served.rig.session.store.status.reason
        assert "was lost" in served.rig.session.store.status.reason
        assert served.rig.session.store.status.lease.holder == ""


@pytest.mark.parametrize(
    ("verb", "args"),
    [
        ("skip", {"index": "one"}),
        ("skip", {"index": 0, "now": True}),
        ("go", {}),
        ("make_plan", {"poses": 1_000_000}),
        ("reorder", {"order": [0, 0]}),
        ("load_plan", {"plan": {"robot": "UR10"}}),
        ("lease", {"action": "steal"}),
        ("prepare", {"purpose": "dance"}),
    ],
)
async def test_arguments_that_do_not_fit_are_refused_in_words(
    served: Served, verb: str, args: dict[str, object]
) -> None:
    async with await served.client() as anna:
        await anna.request("lease", action="take")
        with pytest.raises(RefusedError) as caught:
            await anna.request(verb, **args)  # type: ignore[arg-type]
        assert len(str(caught.value).split()) > 3


async def test_without_a_person_a_real_arm_needs_the_plans_hash(
    new_rig: NewRig, small_plan: Plan, tmp_path: Path
) -> None:
    real = await new_rig(with_plan=False, source="real")
    await real.until(StationState.IDLE)
    served = Served(real, tmp_path / "r")
    await served.control.start()
    async with await served.client(interactive=False) as program:
        await program.request("lease", action="take")
        await program.request("load_plan", plan=msgspec.to_builtins(small_plan))
        for wrong in ({}, {"plan_sha256": "ab" * 32}):
            summary = await program.request("prepare")
            with pytest.raises(RefusedError, match="approved plan"):
                await program.request("go", token=summary["token"], **wrong)
        assert "move" not in real.arm.log
        summary = await program.request("prepare")
        await program.request("go", token=summary["token"], plan_sha256=plan_sha256(small_plan))
        await real.until_true(lambda: "move" in real.arm.log)
    await served.control.close()


async def test_without_a_person_a_real_arm_s_plan_is_not_changed_on_the_way(
    new_rig: NewRig, tmp_path: Path
) -> None:
    real = await new_rig(with_plan=False, source="real")
    await real.until(StationState.IDLE)
    served = Served(real, tmp_path / "r")
    await served.control.start()
    for interactive, told in ((False, "only with a person at the screen"), (True, "no session is open")):
        async with await served.client(interactive=interactive) as client:
            await client.request("lease", action="take")
            with pytest.raises(RefusedError, match=told):
                await client.request("prepare", purpose="improve")
    await served.control.close()


async def test_neither_a_long_list_of_sessions_nor_a_slow_name_holds_the_loop_up(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slow(_: object) -> Any:
        time.sleep(0.4)
        return []

    monkeypatch.setattr(dispatch, "list_sessions", slow)
    monkeypatch.setattr(dispatch, "user_name", lambda uid: str(slow(uid)))
    async with await served.client() as anna:
        assert await anna.request("sessions") == []
        await anna.request("stop")
        await asyncio.sleep(0.1)  # a frozen loop shows in the round after
    assert served.rig.session.guard.lag_ms() < 300


async def test_who_is_turned_away_is_not_kept(served: Served) -> None:
    dispatcher = SessionDispatcher(served.rig.session)
    await dispatcher.stop_now(Peer(client_id=99, pid=1, uid=0, gid=0))
    assert not dispatcher._callers and "uid 0 (pid 1)" in served.rig.session.store.status.reason


async def test_leaving_voids_the_go(served: Served, small_plan: Plan) -> None:
    async with await served.client() as anna:
        await anna.request("lease", action="take")
        await anna.request("load_plan", plan=msgspec.to_builtins(small_plan))
        summary = await anna.request("prepare")
    async with await served.client() as bert:
        await served.rig.until_true(lambda: not served.rig.session.store.status.lease.holder)
        await bert.request("lease", action="take")
        with pytest.raises(RefusedError, match="not valid"):
            await bert.request("go", token=summary["token"])
