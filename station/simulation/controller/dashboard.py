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


_WITH_ARGUMENT = (
    "load installation", "load", "popup", "addToLog", "setUserRole", "set operational mode",
    "generate flight report", "generate support file",
)  # fmt: skip
_SINCE = {
    "version": (None, (5, 0)),
    "safetystatus": ((3, 10), (5, 4)),
    "is in remote control": (None, (5, 6)),
    "get operational mode": (None, (5, 6)),
    "set operational mode": (None, (5, 0)),
    "clear operational mode": (None, (5, 0)),
    "setUserRole": ((3, 1), None),
    "getUserRole": ((3, 1), None),
    "get serial number": ((3, 12), (5, 6)),
    "get robot model": ((3, 12), (5, 6)),
    "generate flight report": ((3, 13), (5, 8)),
    "generate support file": ((3, 13), (5, 8)),
    "saveLog": ((3, 13), (5, 8)),
    "restart safety": ((3, 7), (5, 1)),
}
"""First version on CB3 and on e-Series (None: never) of what not every controller knows."""


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
        for verb in _WITH_ARGUMENT:
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

    version = ".".join(map(str, robot.settings.version))

    def program_state(_: str) -> str:
        words = {RuntimeState.PLAYING: "PLAYING", RuntimeState.PAUSED: "PAUSED"}
        name = robot.program.name if robot.program is not None else robot.loaded or "<unnamed>"
        return f"{words.get(robot.runtime_state, 'STOPPED')} {name}"

    def role(name: str) -> str:
        robot.user_role = name
        return f"Setting user role: {name}"

    def operational_mode(name: str) -> str:
        robot.operational_mode = name.upper()
        return f"Operational mode {name.upper()} is set"

    def load(name: str) -> str:
        stem = name.rpartition("/")[2]
        if stem not in robot.settings.programs:
            return f"File not found: {name}"
        robot.stop_program("another was loaded")
        robot.loaded = stem
        return f"Loading program: {name}"

    def say_popup(text: str) -> str:
        robot.popup = text
        return "showing popup"

    def saved(_: str) -> str:
        return f"true {robot.loaded or '<unnamed>'}"

    answers: dict[str, Callable[[str], str]] = {
        "stop": does("Stopped", lambda: robot.stop_program("dashboard stop")),
        "play": lambda _: "Starting program" if robot.play_program() else "Failed to execute: play",
        "pause": lambda _: "Pausing program" if robot.pause_program() else "Failed to execute: pause",
        "load": load,
        "load installation": lambda name: f"Loading installation: {name}",
        "running": lambda _: f"Program running: {str(robot.runtime_state == RuntimeState.PLAYING).lower()}",
        "robotmode": lambda _: f"Robotmode: {robot.robot_mode.name}",
        "safetymode": lambda _: f"Safetymode: {robot.safety_mode.name}",
        "safetystatus": lambda _: f"Safetystatus: {robot.safety_mode.name}",
        "programState": program_state,
        "get loaded program": lambda _: (
            f"Loaded program: {robot.loaded}" if robot.loaded else "No program loaded"
        ),
        "get robot model": does(robot.settings.model.rstrip("e")),
        "get serial number": does(robot.settings.serial),
        "PolyscopeVersion": does(f"URSoftware {version} (Mar 31 2020)"),
        "version": does(version),
        "isProgramSaved": saved,
        "setUserRole": role,
        "getUserRole": lambda _: robot.user_role,
        "set operational mode": operational_mode,
        "get operational mode": lambda _: robot.operational_mode,
        "clear operational mode": does(
            "No longer controlling the operational mode. Current operational mode: 'NONE'.",
            lambda: operational_mode("none"),
        ),
        "power on": does("Powering on", robot.power_on),
        "power off": does("Powering off", robot.power_off),
        "brake release": does("Brake releasing", robot.run),
        "unlock protective stop": lambda _: (
            "Protective stop releasing" if robot.unlock() else UNLOCK_TOO_EARLY
        ),
        "close safety popup": does("closing safety popup"),
        "close popup": does("closing popup", lambda: setattr(robot, "popup", None)),
        "popup": say_popup,
        "addToLog": does("Added log message"),
        "saveLog": does("Log saved to disk"),
        "generate flight report": lambda kind: f"Flight Report generated with id: {kind or 'system'}",
        "generate support file": lambda place: f"Completed successfully: {place}/ur_support_file.zip",
        "restart safety": does("Restarting safety"),
        "is in remote control": lambda _: str(robot.remote).lower(),
        "quit": does("Disconnected"),
        "shutdown": does("Shutting down", robot.power_off),
    }

    def known(verb: str) -> bool:
        since = _SINCE.get(verb, ((3, 0), (5, 0)))[robot.settings.is_e_series]
        return since is not None and since <= robot.settings.version

    return {verb: answer for verb, answer in answers.items() if known(verb)}
