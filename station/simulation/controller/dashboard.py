"""Port 29999: the dashboard's text commands, one reply line each, of `dashboard.csv`.

Source: Universal Robots, "Dashboard Server e-Series / CB-Series, port 29999". Columns: `argument`, whether
one may follow. `changes`, refused in local control. `cb3` and `e_series`, the first version that knows it
(empty: none does). `reply`, empty where it depends.
"""

from __future__ import annotations

from station.devices.rtde import RuntimeState
from station.simulation.controller.kinematics import read_table
from station.simulation.controller.network import Connection, Service
from station.simulation.controller.robot import SimulatedRobot
from station.simulation.controller.state import version_of

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
VERBS = {row["verb"]: row for row in read_table("dashboard.csv")}


def dashboard_service(host: str, robot: SimulatedRobot) -> Service:
    return Service("dashboard", host, PORT, lambda: DashboardConnection(robot))


class DashboardConnection(Connection):
    def __init__(self, robot: SimulatedRobot) -> None:
        self._robot = robot
        self._rest = b""
        self._opened_in_local = False
        settings = robot.settings
        since = {verb: row["e_series" if settings.is_e_series else "cb3"] for verb, row in VERBS.items()}
        self._known = {
            verb for verb, first in since.items() if first and version_of(first) <= settings.version
        }

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
        robot = self._robot
        words = text.split(" ")
        starts = [" ".join(words[:n]) for n in range(len(words), 0, -1)]
        verb = next((s for s in starts if s in self._known and (s == text or VERBS[s]["argument"])), "")
        if not verb:
            robot.journal.note("dashboard", text[:200], refused=True)
            return f"could not understand: {text}"
        argument = text[len(verb) + 1 :]
        local = robot.settings.is_e_series and (not robot.remote or self._opened_in_local)
        refused = local and VERBS[verb]["changes"] == "yes"
        robot.journal.note("dashboard", verb, argument=argument, refused=refused)
        if refused:
            return LOCAL_REFUSAL
        version = ".".join(map(str, robot.settings.version))
        said = self._do(verb, argument)
        return said or VERBS[verb]["reply"].format(robot=robot, argument=argument, version=version)

    def _do(self, verb: str, argument: str) -> str | None:
        """Carry it out; its reply where the table has none."""
        robot = self._robot
        match verb:
            case "stop":
                robot.stop_program("dashboard stop")
            case "play":
                return "Starting program" if robot.play_program() else "Failed to execute: play"
            case "pause":
                return "Pausing program" if robot.pause_program() else "Failed to execute: pause"
            case "load":
                stem = argument.rpartition("/")[2]
                if stem not in robot.settings.programs:
                    return f"File not found: {argument}"
                robot.stop_program("another was loaded")
                robot.loaded = stem
                return f"Loading program: {argument}"
            case "running":
                return f"Program running: {str(robot.runtime_state == RuntimeState.PLAYING).lower()}"
            case "programState":
                words = {RuntimeState.PLAYING: "PLAYING", RuntimeState.PAUSED: "PAUSED"}
                name = robot.program.name if robot.program is not None else robot.loaded or "<unnamed>"
                return f"{words.get(robot.runtime_state, 'STOPPED')} {name}"
            case "get loaded program":
                return f"Loaded program: {robot.loaded}" if robot.loaded else "No program loaded"
            case "get robot model":
                return robot.settings.model.rstrip("e")
            case "power on":
                robot.power_on()
            case "power off" | "shutdown":
                robot.power_off()
            case "brake release":
                robot.run()
            case "unlock protective stop":
                return "Protective stop releasing" if robot.unlock() else UNLOCK_TOO_EARLY
            case "is in remote control":
                return str(robot.remote).lower()
        return None
