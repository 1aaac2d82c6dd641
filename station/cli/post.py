"""`station post`: hands a program's lines to the daemon."""

from __future__ import annotations

import json
import select
import sys
from contextlib import suppress
from socket import AF_UNIX, SHUT_WR
from socket import socket as connection

import typer

from station.cell.errors import ConfigError, RobotError
from station.cell.socket_folder import default_socket, post_socket
from station.cli.console import Socket, err

ENDED_S = 5.0
"""Longest wait for the daemon to read the last lines."""


def post_command(socket: Socket = None) -> None:
    """Post the pose of an arm that a person moves (robot.driver: posted).

    Hands on lines from standard input: first {"source": "live"}, then {"base_from_flange": [x, y, z, qx, qy,
    qz, qw], "t": seconds, "joints_rad": [...]} each, in metres and radians.

    Exit codes: 0 the input ended; 1 the station refused the poses, or is gone.
    """
    path = post_socket(socket or default_socket())
    if sys.stdin.isatty():
        raise ConfigError("usage", problem="Nothing is piped in", advice="Pipe a program's lines in.")
    with connection(AF_UNIX) as link:
        try:
            link.connect(str(path))
        except OSError as error:
            raise RobotError("post-no-station", socket=path, reason=error.strerror) from None
        for line in sys.stdin.buffer:
            try:
                link.sendall(line)
                refused = select.select([link], [], [], 0)[0] and link.recv(4096)
            except OSError:
                refused = b""
                with suppress(OSError):
                    refused = link.recv(4096)
                if not refused:
                    raise RobotError("post-no-station", socket=path, reason="it ended") from None
            _exit_if(refused or b"")
        link.shutdown(SHUT_WR)
        link.settimeout(ENDED_S)
        with suppress(OSError):
            _exit_if(link.recv(4096))  # nothing, once all lines are read


def _exit_if(refused: bytes) -> None:
    if refused:
        err.print(json.loads(refused)["text"], style="red")
        raise typer.Exit(1)
