"""The station's own control script: what it obeys, when it ends; and the six calls in front of it."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Iterator
from math import nan
from typing import Any

import pytest

from station.cell.errors import RobotError
from station.devices.ur.control import WATCHDOG_HZ
from station.devices.ur.moves import JOINT_SPEED_LIMIT_RAD_S
from station.devices.ur.script import (
    FIRST_REGISTER,
    SILENCE_S,
    UNARMED_S,
    Command,
    ScriptControl,
    State,
    script,
)
from station.simulation.controller.uploads import Upload
from station.simulation.controller.urscript import ScriptRun
from station.simulation.controller.urscript_parser import ScriptSyntaxError
from station.simulation.launch import AdminClient, SimulatedController
from tests.patience import wait_until
from tests.station.simulation.conftest import SteppedRobot

HOME = (0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0)
GOAL = (0.6, -1.5708, 1.5708, -1.5708, -1.5708, 0.0)
SEQUENCE = 1000
Connect = Callable[[str], ScriptControl]
MAY_CALL = {
    "movej", "stopj", "sync", "get_steptime", "get_tcp_offset", "norm",
    "read_input_integer_register", "read_input_float_register",
    "write_output_integer_register", "write_output_float_register",
}  # fmt: skip
"""Of the controller's functions. A change here is a change of the safety rules."""


def test_the_script_calls_nothing_else_than_this() -> None:
    known: dict[str, Callable[..., object]] = dict.fromkeys(MAY_CALL, lambda *arguments, **named: None)
    ScriptRun(script(1), known)
    for name in MAY_CALL:
        with pytest.raises(ScriptSyntaxError, match=f":{name}:"):
            ScriptRun(script(1), {other: known[other] for other in MAY_CALL - {name}})


def test_the_script_waits_as_long_as_the_watchdog_would() -> None:
    assert pytest.approx(1 / WATCHDOG_HZ) == SILENCE_S


# -- the script alone, cycle by cycle -------------------------------------------------------------------


class Registers(SteppedRobot):
    """A controller in which the script runs; packets are written by hand."""

    def __init__(
        self, left_by_others: int = SEQUENCE, verb: Command = Command.NONE, model: str = "UR10"
    ) -> None:
        super().__init__(model=model, start_joints_rad=HOME)
        self.sequence, self.keepalive = left_by_others, 5
        self.verb, self.numbers = verb, (0.0,) * 8
        self.packet()
        self.robot.upload(Upload("station_control", script(SEQUENCE)))
        self.run(0.1)

    def packet(self) -> None:
        inputs, r = self.robot.inputs, FIRST_REGISTER
        for i, value in enumerate((self.sequence, self.verb, self.keepalive)):
            inputs.set(f"input_int_register_{r + i}", int(value))
        for i, number in enumerate(self.numbers):
            inputs.set(f"input_double_register_{r + i}", number)

    def run(self, seconds: float, kick: bool = True) -> None:
        for _ in range(round(seconds / self.robot.dt_s)):
            self.keepalive += kick
            self.packet()
            super().run(self.robot.dt_s)

    def say(
        self, verb: int, goal: tuple[float, ...] = GOAL, speed: float = 0.5, acceleration: float = 1.0
    ) -> int:
        """The script's answer: 1 taken, -1 refused, 0 nothing."""
        self.sequence += 1
        self.verb, self.numbers = verb, (*goal, speed, acceleration)
        self.run(0.03)
        answer = self.robot.outputs.get(f"output_int_register_{FIRST_REGISTER}")
        return (answer == self.sequence) - (answer == -self.sequence)

    @property
    def state(self) -> State:
        return State(self.robot.outputs.get(f"output_int_register_{FIRST_REGISTER + 1}"))

    @property
    def word(self) -> int:
        return int(self.robot.outputs.get("output_int_register_2"))


def cruising(model: str = "UR10") -> Registers:
    made = Registers(model=model)
    assert made.say(Command.ARM) == 1 and made.say(Command.MOVE) == 1
    made.run(0.6)
    assert made.speed_rad_s == pytest.approx(0.5)
    return made


def test_nothing_moves_at_the_start_and_a_script_that_nobody_arms_ends() -> None:
    made = Registers()
    made.run(3.0, kick=False)
    assert made.plays and made.state is State.WAITING and made.robot.arm.command == HOME
    made.run(UNARMED_S, kick=False)
    assert not made.plays and made.robot.arm.command == HOME


