"""Evaluation of a stop in the acceptance test: from the states of one move to figures with limits.

Pure functions of the controller's states. Times are on the controller's clock; the time of the stop is
converted from host time by the state that arrived with the least delay.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from recordings.geometry import Array
from recordings.schema.messages import RobotState
from station.cell.arm_acceptance import Figure, StopTestMove, StopWay
from station.cell.stillness import RESTING_RAD_S

REST_S = 0.1
"""Time for which the arm must be slower than `RESTING_RAD_S` to count as at rest."""
SLOWER = 0.9
"""Share of the speed below which the arm counts as having reacted to the stop."""
WINDOW_S = 0.02
"""Time over which decelerations are averaged, as single differences at 500 Hz are noise."""
BRAKING_RAD_S2 = 2.0
WATCHED_S = 1.0
"""Time for which the resting arm is observed after the stop."""
CONTROLLER_S = 0.05
RUNNING, SAFE_MODES, SAFE_BITS = 7, (1, 2), 0b11
"""RTDE guide: robot_mode 7 running, safety_mode 1 normal, 2 reduced, safety_status_bits 0 and 1 the same."""

_STOP_RULE = "STOP leaves within 0.1 s (design), the controller acts within 0.05 s"
_WATCHDOG_RULE = "0.2 s watchdog, kicked by a heartbeat of at most 0.1 s age, and 0.05 s for the controller"
REACTION_S: dict[StopWay, tuple[float, str]] = {
    StopWay.CONTROL: (0.1 + CONTROLLER_S, _STOP_RULE),
    StopWay.DASHBOARD: (0.1 + CONTROLLER_S, _STOP_RULE),
    StopWay.KILLED: (0.2 + CONTROLLER_S, "0.2 s watchdog, whatever else stops it, and 0.05 s"),
    StopWay.FROZEN: (0.3 + CONTROLLER_S, _WATCHDOG_RULE),
}
"""Longest time until the arm reacts, and the reason for this limit."""
_BRAKES = "brakes with at least 2 rad/s², half of what the station asks for"
ABRUPT = 8.0, "twice the 4 rad/s² that the station asks for"
REPEATS_RAD = 0.001, "ten times a UR's repeatability (0.1 mm at 1.3 m)"
BACK_RAD = 0.002, "twenty times a UR's repeatability"
GAP_S = 0.04
"""Longest gap between states with which a stop counts as measured: five cycles of a CB3."""
FEWEST_SAMPLES = 50


class Trace:
    """States of one move as arrays of n ≥ 1 samples."""

    def __init__(self, states: Sequence[RobotState], move: StopTestMove, moment_ns: int | None) -> None:
        self.move, self.moment_ns = move, moment_ns
        self.time_s = np.array([s.stamps.controller_s for s in states])
        host_s = np.array([s.stamps.host_monotonic_ns for s in states]) / 1e9
        self.ahead_s = float(np.min(host_s - self.time_s))
        self.joints = np.array([s.joints_rad for s in states]).reshape(-1, 6)
        self.speeds = np.array([s.joint_speeds_rad_s for s in states]).reshape(-1, 6)
        self.held = np.array([_held(s) for s in states], dtype=bool)
        self.direction = float(np.sign(move.target_rad - self.joints[0, move.joint]))
        self.gap_s = float(np.diff(self.time_s).max(initial=0.0))

    @property
    def fastest(self) -> Array:
        """Speed (n,) of the fastest joint, rad/s."""
        return np.asarray(np.abs(self.speeds).max(axis=1, initial=0.0))

    @property
    def moment_s(self) -> float:
        """Time of the stop on the controller's clock."""
        if self.moment_ns is None:
            return float(self.time_s[-1])
        return self.moment_ns / 1e9 - self.ahead_s


def judge(
    states: Sequence[RobotState], move: StopTestMove, moment_ns: int | None
) -> tuple[tuple[Figure, ...], str]:
    """Compute all figures of a move, or say why it was not measured.

    `moment_ns`: time of the stop (host monotonic); None: it was not triggered.

    A safety stop and too high a speed fail even if the states have gaps, as gaps cannot cause them.
    """
    if len(states) < FEWEST_SAMPLES:
        return (), f"{len(states)} samples of the arm came (≥ {FEWEST_SAMPLES})"
    trace = Trace(states, move, moment_ns)
    top = float(np.abs(trace.speeds).max())
    always = (
        Figure("held by safety", float(trace.held.sum()), "samples", 0, "no stop may end in one"),
        Figure("top speed", top, "rad/s", 1.1 * move.speed_rad_s + RESTING_RAD_S, "10 % above the approved"),
    )
    moment = min(int(np.searchsorted(trace.time_s, trace.moment_s)), len(trace.time_s) - 1)
    rest = rest_index(trace.time_s, trace.fastest, moment)
    if why := _not_measured(trace, moment, rest):
        failed = tuple(figure for figure in always if not figure.passed)
        return failed, "" if failed else why
    return (*always, *_stop(trace, moment, rest)), ""


