"""The one table of what may follow what, and of what a person may ask for in which state.

    disconnected ──> idle ──go──> checking ──> moving ──> settling ──> capturing ──> writing
                      ^  ^                       ^            pose by pose            │
                      │  └──── sealing <─────────┴────────────────────────────────────┤
                      └── acknowledge ── stopped, fault          paused <─────────────┘

The only way into `moving` from rest is a go, through `checking`; the only ways out of `stopped` and `fault`
are a person's acknowledgement and, from `fault`, STOP. A verification hover goes from `moving` to `idle`.
"""

from __future__ import annotations

from station.cell.status import StationState as S
from station.protocol.messages import Verb

_STOPS = frozenset({S.STOPPED, S.FAULT})

TRANSITIONS: dict[S, frozenset[S]] = {
    S.DISCONNECTED: frozenset({S.IDLE, S.PAUSED}) | _STOPS,
    S.IDLE: frozenset({S.CHECKING, S.FREE_DRIVE, S.DISCONNECTED}) | _STOPS,
    S.CHECKING: frozenset({S.MOVING, S.IDLE, S.PAUSED, S.SEALING}) | _STOPS,
    S.MOVING: frozenset({S.SETTLING, S.PAUSED, S.IDLE, S.SEALING}) | _STOPS,
    S.SETTLING: frozenset({S.CAPTURING, S.MOVING, S.PAUSED, S.SEALING, S.FREE_DRIVE}) | _STOPS,
    S.CAPTURING: frozenset({S.WRITING, S.SETTLING, S.MOVING, S.PAUSED, S.SEALING, S.FREE_DRIVE}) | _STOPS,
    S.WRITING: frozenset({S.SETTLING, S.MOVING, S.PAUSED, S.SEALING, S.FREE_DRIVE}) | _STOPS,
    S.SEALING: frozenset({S.IDLE, S.PAUSED}) | _STOPS,
    S.PAUSED: frozenset({S.CHECKING, S.SEALING, S.FREE_DRIVE, S.IDLE}) | _STOPS,
    S.STOPPED: frozenset({S.IDLE, S.PAUSED, S.DISCONNECTED}),
    S.FAULT: frozenset({S.IDLE, S.PAUSED, S.DISCONNECTED, S.STOPPED}),
    S.FREE_DRIVE: frozenset({S.SETTLING, S.PAUSED, S.IDLE, S.SEALING}) | _STOPS,
}

RUNNING = frozenset({S.CHECKING, S.MOVING, S.SETTLING, S.CAPTURING, S.WRITING})
"""A go is being carried out: the control child may live, heartbeats flow."""
_RESTING = frozenset({S.IDLE, S.PAUSED})
_ANY = frozenset(S)

VERB_STATES: dict[Verb, frozenset[S]] = {
    "hello": _ANY,
    "watch": _ANY,
    "part": _ANY,
    "whole": _ANY,
    "lease": _ANY,
    "stop": _ANY,
    "acknowledge": _STOPS,
    "plan": _ANY,
    "load_plan": frozenset({S.IDLE, S.DISCONNECTED}),
    "make_plan": frozenset({S.IDLE, S.DISCONNECTED}),
    "prepare": _RESTING,
    "hover": _RESTING,
    "go": _RESTING,
    "pause": RUNNING,
    "finish": RUNNING | {S.PAUSED, S.FREE_DRIVE},
    "retake": RUNNING | _RESTING,
    "skip": RUNNING | _RESTING,
    "reorder": _RESTING,
    "add": _RESTING,
    "drop": RUNNING | _RESTING,
    "free_drive": _RESTING | {S.FREE_DRIVE},
    "record": frozenset({S.FREE_DRIVE}),
    "preview": _ANY,
    "doctor": _ANY,
    "sessions": _ANY,
}

_REMEDIES: dict[S, str] = {
    S.DISCONNECTED: "the robot is not connected: `station doctor` says why",
    S.STOPPED: "STOP is latched: look at the cell, then acknowledge",
    S.FAULT: "there is a fault: read it, look at the cell, then acknowledge",
    S.SEALING: "the recording is being sealed: wait a moment",
    S.IDLE: "no session is running",
    S.PAUSED: "the session is paused",
    S.FREE_DRIVE: "the arm is in free drive: end it first",
}


class TransitionError(Exception):
    """A step that the table does not know: a defect of the program, never of a person."""


def check_transition(old: S, new: S) -> None:
    if new not in TRANSITIONS[old]:
        raise TransitionError(f"the station may not go from {old.value} to {new.value}")


_SAID: dict[Verb, str] = {"prepare": "a go", "make_plan": "a new plan", "load_plan": "another plan"}
"""What a person asked for, where the verb is the program's own."""


def refusal(verb: Verb, state: S) -> str:
    """Why `verb` is not possible now, as a sentence for people; empty when it is."""
    if state in VERB_STATES[verb]:
        return ""
    reason = _REMEDIES.get(state, f"the session is {state.value}: pause or stop it first")
    if verb == "acknowledge":
        reason = "nothing is stopped"
    return f"{_SAID.get(verb, verb.replace('_', ' '))} is not possible now: {reason}"
