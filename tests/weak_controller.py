"""A simulated controller with one weakness planted: python -m tests.weak_controller --weakness NAME …

Each weakness is what an acceptance test of the arm must find.
"""

from __future__ import annotations

import sys
from math import copysign
from typing import Any

from station.devices.rtde import SafetyMode
from station.simulation.controller import __main__, machine
from station.simulation.controller.arm import JointMotion, SimulatedArm
from station.simulation.controller.kinematics import Vector
from station.simulation.controller.robot import SimulatedRobot

WEAKNESSES = (
    "late-watchdog",
    "abrupt-braking",
    "slow-braking",
    "first-stop-ignored",
    "swings-back",
    "hidden-protective-stop",
    "drifts-at-rest",
    "too-fast",
)
LATE_S, SLOW_RAD_S2, BACK_RAD, DRIFT_RAD_S, FASTER = 0.6, 0.3, 0.01, 0.004, 1.4


class WeakArm(SimulatedArm):
    """The arm of a `WeakRobot`, whose weakness it shares."""

    weakness = ""
    ignored = braked = False

    def start(self, goal: Vector, speed: float, acceleration: float) -> JointMotion:
        self.ignored = False  # each move's first stop, as a stop that was not measured is repeated
        return super().start(goal, speed * (FASTER if self.weakness == "too-fast" else 1), acceleration)

    def brake(self, deceleration_rad_s2: float) -> None:
        if not self.moving:
            return
        self.braked = True
        if self.weakness == "first-stop-ignored" and not self.ignored:
            self.ignored = True
        elif self.weakness == "abrupt-braking":
            self.freeze()
        else:
            super().brake(SLOW_RAD_S2 if self.weakness == "slow-braking" else deceleration_rad_s2)


class WeakRobot(SimulatedRobot):
    weakness, last_speed = "", 0.0

    def __init__(self, *settings: Any) -> None:
        super().__init__(*settings)
        self.arm.__class__ = WeakArm
        self.arm.weakness = self.weakness

    def tick(self, monotonic_ns: int, late: bool = False) -> None:
        if self.weakness == "late-watchdog" and self.watchdog_s:
            self.watchdog_s = LATE_S
        super().tick(monotonic_ns, late)
        arm = self.arm
        if arm.braked and not arm.moving:
            self._rests()

    def _rests(self) -> None:
        """The arm came to rest by a stop."""
        arm = self.arm
        q = arm.command
        if self.weakness == "swings-back":
            arm.braked = False
            arm.start((q[0] - copysign(BACK_RAD, self.last_speed), *q[1:]), 0.1, 1.4)
        elif self.weakness == "drifts-at-rest":
            arm.command = (q[0] + DRIFT_RAD_S * self.dt_s, *q[1:])

    def stop_program(self, reason: str) -> None:
        arm = self.arm
        moving = arm.motion
        if arm.moving:
            self.last_speed = arm.command_speed[0]
        super().stop_program(reason)
        if self.weakness == "hidden-protective-stop" and moving is not None and self.safe:
            self.protective_stop(reason)

    def publish(self) -> None:
        super().publish()
        if self.weakness == "hidden-protective-stop":
            self.outputs.set("safety_mode", SafetyMode.NORMAL)  # only the bits tell


def weak(weakness: str) -> type[WeakRobot]:
    """A robot with this weakness; '' has none."""
    return type("Weak", (WeakRobot,), {"weakness": weakness})


def main(arguments: list[str]) -> int:
    at = arguments.index("--weakness")
    vars(machine)["SimulatedRobot"] = weak(arguments[at + 1])
    return __main__.main([*arguments[:at], *arguments[at + 2 :]])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
