"""Cause of an ended move or control program: what the driver saw first is often only a consequence.

A safety stop, lost power or another client's program shows in states that come after the end; what was late
shows in the arrivals of states and in the resets of the watchdog before it.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Sequence
from itertools import pairwise

from recordings.schema.messages import RobotState
from station.cell.errors import RobotError, SafetyStopError, StaleStateError
from station.devices.news import RESTING_S, Evidence, longest_silence_s
from station.devices.rtde import RuntimeState
from station.devices.ur.child import ControlChild
from station.devices.ur.condition import arm_held, program_ended
from station.devices.ur.link import UrLink
from station.devices.ur.stream import POLL_S

OUTLIVED_S = 0.6
"""If the control program still plays so long after a pause of this computer began, that pause did not stop
it: its watchdog waits 0.2 s, then it brakes for up to 0.26 s."""
OUR_PROGRAMS = ("rtde_control", "station_control")
REPLACED_S = 0.1
"""Time after the end of our program within which another one that replaced it starts to play."""
MAY_BE_REPLACED = ("program-ended", "watchdog", "off-path", "ended-short", "no-progress")
NEWS_WAIT_S = 0.25
"""Longest wait, after the control program ended, for a state that may tell why."""
REMOTE_WAIT_S = 0.3
"""Longest wait for the dashboard to say whether remote control is on."""


async def cause_of_end(link: UrLink, child: ControlChild, error: RobotError) -> RobotError:
    """Find the cause behind `error`, which ended a move or control; waits for states, at most `RESTING_S`."""
    if isinstance(error, SafetyStopError) or error.code == "stopped":
        return error
    begun_s, late = time.monotonic(), error.code == StaleStateError.code
    ended = error.code in ("program-ended", "watchdog")
    after = await link.states.state_after(begun_s, RESTING_S if late else NEWS_WAIT_S if ended else 0.0)
    states = link.states.history()
    if states and (held := arm_held(states[-1])) is not None:
        return held
    if link.remote and link.dashboard is not None:
        with contextlib.suppress(RobotError, TimeoutError):
            async with asyncio.timeout(REMOTE_WAIT_S):
                link.remote = await link.dashboard.remote()
    if link.remote is False:
        return RobotError("local-control")
    if error.code in MAY_BE_REPLACED:
        other = await _other_program(link, child.started_s, REPLACED_S if ended else 0.0)
        if other is not None:
            return RobotError("program-replaced", program=other, called=f" ({other})" if other else "")
    if late and after is not None:
        return link.states.evidence(0.0, begun_s - OUTLIVED_S, time.monotonic()).error() or error
    if not ended:
        return error
    if any(
        state.runtime_state in (RuntimeState.PAUSING, RuntimeState.PAUSED)
        for state in states
        if state.stamps.host_monotonic_ns > child.started_s * 1e9
    ):  # a watchdog ends a program; only a person pauses it
        return program_ended(RuntimeState.PAUSED)
    delayed = _evidence_of_end(link, child, states).error()
    return delayed or (program_ended(RuntimeState.STOPPED) if error.code == "watchdog" else error)


def _evidence_of_end(link: UrLink, child: ControlChild, states: Sequence[RobotState]) -> Evidence:
    """Measure what was late before the control program ended."""
    until_s = _program_end_s(states, child.started_s) or time.monotonic()
    since_s = until_s - OUTLIVED_S
    return link.states.evidence(longest_silence_s(child.kicks_s, since_s, until_s), since_s, until_s)


def _program_end_s(states: Sequence[RobotState], since_s: float) -> float | None:
    """Find when a program stopped playing first, after `since_s` (host monotonic); None: it plays."""
    for before, state in pairwise(states):
        at_s = state.stamps.host_monotonic_ns / 1e9
        playing = RuntimeState.PLAYING
        if at_s > since_s and before.runtime_state == playing != state.runtime_state:
            return at_s
    return None


async def _other_program(link: UrLink, since_s: float, wait_s: float) -> str | None:
    """Find a program of another client that started after ours: its name, '' if unnamed, None if none.

    Our own stop may already have ended it.
    """
    give_up_s = time.monotonic() + wait_s
    while True:
        if (name := link.tool.program_started) and name not in OUR_PROGRAMS:
            return name
        states = link.states.history()
        ended = _program_end_s(states, since_s) is not None
        if not name and ended and states[-1].runtime_state == RuntimeState.PLAYING:
            return ""
        if time.monotonic() > give_up_s:
            return None
        await asyncio.sleep(POLL_S)
