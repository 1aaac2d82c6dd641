"""Admin commands of a person at the pendant, or with hands on the arm."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from station.simulation.controller.arguments import number, numbers
from station.simulation.controller.kinematics import Six
from station.simulation.controller.machine import Machine
from station.simulation.controller.paths import Path, PolylinePath
from station.simulation.controller.programs import ForeignProgram

HAND_RAD_S2 = 2.0


def unlock(machine: Machine) -> dict[str, Any]:
    """A person clears the protective stop (refused within 5 s of it). Not in the dashboard's log."""
    return {"unlocked": machine.robot.unlock()}


def run(machine: Machine) -> None:
    """A person powers the arm on and releases the brakes."""
    machine.robot.power_on()
    machine.robot.release_brakes()


def stop_program(machine: Machine) -> None:
    """Stop pressed on the pendant."""
    machine.robot.stop_program("pendant")


def pause(machine: Machine) -> dict[str, Any]:
    """Pause pressed on the pendant."""
    return {"paused": machine.robot.pause_program()}


def play(machine: Machine) -> dict[str, Any]:
    """Play pressed on the pendant: a paused program goes on."""
    return {"playing": machine.robot.play_program()}


def foreign(machine: Machine, name: str = "palletising.urp") -> None:
    """Somebody else's program starts."""
    machine.robot.start_program(ForeignProgram(name))


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


def jog(machine: Machine, joints_rad: list[float], speed_rad_s: float = 0.5) -> dict[str, Any]:
    """Moves the arm with the pendant's arrows. Refused while a program plays or the arm has no power."""
    return hand_move(machine, [joints_rad], speed_rad_s)


def hand_move(machine: Machine, path: list[list[float]], speed_rad_s: float = 0.5) -> dict[str, Any]:
    """A person leads the arm through these joints (free-drive), the fastest joint at speed_rad_s."""
    robot = machine.robot
    corners = [numbers("path", corner, 6) for corner in path]
    speed_rad_s = number("speed_rad_s", speed_rad_s, 1e-3, 100.0)

    def make_path(start: Six) -> Path:
        return PolylinePath([start, *corners])

    length_rad = PolylinePath([robot.arm.command, *corners]).length
    if not robot.lead(make_path, speed_rad_s, HAND_RAD_S2):
        raise ValueError("the arm is not free: a program plays, a safety stop holds it, or it has no power")
    return {"length_rad": length_rad}


HANDS: dict[str, Callable[..., Any]] = {
    "unlock": unlock,
    "run": run,
    "stop_program": stop_program,
    "pause": pause,
    "play": play,
    "foreign": foreign,
    "slider": slider,
    "remote": remote,
    "tcp": tcp,
    "payload": payload,
    "jog": jog,
    "hand_move": hand_move,
}
