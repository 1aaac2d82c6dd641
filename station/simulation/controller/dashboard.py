"""Port 29999: the dashboard's text commands, one reply line each.

Source: Universal Robots, "Dashboard Server e-Series / CB-Series, port 29999".
"""

from __future__ import annotations

from collections.abc import Callable

from station.devices.rtde import RuntimeState
from station.simulation.controller.network import Connection, Service
from station.simulation.controller.robot import SimulatedRobot

PORT = 29999
LINE_LIMIT = 4096
GREETING = "Connected: Universal Robots Dashboard Server"
LOCAL_REFUSAL = (
    "Command is not allowed due to safety reasons, please switch robot to Remote Control mode "
    "and reconnect to port 29999"
)
UNLOCK_TOO_EARLY = (
    "Cannot unlock protective stop until 5s after occurrence. "
    "Always inspect cause of protective stop before unlocking"
)
CHANGING = frozenset(
    {
        "stop", "play", "pause", "load", "power on", "power off", "brake release", "unlock protective stop",
        "restart safety", "shutdown",
    }
)  # fmt: skip


def dashboard_service(host: str, robot: SimulatedRobot) -> Service:
    return Service("dashboard", host, PORT, lambda: DashboardConnection(robot))


class DashboardConnection(Connection):
    def __init__(self, robot: SimulatedRobot) -> None:
        self._robot = robot
        self._rest = b""
        self._opened_in_local = False
        self._answers = _answers(robot)

    def opened(self) -> None:
        self._opened_in_local = not self._robot.remote
        self._say(GREETING)

    def _say(self, text: str) -> None:
        self.transport.write(text.encode() + b"\n")

    def received(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LINE_LIMIT:
            self.transport.close()
        for line in lines:
            text = line.decode("utf-8", errors="replace").strip()
            if text:
                self._say(self._answer(text))
            if text in ("quit", "shutdown"):
                self.transport.close()

    def _answer(self, text: str) -> str:
        verb, argument = self._split(text)
        robot = self._robot
        if verb not in self._answers:
            robot.journal.note("dashboard", text[:200], refused=True)
            return f"could not understand: {text}"
        local = robot.settings.is_e_series and (not robot.remote or self._opened_in_local)
        refused = local and verb in CHANGING
        robot.journal.note("dashboard", verb, argument=argument, refused=refused)
        return LOCAL_REFUSAL if refused else self._answers[verb](argument)

    def _split(self, text: str) -> tuple[str, str]:
        for verb in ("load", "popup", "addToLog"):
            if text.startswith(verb + " "):
                return verb, text[len(verb) + 1 :]
        return text, ""


def _answers(robot: SimulatedRobot) -> dict[str, Callable[[str], str]]:
    def does(reply: str, *actions: Callable[[], object]) -> Callable[[str], str]:
        def answer(_: str) -> str:
            for action in actions:
                action()
            return reply

        return answer

    def program_state(_: str) -> str:
        words = {RuntimeState.PLAYING: "PLAYING", RuntimeState.PAUSED: "PAUSED"}
        name = robot.program.name if robot.program is not None else "<unnamed>"
        return f"{words.get(robot.runtime_state, 'STOPPED')} {name}"

    answers: dict[str, Callable[[str], str]] = {
        "stop": does("Stopped", lambda: robot.stop_program("dashboard stop")),
        "play": lambda _: "Starting program" if robot.play_program() else "Failed to execute: play",
        "pause": lambda _: "Pausing program" if robot.pause_program() else "Failed to execute: pause",
        "load": lambda name: f"File not found: {name}",
        "running": lambda _: f"Program running: {str(robot.runtime_state == RuntimeState.PLAYING).lower()}",
        "robotmode": lambda _: f"Robotmode: {robot.robot_mode.name}",
        "safetymode": lambda _: f"Safetymode: {robot.safety_mode.name}",
        "safetystatus": lambda _: f"Safetystatus: {robot.safety_mode.name}",
        "programState": program_state,
        "get loaded program": does("No program loaded"),
        "get robot model": does(robot.settings.model.rstrip("e")),
        "get serial number": does(robot.settings.serial),
        "PolyscopeVersion": does(_version(robot)),
        "version": does(_version(robot)),
        "isProgramSaved": does("true <unnamed>"),
        "power on": does("Powering on", robot.power_on),
        "power off": does("Powering off", robot.power_off),
        "brake release": does("Brake releasing", robot.power_on, robot.release_brakes),
        "unlock protective stop": lambda _: (
            "Protective stop releasing" if robot.unlock() else UNLOCK_TOO_EARLY
        ),
        "close safety popup": does("closing safety popup"),
        "close popup": does("closing popup"),
        "popup": does("showing popup"),
        "addToLog": does("Added log message"),
        "restart safety": does("Restarting safety"),
        "quit": does("Disconnected"),
        "shutdown": does("Shutting down", robot.power_off),
    }
    if robot.settings.is_e_series:
        answers["is in remote control"] = lambda _: str(robot.remote).lower()
    return answers


def _version(robot: SimulatedRobot) -> str:
    text = ".".join(map(str, robot.settings.version))
    return f"URSoftware {text} (Mar 31 2020)" if robot.settings.is_e_series else text
