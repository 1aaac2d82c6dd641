"""Port 29990: faults, hands and questions, as JSON lines {"cmd": name, …} → {"ok": true, …}.

`{"cmd": "help"}` lists every command. This port exists only on the simulation.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Awaitable, Callable, Sequence
from math import inf, isfinite

from station.simulation.controller.arm import Vibration
from station.simulation.controller.interpreted import InterpretedProgram
from station.simulation.controller.kinematics import ArmGeometry, Vector
from station.simulation.controller.machine import Machine
from station.simulation.controller.network import Cut
from station.simulation.controller.paths import JointPath, Path, UnreachableError
from station.simulation.controller.robot import WAITS
from station.simulation.controller.rtde_server import ADMIN

PORT = 29990
LINE_LIMIT = 1_000_000
TRUTH_WAIT_S = 2.0

Command = Callable[..., Awaitable[dict[str, object] | None] | dict[str, object] | None]
HAND_RAD_S2 = 2.0


def number(name: str, value: float, low: float = -inf, high: float = inf) -> float:
    """A finite number within low…high."""
    checked = float(value)
    if not (isfinite(checked) and low <= checked <= high):
        raise ValueError(f"{name} must be a number in {low:g}…{high:g}, not {value}")
    return checked


def numbers(name: str, values: Sequence[float] | None, count: int) -> Vector:
    """Exactly so many finite numbers; zeros for None."""
    if values is None:
        return (0.0,) * count
    if not isinstance(values, list | tuple) or len(values) != count:
        raise ValueError(f"{name}: expected {count} numbers, not {values}")
    return tuple(number(name, value) for value in values)


def pstop(machine: Machine) -> None:
    """Protective stop now."""
    machine.robot.protective_stop("admin")


def estop(machine: Machine, on: bool = True) -> None:
    """Emergency stop button pressed (on) or pulled out again; afterwards the arm has no power: `run`."""
    machine.robot.emergency_stop(on)


def safeguard(machine: Machine, on: bool = True) -> None:
    """Safeguard stop: the program pauses; released, it stays paused until `play`."""
    machine.robot.safeguard(on)


def power_off(machine: Machine) -> None:
    """The arm loses power."""
    machine.robot.power_off()


def drop(machine: Machine, how: Cut = "fin", ports: list[str] | None = None) -> dict[str, object]:
    """Cuts every connection of these ports (rtde, script, dashboard; all if none named) by fin or rst."""
    if how not in ("fin", "rst"):
        raise ValueError(f"how is fin or rst, not {how}")
    return {"cut": machine.cut(how, ports)}


def stall(machine: Machine, on: bool = True) -> None:
    """RTDE links stay open but no data comes; everything else works."""
    machine.rtde.stalled = on


def freeze(machine: Machine, on: bool = True) -> None:
    """RTDE sends the same packet for ever: the timestamp stands still on a live link."""
    machine.rtde.frozen = on


def mute(machine: Machine, on: bool = True, ports: list[str] | None = None) -> None:
    """Ports accept connections, but what arrives is lost and nothing is answered."""
    for service in machine.chosen(ports):
        service.silent = on


def stall_dash(machine: Machine, on: bool = True) -> None:
    """The dashboard accepts connections and never says a word."""
    machine.dashboard.silent = on


def black_hole(machine: Machine, on: bool = True, ports: list[str] | None = None) -> None:
    """A cable pulled out: links carry nothing, connecting hangs."""
    for service in machine.chosen(ports):
        service.black_hole(on)


def restart(machine: Machine, down_s: float = 1.0, running: bool = False) -> None:
    """The controller reboots: links reset, ports closed for down_s, time 0, no power unless running."""
    machine.reboot(number("down_s", down_s, 0.0, 60.0), running)


def late(machine: Machine, ms: float) -> None:
    """No cycle runs for this long; then all that were due run at once (a hiccup of the simulation)."""
    machine.clock.hold_until_ns = time.monotonic_ns() + int(number("ms", ms, 0.0, 60_000.0) * 1e6)


def delay(machine: Machine, ms: float) -> None:
    """Every data packet leaves this much later from now on (0 = none): a slow network."""
    machine.rtde.delay_s = number("ms", ms, 0.0, 10_000.0) / 1000


def lose(machine: Machine, packets: int) -> None:
    """The next cycles' data packets are never sent."""
    machine.lose_packets = int(number("packets", packets, 0))


