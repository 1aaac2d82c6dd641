"""The judge of the acceptance test: the samples of one stopped move → its figures against limits.

A pure function of what the controller told. Times are the controller's own; the moment of the stop, in host
time, is placed in them by the quickest sample of the trace (RTDE's delay is never negative).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrate.geometry import Array
from recordings.schema.messages import RobotState
from station.cell.acceptance import Figure, StopWay

RESTING_RAD_S = 0.01
"""An arm slower than this rests: joint speeds of a resting UR read up to some mrad/s."""
REST_S = 0.1
"""For so long, before it counts as rest."""
SLOWER = 0.9
"""Share of its speed below which the arm obeys."""
WINDOW_S = 0.02
"""Decelerations are means over this time: single differences at 500 Hz are noise."""
BRAKING_RAD_S2 = 2.0
WATCHED_S = 1.0
"""For so long it is watched at rest."""
CONTROLLER_S = 0.05
RUNNING, SAFE_MODES, SAFE_BITS = 7, (1, 2), 0b11
"""RTDE guide: robot_mode 7 running, safety_mode 1 normal, 2 reduced, safety_status_bits 0 and 1 the same."""

_STOP_RULE = "STOP leaves within 0.1 s (design), the controller acts within 0.05 s"
_WATCHDOG_RULE = "0.2 s watchdog, kicked by a heartbeat of at most 0.1 s age, and 0.05 s for the controller"
REACTION_S: dict[StopWay, tuple[float, str]] = {
    StopWay.CONTROL: (0.1 + CONTROLLER_S, _STOP_RULE),
    StopWay.DASHBOARD: (0.1 + CONTROLLER_S, _STOP_RULE),
    StopWay.BOTH: (0.1 + CONTROLLER_S, _STOP_RULE),
    StopWay.KILLED: (0.2 + CONTROLLER_S, "0.2 s watchdog, whatever else stops it, and 0.05 s"),
    StopWay.FROZEN: (0.3 + CONTROLLER_S, _WATCHDOG_RULE),
    StopWay.NETWORK: (0.3 + CONTROLLER_S, _WATCHDOG_RULE),
}
"""Longest time until the arm is slower, and why."""
_BRAKES = "brakes with at least 2 rad/s², half of what the station asks for"
ABRUPT = 8.0, "twice the 4 rad/s² that the station asks for"
REPEATS_RAD = 0.001, "ten times a UR's repeatability (0.1 mm at 1.3 m)"
BACK_RAD = 0.002, "twenty times a UR's repeatability"
ARRIVED_RAD = 0.01, "the station's own word for arrived"
GAP_S = 0.04, "five cycles of a CB3: what falls between is not judged"
CUT_S = 1.0, "the watchdog must end the move while the network is cut"
SLIDER_UP_S = 1.5, "it is watched after the slider was raised"


@dataclass(frozen=True)
class StopMove:
    """The move that was approved, and what was to end it."""

    way: StopWay
    joint: int
    """Number of the joint that moves, from 0."""
    target_rad: float
    """Goal of that joint."""
    speed_rad_s: float
    """Planned speed of that joint."""
    moment_ns: int | None = None
    """Time of the stop (host monotonic); None: it is found in the trace."""


@dataclass(frozen=True, eq=False)
class Curve:
    """Motion of the joint that moved, for the judge and for the report."""

    time_s: Array
    """(n,) the controller's, 0 at the moment of the stop"""
    angle_rad: Array
    """(n,) from where it began, in the direction of the move"""
    speed_rad_s: Array
    """(n,) along the same"""


