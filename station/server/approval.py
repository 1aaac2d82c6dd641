"""Permission to approve motion: decided by the daemon from the kernel's word and its configuration.

What a client says of itself counts for nothing here. A person counts as present when the client is in the
foreground of a terminal that its user owns; what that proves and what it does not: docs/operator/safety.md.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from station.cell.config import ApprovalConfig
from station.cell.errors import RefusedError


@dataclass(frozen=True)
class Process:
    """A client's process as /proc shows it."""

    user: int
    began_ticks: int
    """Since the computer's start; another process with the same number began later."""
    terminal: str
    """'pts/3' when it is in the foreground of its terminal; empty: nobody sees what it shows."""


def process(pid: int) -> Process | None:
    """None when it ended, or when this process may not see it (systemd: ProtectProc=)."""
    try:
        place = Path(f"/proc/{pid}")
        user = place.stat().st_uid
        # proc(5), after the name: state, ppid, pgrp, session, tty_nr, tpgid, …, starttime
        fields = (place / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    group, terminal, foreground = int(fields[2]), int(fields[4]), int(fields[5])
    shown = terminal != 0 and group == foreground
    return Process(user, int(fields[19]), _terminal_name(terminal) if shown else "")


def _terminal_name(number: int) -> str:
    major, minor = os.major(number), os.minor(number)
    if 136 <= major <= 143:  # Unix98 pseudo terminals
        return f"pts/{(major - 136) * 256 + minor}"
    if major == 4:
        return f"tty{minor}" if minor < 64 else f"ttyS{minor - 64}"
    return f"terminal {major}:{minor}"


@dataclass
class Peer:
    """Process at the other end, by the kernel's word, and what is known of it when it asks for motion."""

    client_id: int
    """0: it sent STOP without a connection."""
    pid: int
    uid: int
    told: str = ""
    """Name that it gave."""
    user: str = ""
    """The user's name, once that was looked up."""
    began_ticks: int | None = None
    """Start of the process that made the connection; None: not known."""

    @property
    def who(self) -> str:
        """Its name in log, status and recording."""
        return f"{self.told or f'uid {self.uid}'} (pid {self.pid})"


class ApprovalRule:
    """`see`: looks a process up."""

    def __init__(
        self, config: ApprovalConfig, simulated: bool, see: Callable[[int], Process | None] = process
    ) -> None:
        self._config, self._simulated, self._see = config, simulated, see

    def by_person(self, asks: Peer, what: str) -> str:
        """Returns how a person approves, for the log. RefusedError unless a person may approve it there."""
        if self._simulated:
            return "a simulated cell"
        if terminal := self._terminal(asks):
            self._require_permitted(asks)
            return f"at {terminal}"
        raise RefusedError(
            f"{what} needs a person at a terminal.",
            code="no-terminal",
            remedy="A person must review and approve it there (docs: Safety).",
        )

    def approve(self, asks: Peer, plan_sha256: str, offered_sha256: str) -> str:
        """Like `by_person`; a service named in the configuration may approve the plan whose hash it knows."""
        if plan_sha256 and offered_sha256 and plan_sha256 != offered_sha256:
            raise RefusedError("The approved plan is not the one that is loaded.", code="other-plan")
        if self._simulated or self._terminal(asks):
            return self.by_person(asks, "A move")
        if asks.user not in self._config.services:
            raise RefusedError(
                f"{asks.user} has no terminal here and is no service in approval.services.",
                code="no-terminal",
                remedy="A person must review and approve the plan (docs: Safety).",
            )
        if not plan_sha256:
            text = f"The service {asks.user} must name the plan that a person approved."
            raise RefusedError(text, code="no-plan-named")
        return "as a service, by the plan's hash"

    def _terminal(self, asks: Peer) -> str:
        seen = self._see(asks.pid)
        if seen is None or seen.user != asks.uid or seen.began_ticks != asks.began_ticks:
            return ""
        return seen.terminal

    def _require_permitted(self, asks: Peer) -> None:
        if self._config.persons and asks.user not in self._config.persons:
            text = f"{asks.user} is not in approval.persons."
            raise RefusedError(text, code="not-permitted", remedy="Ask one of approval.persons to approve.")