def in_use(machine: Machine, inputs: list[str], on: bool = True) -> None:
    """Another RTDE client owns these input variables (e.g. "input_int_register_0")."""
    for name in inputs:
        if name not in machine.robot.inputs.types:
            raise ValueError(f"there is no input variable {name}")
        if not on:
            machine.rtde.claims.pop(name, None)
        elif not machine.rtde.claim(name, ADMIN):
            raise ValueError(f"{name} is owned by a client already")


def vibrate(
    machine: Machine,
    amplitude_rad: float,
    frequency_hz: float = 12.0,
    decay_s: float | None = None,
    joint: int = 1,
) -> None:
    """A joint shakes about its rest: for ever, or fading after each motion. amplitude_rad 0 ends it."""
    vibration = Vibration(
        number("amplitude_rad", amplitude_rad, 0.0, 0.1),
        number("frequency_hz", frequency_hz, 0.0),
        None if decay_s is None else number("decay_s", decay_s, 1e-3),
        int(number("joint", joint, 0, 5)),
    )
    machine.robot.arm.vibration = vibration if vibration.amplitude_rad > 0 else None


def offset(machine: Machine, joints_rad: list[float] | None = None) -> None:
    """From the next motion on the arm rests this much short of its command (none: as commanded)."""
    machine.robot.arm.offset = numbers("joints_rad", joints_rad, 6)


def dh(
    machine: Machine,
    a_m: list[float] | None = None,
    d_m: list[float] | None = None,
    alpha_rad: list[float] | None = None,
    theta_rad: list[float] | None = None,
) -> None:
    """The true arm differs from the nominal table by these; what the controller reports does not."""
    nominal: ArmGeometry = machine.robot.table
    machine.robot.true_table = nominal.plus(
        numbers("a_m", a_m, 6),
        numbers("d_m", d_m, 6),
        numbers("alpha_rad", alpha_rad, 6),
        numbers("theta_rad", theta_rad, 6),
    )


def unlock(machine: Machine) -> dict[str, object]:
    """A person clears the protective stop (refused within 5 s of it). Not in the dashboard's log."""
    return {"unlocked": machine.robot.unlock()}


def run(machine: Machine) -> None:
    """A person powers the arm on and releases the brakes."""
    machine.robot.run()


def stop_program(machine: Machine) -> None:
    """Stop pressed on the pendant."""
    machine.robot.stop_program("pendant")


def pause(machine: Machine) -> dict[str, object]:
    """Pause pressed on the pendant."""
    return {"paused": machine.robot.pause_program()}


def play(machine: Machine) -> dict[str, object]:
    """Play pressed on the pendant: a paused program goes on."""
    return {"playing": machine.robot.play_program()}


def program(machine: Machine) -> dict[str, object]:
    """The text of the program that plays."""
    return {"text": machine.robot.program.text if machine.robot.program else ""}


def contact(machine: Machine, cycles: int = 10) -> None:
    """The tool touches something: `tool_contact` answers that it has for so many cycles (0: nothing)."""
    machine.robot.contact_cycles = int(number("cycles", cycles, 0))


def wires(machine: Machine, digital: int = 0, analog: list[float] | None = None) -> None:
    """Inputs: digital bits (standard 0-7, configurable 8-15, tool 16-17), analog 0 and 1 (V or A)."""
    out = machine.robot.outputs
    out.set("actual_digital_input_bits", int(number("digital", digital, 0, 2**18 - 1)))
    for i, value in enumerate(numbers("analog", analog, 2)):
        out.set(f"standard_analog_input{i}", value)


def foreign(machine: Machine, name: str = "palletising.urp") -> None:
    """Somebody else's program starts."""
    machine.robot.start_program(InterpretedProgram(machine.robot, name, WAITS))


