"""Traces of a controller in the scenarios of `ur_trace_scenarios`: file, figures, comparison."""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from calibrate.geometry import Array
from station.cell.errors import RobotError
from station.devices.rtde import RuntimeState

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
