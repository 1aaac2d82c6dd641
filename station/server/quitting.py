"""Who may end the daemon by `station quit`, and when: who started it by hand, with nothing left to do."""

from __future__ import annotations

import os

from station.cell.errors import RefusedError
from station.cell.socket_folder import ROOT, user_name
from station.protocol.stop_client import ArmMotion
from station.server.approval import Peer
from station.server.control_group import innermost_service, system_service
from station.session.session import Session


def way_of_service(pid: int, notify_socket: str) -> str:
    """Name the command that ends this process where a service manager runs it; empty: a person started it.

    `notify_socket`: where a service manager listens, which it tells in NOTIFY_SOCKET. A unit's name alone
    proves no service of a user: some desktops start each terminal as one.
    """
    if service := system_service(pid):
        return f"systemctl stop {service}"
    if not notify_socket:
        return ""
    unit = innermost_service(pid)
    return f"systemctl --user stop {unit}" if unit else "the command of the program that started it"


def require_started_by(caller: Peer, way: str) -> None:
    """Raise RefusedError unless the caller's user started this daemon by hand. `way`: `way_of_service`."""
    if way:
        raise RefusedError("quit-service", command=way)
    owner = os.getuid()
    if caller.uid not in (owner, ROOT):
        raise RefusedError("quit-other-user", owner=user_name(owner))


def require_nothing_left(session: Session, motion: ArmMotion) -> None:
    """Raise RefusedError unless the session is finished and nothing waits for a person.

    The verb's states have kept out whatever moves or is latched by its state.
    """
    if session.context.recording is not None:
        raise RefusedError("quit-session-open", session=session.store.status.session.name)
    if motion is ArmMotion.MOVES:
        raise RefusedError("arm-moves")
    if session.latch.held is not None:
        raise RefusedError("quit-latched", reason=session.latch.held.reason.rstrip("."))