def slider(machine: Machine, fraction: float) -> None:
    """Speed slider on the pendant, 0…1."""
    machine.robot.slider = number("fraction", fraction, 0.0, 1.0)


def remote(machine: Machine, on: bool = True) -> None:
    """Remote (on) or local control (e-Series). Going local stops a remotely started program."""
    robot = machine.robot
    if robot.remote and not on and robot.settings.is_e_series:
        robot.stop_program("local control")
    robot.remote = on


def tcp(machine: Machine, pose: list[float]) -> None:
    """TCP of the installation: x y z [m], rotation vector [rad], in the flange."""
    machine.robot.tcp = numbers("pose", pose, 6)


def payload(machine: Machine, kg: float, cog_m: list[float] | None = None) -> None:
    """Payload of the installation."""
    machine.robot.payload_kg = number("kg", kg, 0.0)
    machine.robot.payload_cog = numbers("cog_m", cog_m, 3)


def jog(machine: Machine, joints_rad: list[float], speed_rad_s: float = 0.5) -> dict[str, object]:
    """Moves the arm with the pendant's arrows. Refused while a program plays or the arm has no power."""
    return hand_move(machine, [joints_rad], speed_rad_s)


def hand_move(machine: Machine, path: list[list[float]], speed_rad_s: float = 0.5) -> dict[str, object]:
    """A person leads the arm through these joints (free-drive), the fastest joint at speed_rad_s."""
    robot = machine.robot
    corners = [numbers("path", corner, 6) for corner in path]
    speed_rad_s = number("speed_rad_s", speed_rad_s, 1e-3, 100.0)

    def make_path(start: Vector) -> Path:
        return JointPath(start, *corners)

    length_rad = JointPath(robot.arm.command, *corners).length
    if not robot.lead(make_path, speed_rad_s, HAND_RAD_S2):
        raise ValueError("the arm is not free: a program plays, a safety stop holds it, or it has no power")
    return {"length_rad": length_rad}


async def truth(machine: Machine, at_monotonic_ns: int | None = None) -> dict[str, object]:
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


def state(machine: Machine) -> dict[str, object]:
    """The controller's state now."""
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


def stats(machine: Machine) -> dict[str, object]:
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


def log(machine: Machine, since_monotonic_ns: int = 0) -> dict[str, object]:
    """entries: every dashboard and script command, upload and RTDE write since that time (the newest 20 000);
    counts: how often each came, of all time."""
    journal = machine.robot.journal
    return {"entries": journal.entries(since_monotonic_ns), "counts": journal.counts}


def list_commands(_: Machine) -> dict[str, object]:
    """This list."""
    return {"commands": {name: " ".join((c.__doc__ or "").split()) for name, c in COMMANDS.items()}}


_NAMED: tuple[Command, ...] = (
    pstop, estop, safeguard, power_off, drop, stall, freeze, mute, stall_dash, black_hole, restart, late,
    delay, lose, in_use, vibrate, offset, dh,
    unlock, run, stop_program, pause, play, program, foreign, contact, wires,
    slider, remote, tcp, payload, jog, hand_move,
    truth, state, stats, log,
)  # fmt: skip
COMMANDS: dict[str, Command] = {command.__name__: command for command in _NAMED} | {"help": list_commands}


class AdminServer:
    def __init__(self, machine: Machine) -> None:
        self._machine = machine

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

    async def _answer(self, line: bytes) -> dict[str, object]:
        try:
            request = json.loads(line)
            name = request.pop("cmd")
            command = COMMANDS[name]
        except (ValueError, KeyError, AttributeError, TypeError):
            return {"ok": False, "error": 'expected {"cmd": name, …}; {"cmd": "help"} lists the names'}
        try:
            result = command(self._machine, **request)
            if result is not None and not isinstance(result, dict):
                result = await result
        except (TypeError, ValueError, LookupError, UnreachableError) as error:
            return {"ok": False, "error": f"{name}: {error}"}
        return {"ok": True, **(result or {})}