class Trace:
    """Samples of one move as arrays; n of them."""

    def __init__(self, states: Sequence[RobotState], move: StopMove) -> None:
        self.move = move
        self.time_s = np.array([s.stamps.controller_s for s in states])
        host_s = np.array([s.stamps.host_monotonic_ns for s in states]) / 1e9
        self.ahead_s = float(np.min(host_s - self.time_s)) if len(states) else 0.0
        self.joints = np.array([s.joints_rad for s in states]).reshape(-1, 6)
        self.speeds = np.array([s.joint_speeds_rad_s for s in states]).reshape(-1, 6)
        self.slider = np.array([s.target_speed_fraction for s in states])
        self.held = np.array([_held(s) for s in states], dtype=bool)
        self.direction = float(np.sign(move.target_rad - self.joints[0, move.joint])) if len(states) else 1.0
        gaps = np.diff(self.time_s)
        self.widest = int(np.argmax(gaps)) if len(gaps) else 0
        """The sample before the longest gap."""
        self.gap_s = float(gaps.max(initial=0.0))

    @property
    def fastest(self) -> Array:
        """(n,) rad/s of the fastest joint."""
        return np.asarray(np.abs(self.speeds).max(axis=1, initial=0.0))

    @property
    def moment_s(self) -> float:
        """Time of the stop on the controller's clock."""
        if self.move.moment_ns is not None:
            return self.move.moment_ns / 1e9 - self.ahead_s
        if self.move.way is StopWay.NETWORK:
            return float(self.time_s[self.widest])
        return float(self.time_s[-1])

    def curve(self) -> Curve:
        joint = self.move.joint
        gone = self.direction * (self.joints[:, joint] - self.joints[0, joint])
        return Curve(self.time_s - self.moment_s, gone, self.direction * self.speeds[:, joint])


def judge(states: Sequence[RobotState], move: StopMove) -> tuple[Figure, ...]:
    """All figures of this move. No samples, or none where they are needed, is a failed figure too."""
    figures = [Figure("samples", len(states), "", 50, "fewer tell nothing", least=True)]
    if len(states) < 50:
        return tuple(figures)
    trace = Trace(states, move)
    if move.way is not StopWay.NETWORK:
        figures.append(Figure("longest gap", trace.gap_s, "s", *GAP_S))
    figures.append(Figure("held by safety", float(trace.held.sum()), "samples", 0, "no stop may end in one"))
    top = float(np.abs(trace.speeds).max())
    figures.append(
        Figure("top speed", top, "rad/s", 1.1 * move.speed_rad_s + RESTING_RAD_S, "10 % above the approved")
    )
    if move.way is StopWay.SLIDER:
        figures += _slider(trace)
    elif move.way is StopWay.ARRIVE:
        short = float(abs(trace.joints[-1, move.joint] - move.target_rad))
        figures += [Figure("short of the target", short, "rad", *ARRIVED_RAD), *_after_rest(trace, 0)]
    else:
        figures += _stop(trace)
    return tuple(figures)


def _held(state: RobotState) -> bool:
    """Any of the fields that can tell it: a controller may tell in one only."""
    unsafe = state.safety_mode not in SAFE_MODES or bool(state.safety_status_bits & ~SAFE_BITS)
    return unsafe or state.robot_mode != RUNNING


