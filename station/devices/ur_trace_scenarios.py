"""Scripted scenarios on any UR controller, with their timing, recorded and compared.

The scenarios are data (trace_scenarios.yaml). A recording is one compressed JSON file of about 100 kB, made
to be sent: who has URSim or an arm sends theirs back, and the difference to the shipped one says what a
simulation does otherwise.

Every program that moves keeps the station's rules by itself: wrist 3 only, 0.1 rad at 0.2 rad/s, and it ends
when the recorder is silent for 0.2 s.
"""

from __future__ import annotations

import gzip
import select
import socket
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from calibrate.geometry import Array
from station.cell.errors import RobotError
from station.devices.rtde import HANDSHAKE_S, PORT, PacketType, Recipe, RtdeError, RtdeLink, RuntimeState
from station.devices.ur_dashboard import PORT as DASHBOARD_PORT
from station.devices.ur_dashboard import STOP
from station.devices.ur_script import SCRIPT_PORT

HERE = Path(__file__).parent
SHIPPED = {125: HERE / "traces-cb3.json.gz", 500: HERE / "traces-e-series.json.gz"}
"""Traces of the simulated controller, by its rate in Hz."""
RESTING_RAD_S = 0.005
MOVES_RAD = 0.001
SLOWER = 0.9
TOLERANCES: dict[str, float] = {
    "at_s": 0.06,
    "reaction_s": 0.04,
    "rest_s": 0.06,
    "travel_rad": 0.006,
    "after_rad": 0.012,
    "peak_rad_s": 0.02,
    "every_s": 0.002,
}
"""Largest difference by the end of a figure's name; what is not a number must be equal."""
TURN_RAD, JOINT = 0.1, 5
KICK_S = 0.02
MARK_WAIT_S = 2.0
QUIET_S = 0.3
ROUNDED = 5
_MARKS = "def mark(n):\n  write_output_integer_register(24, n)\nend\nmark(0)\nsync()\nsync()\n"
_MOVING = """\
global here = get_actual_joint_positions()
global there = get_actual_joint_positions()
there[5] = there[5] + {turn}
global finished = False
thread hand():
{program}
  finished = True
end
kept = read_input_integer_register(24)
silence = 0.0
mark(1)
worker = run hand()
going = True
while going:
  sync()
  alive = read_input_integer_register(24)
  if alive != kept:
    kept = alive
    silence = 0.0
  else:
    silence = silence + get_steptime()
  end
  if finished:
    going = False
  elif silence > 0.2:
    kill worker
    stopj(4.0)
    going = False
  elif read_input_integer_register(25) == 1:
{stop}
    going = False
  end
end
mark(2)
"""
_OUTPUTS = ("timestamp", "actual_q", "actual_qd", "runtime_state", "safety_mode", "output_int_register_24")
_INPUTS = ("input_int_register_24", "input_int_register_25")


