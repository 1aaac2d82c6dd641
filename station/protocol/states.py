"""Table of allowed state transitions; the states in which a verb is allowed are in `protocol.verbs`.

    disconnected ──> idle ──go──> checking ──> moving ──> settling ──> capturing ──> writing
                      ^  ^                       ^            pose by pose            │
                      │  └──── sealing <─────────┴────────────────────────────────────┤
                      └── acknowledge ── stopped, fault          paused <─────────────┘

`moving` is entered from rest by an approval only, through `checking`. `stopped` and `fault` are left by a
person's acknowledgement and, `fault`, by STOP. A stop test leads from `moving` to `idle`.
"""

from __future__ import annotations

from station.cell.status import StationState as S

LATCHED = frozenset({S.STOPPED, S.FAULT})

TRANSITIONS: dict[S, frozenset[S]] = {
    S.DISCONNECTED: frozenset({S.IDLE, S.PAUSED}) | LATCHED,
    S.IDLE: frozenset({S.CHECKING, S.FREE_DRIVE, S.PAUSED, S.DISCONNECTED}) | LATCHED,
    S.CHECKING: frozenset({S.MOVING, S.IDLE, S.PAUSED, S.SEALING}) | LATCHED,
    S.MOVING: frozenset({S.SETTLING, S.PAUSED, S.IDLE, S.SEALING}) | LATCHED,
    S.SETTLING: frozenset({S.CAPTURING, S.MOVING, S.PAUSED, S.SEALING, S.FREE_DRIVE}) | LATCHED,
    S.CAPTURING: frozenset({S.WRITING, S.SETTLING, S.MOVING, S.PAUSED, S.SEALING, S.FREE_DRIVE}) | LATCHED,
    S.WRITING: frozenset({S.SETTLING, S.MOVING, S.PAUSED, S.SEALING, S.FREE_DRIVE}) | LATCHED,
    S.SEALING: frozenset({S.IDLE, S.PAUSED}) | LATCHED,
    S.PAUSED: frozenset({S.CHECKING, S.SEALING, S.FREE_DRIVE, S.IDLE}) | LATCHED,
    S.STOPPED: frozenset({S.IDLE, S.PAUSED, S.DISCONNECTED}),
    S.FAULT: frozenset({S.IDLE, S.PAUSED, S.DISCONNECTED, S.STOPPED}),
    S.FREE_DRIVE: frozenset({S.SETTLING, S.PAUSED, S.IDLE, S.SEALING}) | LATCHED,
}

RUNNING = frozenset({S.CHECKING, S.MOVING, S.SETTLING, S.CAPTURING, S.WRITING})
"""States during an approved motion, in which the control process may run and heartbeats are sent."""
RESTING = frozenset({S.IDLE, S.PAUSED})


class TransitionError(Exception):
    """Transition that the table does not allow: a defect of the program."""


def check_transition(old: S, new: S) -> None:
    if new not in TRANSITIONS[old]:
        raise TransitionError(f"the station may not go from {old.value} to {new.value}")