def test_a_script_that_is_armed_late_waits_for_its_first_keepalive() -> None:
    made = Registers()
    made.run(3.0, kick=False)
    made.sequence, made.verb = made.sequence + 1, Command.ARM
    made.run(0.19, kick=False)
    assert made.plays and made.state is State.ARMED
    made.sequence += 1  # from then on no command is a keepalive
    made.run(0.03, kick=False)
    assert not made.plays


@pytest.mark.parametrize("verb", [Command.NONE, Command.ARM, Command.MOVE])
def test_registers_that_somebody_else_left_are_not_obeyed(verb: Command) -> None:
    made = Registers(left_by_others=77, verb=verb)
    assert not made.plays and made.robot.arm.command == HOME


def test_a_move_is_taken_once_told_in_the_word_and_finished() -> None:
    made = cruising()
    assert made.state is State.MOVING and made.word == 1 << 24 | 1 << 15
    made.run(2.0)
    assert made.state is State.ARMED and made.word == 1 << 24
    assert made.robot.arm.command == GOAL and made.robot.journal.counts["script: movej"] == 1
    assert made.say(Command.MOVE, HOME) == 1 and made.word == 2 << 24 | 1 << 15


def test_a_move_is_refused_before_it_is_armed_and_while_one_is_under_way() -> None:
    made = Registers()
    assert made.say(Command.MOVE) == -1
    made.run(0.5)
    assert made.robot.arm.command == HOME and made.say(Command.ARM) == 1 and made.say(Command.MOVE) == 1
    assert made.say(Command.MOVE, HOME) == -1
    assert made.plays


@pytest.mark.parametrize(
    ("goal", "speed", "acceleration"),
    [
        ((nan, *GOAL[1:]), 0.5, 1.0),
        ((*GOAL[:5], 6.3), 0.5, 1.0),
        (GOAL, 0.0, 1.0),
        (GOAL, -0.5, 1.0),
        (GOAL, nan, 1.0),
        (GOAL, 0.5, 0.0),
        (GOAL, 0.5, nan),
    ],
)
def test_numbers_that_are_no_move_are_refused(
    goal: tuple[float, ...], speed: float, acceleration: float
) -> None:
    made = Registers()
    made.say(Command.ARM)
    assert made.say(Command.MOVE, goal, speed, acceleration) == -1
    made.run(0.3)
    assert made.robot.arm.command == HOME and made.state is State.ARMED


def test_speed_and_acceleration_have_a_limit_of_the_scripts_own() -> None:
    made = Registers()
    made.say(Command.ARM)
    assert made.say(Command.MOVE, (3.0, *GOAL[1:]), 50.0, 50.0) == 1
    fastest = 0.0
    for _ in range(100):
        before = made.speed_rad_s
        made.run(0.008)
        fastest = max(fastest, made.speed_rad_s)
        assert made.speed_rad_s - before < 1.5 * 0.008 * 1.1
    assert fastest == pytest.approx(JOINT_SPEED_LIMIT_RAD_S)


@pytest.mark.parametrize("model", ["UR10", "UR10e"])
def test_silence_stops_the_arm_and_ends_the_script(model: str) -> None:
    made = cruising(model)
    made.run(0.19, kick=False)
    made.run(0.008)  # a keepalive now and then is enough
    made.run(0.19, kick=False)
    assert made.plays and made.speed_rad_s == pytest.approx(0.5)
    made.run(0.03, kick=False)
    assert made.speed_rad_s < 0.5 and made.state is State.ENDED
    made.run(0.13, kick=False)
    assert made.speed_rad_s == 0.0 and not made.plays
    made.run(1.0)  # a keepalive that comes back brings nothing back
    assert made.speed_rad_s == 0.0 and not made.plays


@pytest.mark.parametrize("verb", [Command.STOP, Command.END, 77])
def test_every_other_verb_brakes_and_ends(verb: int) -> None:
    made = cruising()
    assert made.say(verb) == 1
    made.run(0.13)
    assert made.speed_rad_s == 0.0 and not made.plays
    assert made.word == 1 << 24, "no move is under way any more"
    assert made.robot.journal.counts["script: stopj"] == 1


def test_a_script_that_does_not_move_ends_without_a_stop() -> None:
    made = Registers()
    made.say(Command.END)
    assert not made.plays and "script: stopj" not in made.robot.journal.counts


# -- the six calls, in front of a controller ------------------------------------------------------------


@pytest.fixture
def running(controller: Callable[..., SimulatedController]) -> SimulatedController:
    return controller(time_scale=0.5)  # so that a busy computer is slow twice as long before a watchdog trips


@pytest.fixture
def admin(running: SimulatedController) -> Any:
    with running.admin() as client:
        yield client