class TraceEvent(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    at: float
    """s after the program's first mark"""
    do: Literal["stop-order", "dashboard-stop", "silence", "write", "upload"]
    value: int = 0
    program: str = ""


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One thing to do, and what is recorded of it."""

    name: str
    moves: bool = False
    program: str = ""
    stop: str = "kill worker\nstopj(4.0)"
    seconds: float = 1.0
    events: tuple[TraceEvent, ...] = ()
    ask: tuple[str, ...] | None = None
    rtde: str = ""


def scenarios() -> tuple[Scenario, ...]:
    return msgspec.yaml.decode(
        (Path(__file__).with_name("trace_scenarios.yaml")).read_bytes(), type=tuple[Scenario, ...]
    )


class ScenarioRecorder:
    """One controller, one scenario after the other. Blocking; nothing moves but what `record` is told."""

    def __init__(self, host: str) -> None:
        """RobotError where a program plays; RtdeError, OSError where it does not answer."""
        self.host = host
        with socket.create_connection((host, PORT), HANDSHAKE_S) as link:
            version = RtdeLink(link).version()
        self.controller = ".".join(map(str, version))
        self.rate_hz = 500.0 if version[0] > 3 else 125.0
        self._start_rad: float | None = None

    def record(self, scenario: Scenario) -> ScenarioTrace:
        if scenario.rtde:
            return ScenarioTrace(scenario.name, answers=_rtde_answers(self.host, scenario.rtde, self.rate_hz))
        if scenario.ask is not None:
            return ScenarioTrace(scenario.name, answers=self._ask(scenario.ask))
        with _Line(self.host, self.rate_hz) as line:
            first = line.first()
            if first.runtime == RuntimeState.PLAYING:
                raise RobotError("a program is playing on the robot", code="program-playing")
            if self._start_rad is None:
                self._start_rad = first.angle_rad
            turn = TURN_RAD if first.angle_rad <= self._start_rad + TURN_RAD / 2 else -TURN_RAD
            return self._run(scenario, line, turn)

    def _run(self, scenario: Scenario, line: _Line, turn: float) -> ScenarioTrace:
        text = scenario.program
        if scenario.moves:
            text = _MOVING.format(turn=turn, program=_indented(text, 2), stop=_indented(scenario.stop, 4))
        with socket.create_connection((self.host, SCRIPT_PORT), HANDSHAKE_S) as upload:
            upload.sendall(program(text))
            origin = line.until_mark(MARK_WAIT_S)
            given = []
            for event in scenario.events:
                line.run(origin + event.at)
                given.append(line.now_s)
                self._give(event, line, upload)
            line.run(origin + scenario.seconds)
            whole = len(line.samples)
            if line.samples[-1].runtime == RuntimeState.PLAYING:  # nothing of ours is left behind
                self._ask((STOP,))
                line.run(line.now_s + QUIET_S)
        begin = next((k for k, s in enumerate(line.samples) if s.time_s >= origin - QUIET_S), 0)
        kept = line.samples[begin : whole : max(1, round(self.rate_hz / 125))]
        here = kept[0].angle_rad
        sign = 1.0 if turn > 0 else -1.0
        return ScenarioTrace(
            scenario.name,
            [round(s.time_s - origin, ROUNDED) for s in kept],
            [round(sign * (s.angle_rad - here), ROUNDED) for s in kept],
            [round(sign * s.speed_rad_s, ROUNDED) for s in kept],
            [s.runtime for s in kept],
            [s.safety for s in kept],
            [s.mark for s in kept],
            [round(at - origin, ROUNDED) for at in given],
        )

    def _give(self, event: TraceEvent, line: _Line, upload: socket.socket) -> None:
        if event.do == "dashboard-stop":
            self._ask((STOP,))
        elif event.do == "silence":
            line.kicks = False
        elif event.do == "upload":
            upload.sendall(program(event.program))
        else:
            line.order = event.value or 1

    def _ask(self, questions: Sequence[str]) -> dict[str, str]:
        """Greeting and answers, without what differs from arm to arm."""
        with socket.create_connection((self.host, DASHBOARD_PORT), HANDSHAKE_S) as link:
            lines = link.makefile("rw", newline="\n")
            answers = {"": lines.readline().strip()}
            for question in questions:
                lines.write(question + "\n")
                lines.flush()
                answers[question] = lines.readline().strip()
        return answers


def program(text: str) -> bytes:
    """A whole program around these lines, with `mark`."""
    return f"def station_trace():\n{_indented(_MARKS + text, 2)}\nend\n".encode("ascii")


def _indented(text: str, by: int) -> str:
    return "\n".join(" " * by + line for line in text.strip("\n").split("\n"))


class _Sample(msgspec.Struct, frozen=True):
    time_s: float
    angle_rad: float
    speed_rad_s: float
    runtime: int
    safety: int
    mark: int


class _Line:
    """RTDE both ways: samples in, keepalive and order out, in one thread."""

    def __init__(self, host: str, rate_hz: float) -> None:
        self._link = socket.create_connection((host, PORT), HANDSHAKE_S)
        self.samples: list[_Sample] = []
        self.kicks, self.order = True, 0
        self._count, self._kicked_s = 0, 0.0
        try:
            self._rtde = RtdeLink(self._link)
            self._inputs: Recipe = self._rtde.inputs(_INPUTS)
            self._outputs: Recipe = self._rtde.outputs(rate_hz, _OUTPUTS)
            self._rtde.start()
            self._link.setblocking(False)
            for kind, payload in self._rtde.pending:
                self._take(kind, payload)
        except BaseException:
            self._link.close()
            raise

    def __enter__(self) -> _Line:
        return self

    def __exit__(self, *_: object) -> None:
        self._link.close()

    @property
    def now_s(self) -> float:
        return self.samples[-1].time_s

    def first(self) -> _Sample:
        """After some packets: the first of ours acted."""
        self._while(lambda: len(self.samples) < 10, HANDSHAKE_S)
        if not self.samples:
            raise RtdeError("no robot state came", code="no-state")
        return self.samples[-1]

    def until_mark(self, timeout_s: float) -> float:
        """Controller time of the first mark; now, when none comes."""
        begun = len(self.samples)
        self._while(lambda: self._marked(begun) is None, timeout_s)
        at = self._marked(begun)
        return self.now_s if at is None else at

    def run(self, until_s: float) -> None:
        """By the controller's clock."""
        self._while(lambda: self.now_s < until_s, until_s - self.now_s + HANDSHAKE_S)

    def _marked(self, begun: int) -> float | None:
        """An older program's mark, which stays in the register, is none: each program begins with mark(0)."""
        playing = [s for s in self.samples[begun:] if s.runtime == RuntimeState.PLAYING]
        zero = next((k for k, s in enumerate(playing) if s.mark == 0), len(playing))
        return next((s.time_s for s in playing[zero:] if s.mark == 1), None)

    def _while(self, condition: Callable[[], bool], timeout_s: float) -> None:
        give_up_s = time.monotonic() + timeout_s
        while condition() and time.monotonic() < give_up_s:
            if time.monotonic() - self._kicked_s >= KICK_S:
                self._kicked_s = time.monotonic()
                self._count += self.kicks
                self._link.sendall(self._inputs.pack((self._count, self.order)))
            if select.select([self._link], [], [], KICK_S / 4)[0]:
                data = self._link.recv(65536)
                if not data:
                    raise RtdeError("the controller closed the connection")
                for kind, payload in self._rtde.packets.feed(data):
                    self._take(kind, payload)

    def _take(self, kind: int, payload: bytes) -> None:
        if kind == PacketType.DATA:
            v = self._outputs.unpack_elements(payload)
            self.samples.append(_Sample(v[0], v[1 + JOINT], v[7 + JOINT], int(v[13]), int(v[14]), int(v[15])))


def _rtde_answers(host: str, question: str, rate_hz: float) -> dict[str, str]:
    """Send RTDE one odd request and return its answer; '' where it said nothing wrong."""
    with socket.create_connection((host, PORT), HANDSHAKE_S) as link:
        rtde = RtdeLink(link)
        try:
            if question == "unknown-output":
                rtde.outputs(rate_hz, ("timestamp", "no_such_output"))
            elif question == "unknown-input":
                rtde.inputs(("no_such_input",))
            elif question in ("claimed-twice", "claim-ends"):
                rtde.inputs(_INPUTS)
                if question == "claim-ends":
                    link.close()
                    time.sleep(QUIET_S)
                with socket.create_connection((host, PORT), HANDSHAKE_S) as second:
                    RtdeLink(second).inputs(_INPUTS)
            else:
                return _stream(link, rtde, rate_hz / 4 if question == "slow-rate" else rate_hz, question)
        except (RtdeError, OSError) as error:
            return {question: error.code if isinstance(error, RtdeError) else type(error).__name__}
    return {question: ""}


def _stream(link: socket.socket, rtde: RtdeLink, rate_hz: float, question: str) -> dict[str, str]:
    """The spacing of the samples at this rate, or whether they end with a pause."""
    recipe = rtde.outputs(rate_hz, ("timestamp",))
    rtde.start()
    times: list[float] = []
    give_up_s = time.monotonic() + 2 * QUIET_S
    paused = False
    while time.monotonic() < give_up_s:
        if question == "pause" and not paused and time.monotonic() > give_up_s - QUIET_S:
            rtde.pause()
            paused, times = True, []
        if select.select([link], [], [], 0.02)[0]:
            for kind, payload in rtde.packets.feed(link.recv(65536)):
                if kind == PacketType.DATA:
                    times.append(recipe.unpack_elements(payload)[0])
    if question == "pause":
        return {"samples after the pause": "none" if len(times) < 5 else "go on"}
    return {"every_s": f"{float(np.median(np.diff(times))):.4f}" if len(times) > 1 else "nothing came"}


class ScenarioTrace(msgspec.Struct, frozen=True, omit_defaults=True):
    """Trace of one scenario: n samples, times in s from the program's first mark."""

    name: str
    time_s: list[float] = []
    angle_rad: list[float] = []
    """Angle of wrist 3 from its start, in the direction of the turn."""
    speed_rad_s: list[float] = []
    runtime: list[int] = []
    safety: list[int] = []
    mark: list[int] = []
    events_s: list[float] = []
    """When each event was given, by the controller's clock."""
    answers: dict[str, str] = {}


class TraceFile(msgspec.Struct, frozen=True):
    controller: str
    """Its version, as RTDE tells it."""
    rate_hz: float
    traces: tuple[ScenarioTrace, ...]
    format: str = "controller-traces/1"


class Difference(msgspec.Struct, frozen=True):
    """One figure of one scenario in two recordings."""

    scenario: str
    figure: str
    ours: float | str
    theirs: float | str
    tolerance: float
    passed: bool


def write_traces(path: Path, found: TraceFile) -> None:
    path.write_bytes(gzip.compress(msgspec.json.encode(found), mtime=0))


def read_traces(path: Path) -> TraceFile:
    """RobotError where it is no recording of traces."""
    try:
        return msgspec.json.decode(gzip.decompress(path.read_bytes()), type=TraceFile)
    except (OSError, EOFError, msgspec.DecodeError) as error:
        raise RobotError(f"{path}: no recording of traces ({error})", code="no-traces") from error


def figures(trace: ScenarioTrace) -> dict[str, float | str]:
    """Reduce a trace to figures; the end of each name tells its unit and tolerance."""
    found: dict[str, float | str] = dict(trace.answers)
    if not trace.time_s:
        return {k: float(v) if k.endswith("_s") and v[:1].isdigit() else v for k, v in trace.answers.items()}
    time_s, angle, speed = (np.array(v) for v in (trace.time_s, trace.angle_rad, trace.speed_rad_s))
    found["program states"] = _sequence(trace.runtime)
    found["safety modes"] = _sequence(trace.safety)
    found["marks"] = _sequence([m for m, t in zip(trace.mark, time_s, strict=True) if t >= 0])
    ended = [t for t, r in zip(time_s, trace.runtime, strict=True) if t > 0 and r == RuntimeState.STOPPED]
    found["program ends at_s"] = float(ended[0]) if ended else "not"
    if np.abs(angle).max() < MOVES_RAD:
        return found
    found["peak_rad_s"] = float(np.abs(speed).max())
    found["travel_rad"] = float(angle[-1])
    started = int(np.flatnonzero(np.abs(angle) > MOVES_RAD)[0])
    found["starts at_s"] = float(time_s[started])
    if not trace.events_s:
        found["rests at_s"] = _first(time_s, np.abs(speed) < RESTING_RAD_S, started)
        return found
    at = min(int(np.searchsorted(time_s, trace.events_s[-1])), len(time_s) - 1)
    found["reaction_s"] = _since(_first(time_s, np.abs(speed) < SLOWER * abs(speed[at]), at), time_s[at])
    found["rest_s"] = _since(_first(time_s, np.abs(speed) < RESTING_RAD_S, at), time_s[at])
    found["after_rad"] = float(angle[-1] - angle[at])
    del found["travel_rad"]  # it has the lateness of the event in it
    return found


def compare(ours: TraceFile, theirs: TraceFile) -> list[Difference]:
    """Every figure of every scenario that both recorded; "not" stands for one that a recording lacks."""
    other = {trace.name: figures(trace) for trace in theirs.traces}
    found = []
    for trace in ours.traces:
        if trace.name not in other:
            continue
        mine, yours = figures(trace), other[trace.name]
        for name in dict.fromkeys([*mine, *yours]):
            a, b = mine.get(name, "not"), yours.get(name, "not")
            tolerance = next((t for end, t in TOLERANCES.items() if name.endswith(end)), 0.0)
            numbers = isinstance(a, float) and isinstance(b, float)
            same = abs(a - b) <= tolerance if numbers else a == b  # type: ignore[operator]
            found.append(Difference(trace.name, name, a, b, tolerance, bool(same)))
    return found


def _sequence(values: Sequence[int]) -> str:
    """'1 2 1': values without their repeats."""
    return " ".join(str(v) for k, v in enumerate(values) if not k or values[k - 1] != v)


def _first(time_s: Array, where: Array, after: int) -> float | str:
    found = np.flatnonzero(where[after:])
    return float(time_s[after + found[0]]) if len(found) else "never"


def _since(at: float | str, begun: float) -> float | str:
    return at - float(begun) if isinstance(at, float) else at
