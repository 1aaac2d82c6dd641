"""Port 29990: faults, hands and questions, as JSON lines {"cmd": name, …} → {"ok": true, …}.

This port exists only on the simulation.
"""

from __future__ import annotations

import asyncio
import inspect
import json
import time
from collections.abc import Awaitable, Callable
from functools import cache
from typing import Annotated, Any, get_type_hints

import msgspec
from msgspec import Meta

from station.simulation.controller.arm import UnreachableError
from station.simulation.controller.interpreted import InterpretedProgram
from station.simulation.controller.machine import Machine
from station.simulation.controller.network import Cut
from station.simulation.controller.robot import WAITS
from station.simulation.controller.rtde_server import ADMIN
from station.simulation.controller.state import Six

PORT = 29990
TRUTH_WAIT_S = 2.0
HAND_RAD_S2 = 2.0

Json = dict[str, Any]
Command = Callable[..., Awaitable[Json | None] | Json | None]
Share = Annotated[float, Meta(ge=0, le=1)]
NotNegative = Annotated[float, Meta(ge=0)]
JointSpeed = Annotated[float, Meta(ge=1e-3, le=100)]
Three = tuple[float, float, float]


COMMANDS: dict[str, Command] = {}
"""Name → function. Its parameters behind the machine are the keys that a client sends."""


def command(function: Command) -> Command:
    """Register a function as the command of its name."""
    COMMANDS[function.__name__] = function
    return function


@command
def drop(machine: Machine, how: Cut = "fin", ports: list[str] | None = None) -> None:
    """Cuts every connection of these ports (rtde, script, dashboard; all if none named) by fin or rst."""
    for service in machine.chosen(ports):
        service.cut(how)


@command
def mute(machine: Machine, on: bool = True, ports: list[str] | None = None) -> None:
    """Ports accept connections, but what arrives is lost and nothing is answered."""
    for service in machine.chosen(ports):
        service.silent = on


@command
def black_hole(machine: Machine, on: bool = True, ports: list[str] | None = None) -> None:
    """A cable pulled out: links carry nothing, connecting hangs."""
    for service in machine.chosen(ports):
        service.black_hole(on)


@command
def spoil(machine: Machine, outputs: list[str]) -> None:
    """These outputs, such as "actual_q", are sent as NaN from now on; an empty list: none."""
    if whole := [name for name in outputs if machine.robot.outputs.types[name] not in ("DOUBLE", "VECTOR6D")]:
        raise ValueError(f"{', '.join(whole)} cannot be NaN")
    machine.rtde.spoiled = tuple(outputs)


@command
def restart(
    machine: Machine, down_s: Annotated[float, Meta(ge=0, le=60)] = 1.0, running: bool = False
) -> None:
    """The controller reboots: links reset, ports closed for down_s, time 0, no power unless running."""
    machine.reboot(down_s, running)


@command
def in_use(machine: Machine, inputs: list[str]) -> None:
    """Another RTDE client owns these input variables (e.g. "input_int_register_0")."""
    for name in inputs:
        machine.rtde.claim(name, ADMIN)


@command
def foreign(machine: Machine, name: str = "palletising.urp") -> None:
    """Somebody else's program starts."""
    machine.robot.start_program(InterpretedProgram(machine.robot, name, WAITS))


@command
def slider(machine: Machine, fraction: Share) -> None:
    """Speed slider on the pendant, 0…1."""
    machine.robot.slider = fraction


@command
def remote(machine: Machine, on: bool = True) -> None:
    """Remote (on) or local control (e-Series). Going local stops a remotely started program."""
    robot = machine.robot
    if robot.remote and not on and robot.settings.is_e_series:
        robot.stop_program("local control")
    robot.remote = on


@command
def tcp(machine: Machine, pose: Six) -> None:
    """TCP of the installation: x y z [m], rotation vector [rad], in the flange."""
    machine.robot.tcp = pose


@command
def payload(machine: Machine, kg: NotNegative, cog_m: Three = (0.0, 0.0, 0.0)) -> None:
    """Payload of the installation."""
    machine.robot.payload_kg = kg
    machine.robot.payload_cog = cog_m


