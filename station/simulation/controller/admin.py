"""Port 29990: faults, hands and questions, as JSON lines {"cmd": name, …} → {"ok": true, …}.

`{"cmd": "help"}` lists every command. This port exists only on the simulation.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Awaitable, Callable
from typing import Any

from station.simulation.controller.admin_faults import FAULTS
from station.simulation.controller.admin_hands import HANDS
from station.simulation.controller.machine import Machine

PORT = 29990
LINE_LIMIT = 1_000_000
TRUTH_WAIT_S = 2.0

Command = Callable[..., Awaitable[dict[str, Any] | None] | dict[str, Any] | None]


class AdminServer:
    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._commands: dict[str, Command] = {
            **FAULTS,
            **HANDS,
            "help": self._help,
            "truth": truth,
            "state": state,
            "stats": stats,
            "log": log,
        }

    async def open(self) -> asyncio.Server:
        return await asyncio.start_server(self._serve, self._machine.host, PORT, limit=LINE_LIMIT)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while line := await reader.readline():
                answer = await self._answer(line)
                writer.write(json.dumps(answer).encode() + b"\n")
                await writer.drain()
        except (ValueError, ConnectionError):
            pass  # an endless line, or the client left
        finally:
            writer.close()

    async def _answer(self, line: bytes) -> dict[str, Any]:
        try:
            request = json.loads(line)
            name = request.pop("cmd")
            command = self._commands[name]
        except (ValueError, KeyError, AttributeError, TypeError):
            return {"ok": False, "error": 'expected {"cmd": name, …}; {"cmd": "help"} lists the names'}
        try:
            result = command(self._machine, **request)
            if result is not None and not isinstance(result, dict):
                result = await result
        except (TypeError, ValueError, LookupError) as error:
            return {"ok": False, "error": f"{name}: {error}"}
        return {"ok": True, **(result or {})}

    def _help(self, _: Machine) -> dict[str, Any]:
        """This list."""
        return {"commands": {n: " ".join((c.__doc__ or "").split()) for n, c in self._commands.items()}}


async def truth(machine: Machine, at_monotonic_ns: int | None = None) -> dict[str, Any]:
    """Where the arm truly was at a time of the host's monotonic clock (now, if none is given; waits up to
    2 s for a time to come): joints_rad [6], base_from_flange [4][4], miss [6] = [δt m, δφ rad] of it."""
    at_ns = time.monotonic_ns() if at_monotonic_ns is None else at_monotonic_ns
    history = machine.robot.history
    deadline_ns = time.monotonic_ns() + int(TRUTH_WAIT_S * 1e9)
    while at_ns > history.newest_ns and time.monotonic_ns() < deadline_ns:
        await asyncio.sleep(machine.robot.dt_s / 2)
    joints, miss = history.at(at_ns)
    T = machine.robot.true_flange(joints, miss)
    return {
        "at_monotonic_ns": at_ns,
        "joints_rad": joints,
        "base_from_flange": [T[0:4], T[4:8], T[8:12], [0.0, 0.0, 0.0, 1.0]],
        "miss": miss,
    }


def state(machine: Machine) -> dict[str, Any]:
    """What the controller is doing now."""
    robot = machine.robot
    return {
        "model": robot.settings.model,
        "version": ".".join(map(str, robot.settings.version)),
        "timestamp_s": robot.time_s,
        "timestamp_monotonic_ns": machine.clock.due_ns(machine.clock.count),
        "controller_zero_monotonic_ns": machine.clock.start_ns,
        "robot_mode": robot.robot_mode.name,
        "safety_mode": robot.safety_mode.name,
        "runtime_state": robot.runtime_state.name,
        "program": robot.program.name if robot.program is not None else None,
        "moving": robot.arm.moving,
        "joints_rad": robot.arm.actual,
        "joint_speeds_rad_s": robot.arm.actual_speed,
        "target_joints_rad": robot.arm.command,
        "tcp": robot.tcp,
        "payload_kg": robot.payload_kg,
        "slider": robot.slider,
        "remote": robot.remote,
        "watchdog_s": robot.watchdog_s,
        "claims": sorted(machine.rtde.claims),
        "connections": {s.name: len(s.connections) for s in machine.services},
    }


def stats(machine: Machine) -> dict[str, Any]:
    """Cycles, packets sent and skipped, lateness of cycles against their grid, CPU time of this process."""
    clock, rtde = machine.clock, machine.rtde
    return {
        "cycles": clock.count,
        "packets_sent": rtde.sent,
        "packets_skipped": rtde.skipped,
        "late_cycles": clock.late_cycles,
        "worst_lateness_ms": clock.worst_lateness_ns / 1e6,
        "cpu_s": time.process_time(),
    }


def log(machine: Machine, since_monotonic_ns: int = 0) -> dict[str, Any]:
    """entries: every dashboard and script command, upload and RTDE write since that time (the newest 20 000);
    counts: how often each came, of all time."""
    journal = machine.robot.journal
    return {"entries": journal.entries(since_monotonic_ns), "counts": journal.counts}