def _not_measured(trace: Trace, moment: int, rest: int | None) -> str:
    """Say why the stop of this move was not measured; empty: it was."""
    move = trace.move
    if trace.gap_s > GAP_S:
        return f"no news of the arm for {trace.gap_s:.3f} s (≤ {GAP_S:g}): computer or network is busy"
    speed = _speed_at(trace, moment)
    if trace.moment_ns is None or speed < 0.5 * move.speed_rad_s:
        return f"the arm turned with {speed:.2f} of {move.speed_rad_s:.2f} rad/s when it was stopped"
    if rest is not None and (watched_s := float(trace.time_s[-1] - trace.time_s[rest])) < WATCHED_S:
        return f"the arm was watched at rest for {watched_s:.1f} s (≥ {WATCHED_S:g})"
    return ""


def _speed_at(trace: Trace, moment: int) -> float:
    return float(trace.fastest[max(0, moment - 2) : moment + 1].max())


def _held(state: RobotState) -> bool:
    """Tell whether safety holds the arm, by any of the fields that may show it."""
    unsafe = state.safety_mode not in SAFE_MODES or bool(state.safety_status_bits & ~SAFE_BITS)
    return unsafe or state.robot_mode != RUNNING


def _stop(trace: Trace, moment: int, rest: int | None) -> list[Figure]:
    fastest, speed = trace.fastest, _speed_at(trace, moment)
    reaction_s, why = REACTION_S[trace.move.way]
    obeyed = np.flatnonzero(fastest[moment:] < max(SLOWER * speed, RESTING_RAD_S))
    obeyed_s = float(trace.time_s[moment + obeyed[0]] - trace.moment_s) if len(obeyed) else None
    rest_s = float(trace.time_s[rest] - trace.moment_s) if rest is not None else None
    limit_s = reaction_s + speed / BRAKING_RAD_S2 + CONTROLLER_S
    limit_rad = speed * reaction_s + speed**2 / (2 * BRAKING_RAD_S2) + BACK_RAD[0]
    gone = np.abs(trace.joints[moment:] - trace.joints[moment]).max(axis=1)
    source = f"{speed:.2f} rad/s for the reaction's limit, then {_BRAKES}"
    figures = [
        Figure("reaction", obeyed_s, "s", reaction_s, why),
        Figure("rest", rest_s, "s", limit_s, f"the reaction's limit, then {_BRAKES}"),
        Figure("deceleration", _deceleration(trace, moment), "rad/s²", *ABRUPT),
        Figure("distance", float(gone.max()), "rad", limit_rad, source),
    ]
    return figures if rest is None else [*figures, *_after_rest(trace, rest)]


def rest_index(time_s: Array, fastest: Array, start: int) -> int | None:
    """Find the first sample from which the arm rests for `REST_S`; None: there is none."""
    moving = np.flatnonzero(fastest[start:] >= RESTING_RAD_S) + start
    ends = np.concatenate([[start], moving + 1])
    following = np.concatenate([moving, [len(fastest)]])
    for begin, end in zip(ends, following, strict=True):
        if begin < end and time_s[end - 1] - time_s[begin] >= REST_S:
            return int(begin)
    return None


def _deceleration(trace: Trace, moment: int) -> float:
    """Compute the largest deceleration of the fastest joint, over `WINDOW_S`, after the stop, rad/s²."""
    time_s, fastest = trace.time_s[moment:], trace.fastest[moment:]
    later = np.searchsorted(time_s, time_s + WINDOW_S - 1e-6)
    found = later < len(time_s)
    begin = np.flatnonzero(found)
    end = later[found]
    loss = (fastest[begin] - fastest[end]) / (time_s[end] - time_s[begin])
    return float(loss.max(initial=0.0))


def _after_rest(trace: Trace, rest: int) -> list[Figure]:
    """Judge whether the arm swings back, drifts or moves on after its rest."""
    settled = min(int(np.searchsorted(trace.time_s, trace.time_s[rest] + REST_S)), len(trace.time_s) - 1)
    drift = float(np.abs(trace.joints[settled:] - trace.joints[settled]).max())
    gone = trace.direction * trace.joints[:, trace.move.joint]
    back = float(gone[: settled + 1].max() - gone[settled])
    return [
        Figure("back after the stop", back, "rad", *BACK_RAD),
        Figure("drift at rest", drift, "rad", *REPEATS_RAD),
    ]