def _stop(trace: Trace) -> list[Figure]:
    move, fastest = trace.move, trace.fastest
    cut = move.way is StopWay.NETWORK
    moment = min(int(np.searchsorted(trace.time_s, trace.moment_s)), len(fastest) - 1)
    speed = float(fastest[max(0, moment - 2) : moment + 1].max())
    slow = 0.5 * move.speed_rad_s
    figures = [
        Figure("speed at the stop", speed, "rad/s", slow, "half of the planned one: it moved", least=True)
    ]
    reaction_s, why = REACTION_S[move.way]
    after = fastest[moment + cut :]
    obeyed = np.flatnonzero(after < max(SLOWER * speed, RESTING_RAD_S))
    obeyed_s = float(trace.time_s[moment + cut + obeyed[0]] - trace.moment_s) if len(obeyed) else None
    rest = rest_index(trace.time_s, fastest, moment + cut)
    rest_s = float(trace.time_s[rest] - trace.moment_s) if rest is not None else None
    if cut:
        figures.append(Figure("cut", trace.gap_s, "s", *CUT_S, least=True))
    else:
        figures.append(Figure("reaction", obeyed_s, "s", reaction_s, why))
        limit_s = reaction_s + speed / BRAKING_RAD_S2 + CONTROLLER_S
        figures.append(Figure("rest", rest_s, "s", limit_s, f"the reaction's limit, then {_BRAKES}"))
        figures.append(Figure("deceleration", _deceleration(trace, moment), "rad/s²", *ABRUPT))
    limit_rad = speed * reaction_s + speed**2 / (2 * BRAKING_RAD_S2) + BACK_RAD[0]
    gone = np.abs(trace.joints[moment:] - trace.joints[moment]).max(axis=1)
    source = f"{speed:.2f} rad/s for the reaction's limit, then {_BRAKES}"
    figures.append(Figure("distance", float(gone.max()), "rad", limit_rad, source))
    if rest is not None:
        figures += _after_rest(trace, rest)
    return figures


def rest_index(time_s: Array, fastest: Array, start: int) -> int | None:
    """The first sample from which on the arm rests for `REST_S`; None: it does not."""
    moving = np.flatnonzero(fastest[start:] >= RESTING_RAD_S) + start
    ends = np.concatenate([[start], moving + 1])
    following = np.concatenate([moving, [len(fastest)]])
    for begin, end in zip(ends, following, strict=True):
        if begin < end and time_s[end - 1] - time_s[begin] >= REST_S:
            return int(begin)
    return None


def _deceleration(trace: Trace, moment: int) -> float:
    """Largest mean loss of speed of the fastest joint over `WINDOW_S` after the stop, rad/s²."""
    time_s, fastest = trace.time_s[moment:], trace.fastest[moment:]
    later = np.searchsorted(time_s, time_s + WINDOW_S - 1e-6)
    found = later < len(time_s)
    begin = np.flatnonzero(found)
    end = later[found]
    loss = (fastest[begin] - fastest[end]) / (time_s[end] - time_s[begin])
    return float(loss.max(initial=0.0))


def _after_rest(trace: Trace, rest: int) -> list[Figure]:
    """Judge that it neither swings back nor drifts nor goes on, for as long as it is watched."""
    if trace.move.way is StopWay.ARRIVE:
        found = rest_index(trace.time_s, trace.fastest, int(np.argmax(trace.fastest)))
        rest = len(trace.time_s) - 1 if found is None else found
    watched_s = float(trace.time_s[-1] - trace.time_s[rest])
    settled = min(int(np.searchsorted(trace.time_s, trace.time_s[rest] + REST_S)), len(trace.time_s) - 1)
    drift = float(np.abs(trace.joints[settled:] - trace.joints[settled]).max())
    gone = trace.curve().angle_rad
    back = float(gone[: settled + 1].max() - gone[settled])
    return [
        Figure("watched at rest", watched_s, "s", WATCHED_S, "shorter tells no drift", least=True),
        Figure("back after the stop", back, "rad", *BACK_RAD),
        Figure("drift at rest", drift, "rad", *REPEATS_RAD),
    ]


def _slider(trace: Trace) -> list[Figure]:
    """The arm stands while the slider does, and after it was raised."""
    still = trace.slider <= 0.005
    up = np.flatnonzero(~still)
    raised_s = 0.0
    if still.any() and len(up) and up[-1] > np.flatnonzero(still)[0]:
        raised_s = float(trace.time_s[-1] - trace.time_s[up[up > np.flatnonzero(still)[0]][0]])
    moved = float(np.abs(trace.joints - trace.joints[0]).max())
    return [
        Figure("slider raised", raised_s, "s", *SLIDER_UP_S, least=True),
        Figure("moved", moved, "rad", *REPEATS_RAD),
    ]
