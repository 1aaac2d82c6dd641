"""Permission to approve motion, decided from what the kernel tells of a client and from the configuration.

What a client says of itself does not count. A person counts as present when the client is in the foreground
of a terminal and belongs to no system service, which could open a terminal of its own. What that proves and
what it does not: docs/operator/safety.md.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from station.cell.config import ApprovalConfig
from station.cell.errors import RefusedError
from station.server.control_group import system_service


@dataclass(frozen=True)
class Process:
    """Process of a client, from /proc."""

    user: int
    began_ticks: int
    """Start since boot, in clock ticks: tells apart processes that have the same number one after another."""
    terminal: str
    """Terminal in whose foreground it is, such as 'pts/3'; empty: none."""
    parent: int = 0
    """Process that started it; that of a screen is in the person's terminal (`tui.stop_key`)."""
    service: str = ""
    """System service that it belongs to, such as 'calibrate@s-1.service'; empty: none, or it is not known."""


def process(pid: int) -> Process | None:
    """Look a process up; None when it ended, or may not be seen (systemd: ProtectProc=)."""
    try:
        place = Path(f"/proc/{pid}")
        user = place.stat().st_uid
        # proc(5), after the name: state, ppid, pgrp, session, tty_nr, tpgid, …, starttime
        # A program's name may be cut within a letter.
        words = (place / "stat").read_text(errors="replace").rpartition(")")[2].split()
        parent, group, terminal, foreground, began = (int(words[i]) for i in (1, 2, 4, 5, 19))
    except (OSError, ValueError, IndexError):  # STOP never waits for a name
        return None
    shown = terminal != 0 and group == foreground
    return Process(user, began, _terminal_name(terminal) if shown else "", parent, system_service(pid))


def _terminal_name(number: int) -> str:
    major, minor = os.major(number), os.minor(number)
    if 136 <= major <= 143:  # Unix98 pseudo terminals
        return f"pts/{(major - 136) * 256 + minor}"
    if major == 4:
        return f"tty{minor}" if minor < 64 else f"ttyS{minor - 64}"
    return f"terminal {major}:{minor}"


def place_text(terminal: str) -> str:
    """Say where a terminal is, as a person would: 'terminal window 3' of pts/3, 'console 1' of tty1."""
    kind, _, number = terminal.partition("/")
    if kind == "pts":
        return f"terminal window {number}"
    if terminal.startswith("ttyS"):
        return f"serial console {terminal.removeprefix('ttyS')}"
    if terminal.startswith("tty"):
        return f"console {terminal.removeprefix('tty')}"
    return terminal


@dataclass
class Peer:
    """Client process of a connection, as the kernel tells of it."""

    client_id: int
    """Number of the connection; 0: it sent STOP without one."""
    pid: int
    uid: int
    user: str = ""
    """Name of the user; empty until it is looked up."""
    terminal: str = ""
    """Terminal at which its person was seen when it first asked; empty: none."""
    began_ticks: int | None = None
    """Start of the process that made the connection; None: not looked up yet; -1: it could not be seen."""

    @property
    def who(self) -> str:
        """Name of the client in screen, log, status and recording, as 'anna, terminal window 3'."""
        place = place_text(self.terminal) if self.terminal else f"process {self.pid}"
        return f"{self.user or f'user {self.uid}'}, {place}"


@dataclass(frozen=True)
class Approval:
    """Permission that was given to start an offered motion."""

    how: str
    """How it was given, for log and recording: 'at terminal window 3', 'as a service, …'."""
    by_person: bool
    """A person at a terminal gave it, who has looked at the cell; False: a service or a simulated cell."""


class ApprovalRule:
    """Rule that decides who may approve motion. `see`: function that looks a process up."""

    def __init__(
        self, config: ApprovalConfig, simulated: bool, see: Callable[[int], Process | None] = process
    ) -> None:
        self._config, self._simulated, self._see = config, simulated, see

    def meet(self, peer: Peer) -> None:
        """Note, when a client first asks, when its process began and where its person sees it."""
        if peer.began_ticks is None:
            seen = self._see(peer.pid)
            peer.began_ticks = -1 if seen is None else seen.began_ticks
            peer.terminal = self.terminal(peer)

    def by_person(self, asks: Peer, what: str) -> str:
        """Check that a person may approve from this client; return how, for the log. Else RefusedError.

        `what`: what the person is needed for, as the error names it: "A stop test".
        """
        if self._simulated:
            return "a simulated cell"
        if terminal := self.terminal(asks):
            self._require_permitted(asks)
            return f"at {place_text(terminal)}"
        if service := self._service(asks):
            raise RefusedError("service-terminal", what=what, service=service)
        raise RefusedError(
            "no-terminal",
            what=what,
            advice="A person must look, and do it there (docs: Safety). By ssh use `ssh -t`.",
        )

    def approve(self, asks: Peer, sha256: str, offered_sha256: str, barred: str) -> Approval:
        """Check as `by_person`, or that a configured service names the hash of what is offered.

        `barred`: why no service may approve until a person has acknowledged; empty: services may.
        """
        if sha256 and offered_sha256 and sha256 != offered_sha256:
            raise RefusedError("other-plan")
        if self._simulated or self.terminal(asks):
            return Approval(self.by_person(asks, "A move"), by_person=not self._simulated)
        if asks.user not in self._config.services:
            if service := self._service(asks):
                raise RefusedError("service-terminal", what="A move", service=service)
            raise RefusedError("no-service", user=asks.user)
        if barred:
            raise RefusedError("services-barred", user=asks.user, reason=barred)
        if not sha256:
            raise RefusedError("no-plan-named", user=asks.user)
        return Approval("as a service, by the hash of plan and cell", by_person=False)

    def terminal(self, asks: Peer) -> str:
        """Name the terminal in whose foreground this client's person sees it; empty: none."""
        seen = self._see(asks.pid)
        if seen is None or seen.user != asks.uid or seen.began_ticks != asks.began_ticks:
            return ""
        if seen.service:  # a service opens terminals too, and no person sees them
            return ""
        # A screen runs in a terminal of its own; the process that hears F12 for it is in the person's.
        outer = self._see(seen.parent) if seen.terminal else None
        return outer.terminal if outer and outer.user == asks.uid and outer.terminal else seen.terminal

    def _service(self, asks: Peer) -> str:
        """Name the system service of a client that has a terminal nobody sees; empty: it has none."""
        seen = self._see(asks.pid)
        return seen.service if seen is not None and seen.terminal else ""

    def _require_permitted(self, asks: Peer) -> None:
        if self._config.persons and asks.user not in self._config.persons:
            raise RefusedError("not-permitted", user=asks.user)
