"""Admin commands that break something."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from station.simulation.controller.arguments import number, numbers
from station.simulation.controller.arm import Vibration
from station.simulation.controller.kinematics import DhTable
from station.simulation.controller.machine import Machine
from station.simulation.controller.network import Cut
from station.simulation.controller.rtde_server import ADMIN


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


def drop(machine: Machine, how: Cut = "fin", ports: list[str] | None = None) -> dict[str, Any]:
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
    """As a cable pulled out: links carry nothing, connecting hangs."""
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
    nominal: DhTable = machine.robot.table
    machine.robot.true_table = nominal.plus(
        numbers("a_m", a_m, 6),
        numbers("d_m", d_m, 6),
        numbers("alpha_rad", alpha_rad, 6),
        numbers("theta_rad", theta_rad, 6),
    )


FAULTS: dict[str, Callable[..., Any]] = {
    "pstop": pstop,
    "estop": estop,
    "safeguard": safeguard,
    "power_off": power_off,
    "drop": drop,
    "stall": stall,
    "freeze": freeze,
    "mute": mute,
    "stall_dash": stall_dash,
    "black_hole": black_hole,
    "restart": restart,
    "late": late,
    "delay": delay,
    "lose": lose,
    "in_use": in_use,
    "vibrate": vibrate,
    "offset": offset,
    "dh": dh,
}
