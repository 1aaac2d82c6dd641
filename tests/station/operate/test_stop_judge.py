"""The judge of the acceptance test: planted weaknesses are found, a sound controller is not accused."""

from __future__ import annotations

import msgspec
import pytest

from recordings.schema.messages import RobotState, Stamps
from station.cell.arm_acceptance import ArmSubject, Figure, StopTestMove, StopWay
from station.operate.stop_judge import judge
from station.simulation.controller.state import Journal, Settings
from station.simulation.controller.uploads import Upload
from tests.recordings.small_recording import PLAYING
from tests.weak_controller import WEAKNESSES, WeakRobot, weak

START = (0.3, -1.6, 1.9, -1.9, -1.57, 0.0)
TURN_RAD = 0.3
SUBJECT = ArmSubject("simulated", "UR10e", "1", "5.11", (), "ur_rtde")
SLOW_RAD_S, FAST_RAD_S = 0.06, 0.3
"""What 0.05 and 0.25 m/s are for a base joint with the arm stretched out."""
MOVE = "def move():\n  movej([{}], a=1.4, v={})\nend\n"


class Stand:
    """A controller without sockets, a clock that is only counted, and one move on it."""

    def __init__(self, weakness: str = "", model: str = "UR10e") -> None:
        self.robot: WeakRobot = weak(weakness)(Settings(model=model, start_joints_rad=START), Journal())
        self.states: list[RobotState] = []
        self._forth = True

    @property
    def now_ns(self) -> int:
        return 10**12 + round(self.robot.time_s * 1e9)

    def run(self, seconds: float, kicked: bool = True) -> None:
        for _ in range(round(seconds / self.robot.dt_s)):
            if kicked:
                self.robot._silence_s = 0.0
            self.robot.tick(self.now_ns)
            self.states.append(self._state())

    def _state(self) -> RobotState:
        out = self.robot.outputs
        same = ("robot_mode", "safety_mode", "safety_status_bits", "runtime_state")
        return msgspec.structs.replace(
            PLAYING,
            stamps=Stamps(self.now_ns + 400_000, 0, self.robot.time_s),
            joints_rad=out.vector("actual_q"),
            joint_speeds_rad_s=out.vector("actual_qd"),
            target_joints_rad=out.vector("target_q"),
            **{name: int(out.get(name)) for name in same},
        )

    def test(self, way: StopWay, speed_rad_s: float = FAST_RAD_S) -> tuple[Figure, ...]:
        """One move that ends in this way, and what the judge says of it."""
        robot = self.robot
        target = START[0] + TURN_RAD if self._forth else START[0]
        self._forth = not self._forth
        self.states = []
        joints = ", ".join(map(str, (target, *START[1:])))
        robot.upload(Upload("move", MOVE.format(joints, speed_rad_s)))
        self.run(0.1)
        robot.watchdog_s = 0.2
        goes = abs(target - robot.arm.command[0])
        self.run(0.5 * goes / speed_rad_s + 0.1)
        self.stopped_ns = self.now_ns
        if way is StopWay.CONTROL:
            robot.arm.brake(4.0)
            robot.stop_program("stop")
        elif way in (StopWay.DASHBOARD, StopWay.KILLED):
            robot.stop_program("stop")
        elif way is StopWay.FROZEN:
            self.run(1.0, kicked=False)
        self.run(2.0)
        self.move = StopTestMove(way, SUBJECT, 0, target, speed_rad_s)
        figures, not_measured = judge(self.states, self.move, self.stopped_ns)
        assert not not_measured
        return figures


def failed(figures: tuple[Figure, ...]) -> set[str]:
    return {figure.name for figure in figures if not figure.passed}


@pytest.mark.parametrize("speed_rad_s", [SLOW_RAD_S, FAST_RAD_S])
@pytest.mark.parametrize("model", ["UR10", "UR10e"])
def test_a_sound_controller_passes_every_way(model: str, speed_rad_s: float) -> None:
    stand = Stand(model=model)
    for way in StopWay:
        assert not failed(stand.test(way, speed_rad_s)), way


FOUND = {
    "late-watchdog": (StopWay.FROZEN, "reaction"),
    "abrupt-braking": (StopWay.DASHBOARD, "deceleration"),
    "slow-braking": (StopWay.DASHBOARD, "rest"),
    "first-stop-ignored": (StopWay.DASHBOARD, "reaction"),
    "swings-back": (StopWay.CONTROL, "back after the stop"),
    "hidden-protective-stop": (StopWay.KILLED, "held by safety"),
    "drifts-at-rest": (StopWay.CONTROL, "drift at rest"),
    "too-fast": (StopWay.CONTROL, "top speed"),
}


@pytest.mark.parametrize("weakness", WEAKNESSES)
@pytest.mark.parametrize("model", ["UR10", "UR10e"])
def test_a_planted_weakness_is_found_where_it_shows(weakness: str, model: str) -> None:
    way, name = FOUND[weakness]
    assert name in failed(Stand(weakness, model).test(way))


def test_a_weakness_is_found_only_where_it_is() -> None:
    stand = Stand("late-watchdog")
    assert not any(failed(stand.test(way)) for way in StopWay if way is not StopWay.FROZEN)


def test_few_samples_a_gap_no_stop_and_an_arm_that_stood_still_are_not_measured() -> None:
    stand, still = Stand(), Stand()
    stand.test(StopWay.CONTROL)
    still.run(3.0)
    states, move = stand.states, stand.move
    stop = next(i for i, s in enumerate(states) if s.stamps.host_monotonic_ns >= stand.stopped_ns)
    late = [s for i, s in enumerate(states) if not stop + 5 < i < stop + 40]
    at_rest = still.states, still.states[500].stamps.host_monotonic_ns
    for samples, moment_ns in (([], stand.stopped_ns), (late, stand.stopped_ns), (states, None), at_rest):
        figures, not_measured = judge(samples, move, moment_ns)
        assert not figures and not_measured


@pytest.mark.parametrize("weakness", ["hidden-protective-stop", "too-fast"])
def test_a_gap_hides_neither_a_protective_stop_nor_too_much_speed(weakness: str) -> None:
    stand = Stand(weakness)
    stand.test(StopWay.KILLED)
    figures, not_measured = judge(stand.states[:200] + stand.states[300:], stand.move, stand.stopped_ns)
    assert failed(figures) and not not_measured