@command
def hand_move(machine: Machine, joints: Six, speed_rad_s: JointSpeed = 0.5) -> None:
    """A person leads the arm to these joints (free-drive, or the pendant's arrows), the fastest joint at
    speed_rad_s."""
    if not machine.robot.lead(joints, speed_rad_s, HAND_RAD_S2):
        raise ValueError("the arm is not free: a program plays, a safety stop holds it, or it has no power")


@command
async def truth(machine: Machine, at_monotonic_ns: int | None = None) -> Json:
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


@command
def state(machine: Machine) -> Json:
    """The controller's state now."""
    robot = machine.robot
    return {
        "model": robot.settings.model,
        "timestamp_s": robot.time_s,
        "controller_zero_monotonic_ns": machine.clock.start_ns,
        "runtime_state": robot.runtime_state.name,
        "program": robot.program.name if robot.program is not None else None,
        "moving": robot.arm.moving,
        "joints_rad": robot.arm.actual,
        "joint_speeds_rad_s": robot.arm.actual_speed,
        "claims": sorted(machine.rtde.claims),
    }


@command
def log(machine: Machine, since_monotonic_ns: int = 0) -> Json:
    """entries: every dashboard and script command, upload and RTDE write since that time (the newest 20 000);
    counts: how often each came, of all time."""
    journal = machine.robot.journal
    return {"entries": journal.entries(since_monotonic_ns), "counts": journal.counts}


# A person at the pendant, and the safety system.


@command
def pstop(machine: Machine) -> None:
    """The arm's own protective stop."""
    machine.robot.protective_stop("admin")


@command
def estop(machine: Machine) -> None:
    """The emergency stop on the pendant."""
    machine.robot.emergency_stop()


@command
def safeguard(machine: Machine) -> None:
    """A safeguard stop: somebody opened the fence."""
    machine.robot.safeguard()


@command
def power_off(machine: Machine) -> None:
    """The arm loses its power."""
    machine.robot.power_off()


@command
def stop_program(machine: Machine) -> None:
    """The stop button of the pendant."""
    machine.robot.stop_program("pendant")


@command
def pause(machine: Machine) -> Json:
    """The pause button of the pendant."""
    return {"paused": machine.robot.pause_program()}


@command
def play(machine: Machine) -> Json:
    """The play button of the pendant."""
    return {"playing": machine.robot.play_program()}


@command
def stall(machine: Machine, on: bool = True) -> None:
    """RTDE links stay open but no data comes; everything else works."""
    machine.rtde.stalled = on


@command
def freeze(machine: Machine, on: bool = True) -> None:
    """RTDE sends the same packet for ever: the timestamp stands still on a live link."""
    machine.rtde.frozen = on


@cache
def _arguments(name: str) -> type[msgspec.Struct]:
    """Return a struct of what a command takes."""
    function = COMMANDS[name]
    hints = get_type_hints(function, include_extras=True)
    _, *parameters = inspect.signature(function).parameters.values()
    types = {p.name: hints.get(p.name, type(p.default)) for p in parameters}
    fields = [(p.name, types[p.name], *(() if p.default is p.empty else (p.default,))) for p in parameters]
    return msgspec.defstruct(name, fields, forbid_unknown_fields=True)


class AdminServer:
    def __init__(self, machine: Machine) -> None:
        self._machine = machine

    async def open(self) -> asyncio.Server:
        return await asyncio.start_server(self._serve, self._machine.host, PORT)

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

    async def _answer(self, line: bytes) -> Json:
        try:
            request = msgspec.json.decode(line, type=Json)
            name = request.pop("cmd")
            command = COMMANDS[name]
        except (msgspec.MsgspecError, KeyError, TypeError):
            return {"ok": False, "error": f'expected {{"cmd": name, …}} with one of {", ".join(COMMANDS)}'}
        try:
            given = msgspec.structs.astuple(msgspec.convert(request, _arguments(name)))
            result = command(self._machine, *given)
            if result is not None and not isinstance(result, dict):
                result = await result
        except (msgspec.MsgspecError, ValueError, LookupError, UnreachableError) as error:
            return {"ok": False, "error": f"{name}: {error}"}
        return {"ok": True, **(result or {})}
