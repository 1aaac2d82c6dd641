"""Port 29999: the dashboard's text commands, one reply line each, of `dashboard.csv`.

Only commands that the station sends. What a person does at the pendant is told on port 29990, which no real
controller has (`admin`). Source: Universal Robots,
"Dashboard Server e-Series / CB-Series, port 29999". Columns: `cb3` and `e_series`, the first version that
knows it (empty: none does). `reply`, empty where it depends.
"""

from __future__ import annotations

from station.devices.rtde import RuntimeState
from station.simulation.controller.kinematics import read_table
from station.simulation.controller.network import Connection, Service
from station.simulation.controller.robot import SimulatedRobot
from station.simulation.controller.urscript_parser import NOT_SUPPORTED

PORT = 29999
GREETING = "Connected: Universal Robots Dashboard Server"
LOCAL_REFUSAL = (
    "Command is not allowed due to safety reasons, please switch robot to Remote Control mode "
    "and reconnect to port 29999"
)
VERBS = {row["verb"]: row for row in read_table("dashboard.csv")}


def dashboard_service(host: str, robot: SimulatedRobot) -> Service:
    return Service("dashboard", host, PORT, lambda: DashboardConnection(robot))


class DashboardConnection(Connection):
    def __init__(self, robot: SimulatedRobot) -> None:
        self._robot = robot
        self._rest = b""
        self._opened_in_local = False
        series = "e_series" if robot.settings.is_e_series else "cb3"
        self._known = {verb for verb, row in VERBS.items() if row[series]}

    def opened(self) -> None:
        self._opened_in_local = not self._robot.remote
        self._say(GREETING)

    def _say(self, text: str) -> None:
        self.transport.write(text.encode() + b"\n")

    def received(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            text = line.decode("utf-8", errors="replace").strip()
            if text:
                self._say(self._answer(text))

    def _answer(self, verb: str) -> str:
        robot = self._robot
        if verb not in self._known:
            error = "" if verb in VERBS else NOT_SUPPORTED
            robot.journal.note("dashboard", verb[:200], refused=True, error=error)
            return ": ".join(filter(None, ("could not understand", verb, error)))
        local = robot.settings.is_e_series and (not robot.remote or self._opened_in_local)
        refused = local and verb == "stop"
        robot.journal.note("dashboard", verb, refused=refused)
        if refused:
            return LOCAL_REFUSAL
        return self._do(verb) or VERBS[verb]["reply"].format(settings=robot.settings)

    def _do(self, verb: str) -> str:
        """Carry it out; its reply where the table has none."""
        robot = self._robot
        match verb:
            case "stop":
                robot.stop_program("dashboard stop")
            case "programState":
                words = {RuntimeState.PLAYING: "PLAYING", RuntimeState.PAUSED: "PAUSED"}
                name = robot.program.name if robot.program is not None else "<unnamed>"
                return f"{words.get(robot.runtime_state, 'STOPPED')} {name}"
            case "get robot model":
                return robot.settings.model.rstrip("e")
            case "is in remote control":
                return str(robot.remote).lower()
        return ""