@pytest.fixture
def connect() -> Iterator[Connect]:
    made: list[ScriptControl] = []

    def connect(host: str) -> ScriptControl:
        made.append(ScriptControl(host))
        return made[-1]

    yield connect
    for control in made:
        control.close()


def uploads(admin: AdminClient) -> int:
    return int(admin.ask("log")["counts"].get("upload: station_control", 0))


@pytest.mark.process
def test_the_calls_mean_what_they_mean_in_ur_rtde(
    running: SimulatedController, connect: Connect, admin: AdminClient
) -> None:
    admin.ask("tcp", pose=[0.0, 0.01, 0.15, 0.0, 0.0, 0.5])
    control = connect(running.host)
    assert control.getTCPOffset() == pytest.approx([0.0, 0.01, 0.15, 0.0, 0.0, 0.5])
    assert not control.moveJ(GOAL, 0.5, 1.0, True), "no move before the watchdog is armed"
    assert control.setWatchdog(WATCHDOG_HZ) and control.kickWatchdog()
    assert control.moveJ(GOAL, 0.5, 1.0, True)
    for _ in range(10):
        assert control.kickWatchdog()
        time.sleep(0.03)
    control.stopJ(2.0, True)
    assert not control.kickWatchdog() and not control.setWatchdog(WATCHDOG_HZ)
    assert not control.moveJ(GOAL, 0.5, 1.0, True)
    assert uploads(admin) == 1


@pytest.mark.process
def test_a_move_that_a_paused_script_did_not_answer_is_not_made_when_it_goes_on(
    running: SimulatedController, connect: Connect, admin: AdminClient
) -> None:
    control = connect(running.host)
    assert control.setWatchdog(WATCHDOG_HZ) and control.kickWatchdog()
    before = admin.ask("state")["joints_rad"]
    control._told_s = float("inf")  # the pause is not seen yet
    control._plays = lambda: True
    admin.ask("pause")
    assert not control.moveJ(GOAL, 0.5, 1.0, True)
    admin.ask("play")
    time.sleep(0.5)
    assert admin.ask("state")["joints_rad"] == pytest.approx(before, abs=1e-3)
    assert admin.ask("state")["runtime_state"] == "STOPPED"


@pytest.mark.process
@pytest.mark.parametrize("fault", ["pause", "stop_program", "drop", "stall"])
def test_a_script_that_is_lost_stays_lost(
    running: SimulatedController, connect: Connect, admin: AdminClient, fault: str
) -> None:
    control = connect(running.host)
    assert control.setWatchdog(WATCHDOG_HZ) and control.kickWatchdog()
    admin.ask(fault)
    wait_until(lambda: not control.kickWatchdog())
    if fault == "stall":
        admin.ask("stall", on=False)
    time.sleep(0.4)
    assert not control.kickWatchdog() and not control.moveJ(GOAL, 0.5, 1.0, True)
    control.stopJ(2.0, True)
    assert uploads(admin) == 1 and "script: movej" not in admin.ask("log")["counts"]


@pytest.mark.process
@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ({"cmd": "in_use", "inputs": [f"input_double_register_{FIRST_REGISTER}"]}, "registers-in-use"),
        ({"cmd": "foreign"}, "program-playing"),
        ({"cmd": "stall"}, "no-state"),
        ({"cmd": "power_off"}, "script-not-started"),
    ],
)
def test_a_start_is_refused(
    running: SimulatedController,
    connect: Connect,
    admin: AdminClient,
    monkeypatch: pytest.MonkeyPatch,
    fault: Any,
    code: str,
) -> None:
    monkeypatch.setattr("station.devices.ur.script.START_S", 0.5)
    admin.ask(**fault)
    time.sleep(0.2)
    with pytest.raises(RobotError) as caught:
        connect(running.host)
    assert caught.value.code == code
    assert uploads(admin) == (code == "script-not-started")
    if code == "program-playing":
        assert admin.ask("state")["program"] == "palletising.urp"


def test_nothing_is_written_behind_half_a_packet() -> None:
    """The rest of it would be read as numbers of the packet that it completes."""
    ours, theirs = socket.socketpair()
    control = object.__new__(ScriptControl)
    control._link, control._lost, control._broken, control._keepalive = ours, False, False, 0
    control._inputs = type("Recipe", (), {"pack": lambda self, values: json.dumps(values).encode() * 100})()
    ours.setblocking(False)
    for n in range(1000):
        control._write(n, Command.MOVE)
    assert control._lost and control._broken and ours.fileno() == -1
    theirs.close()
