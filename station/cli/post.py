"""`station post`: hands a program's lines to the daemon, or the poses that a person types."""

from __future__ import annotations

import json
import os
import re
import select
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from socket import AF_UNIX, SHUT_WR
from socket import socket as connection
from typing import Annotated, Literal

import typer

from recordings.importers.conventions import convention
from station.cell.errors import ConfigError, RobotError, StaleStateError
from station.cell.socket_folder import default_socket, post_socket
from station.cli.console import Socket, err
from station.devices.posts import read_post

ENDED_S = 5.0
"""Longest wait for the daemon to read the last lines."""
PERIOD_S = 0.02
STANDS_S = 3.0
"""A typed pose is posted for so long: after it the arm may already be on its way to the next place."""
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?(?![\w.])")


def post_command(
    typed: Annotated[
        str, typer.Option(metavar="CONVENTION", help="Type poses as the pendant shows them, e.g. kuka-abc")
    ] = "",
    source: Annotated[
        Literal["live", "simulated", "playback"], typer.Option(help="Of typed poses: what they are of")
    ] = "live",
    socket: Socket = None,
) -> None:
    """Post the pose of an arm that a person moves (robot.driver: posted).

    Alone it hands on lines from standard input: first {"source": "live"}, then {"base_from_flange": [x, y, z,
    qx, qy, qz, qw], "t": seconds, "joints_rad": [...]} each, in metres and radians. With --typed it asks for
    the numbers on the pendant: type them when the arm stands; for 3 s it counts as standing there. Labels and
    commas between the numbers do no harm.

    A line that the station refuses is told with its number, and the others go on.

    Exit codes: 0 the input ended; 3 some lines were refused; 1 the station refused the program, or is gone.
    """
    path = post_socket(socket or default_socket())
    if typed:
        convention(typed)
    elif sys.stdin.isatty():
        problem, advice = "Nothing is piped in", "Pipe a program's lines in, or give --typed CONVENTION."
        raise ConfigError("usage", problem=problem, advice=advice)
    with connection(AF_UNIX) as link:
        try:
            link.connect(str(path))
        except OSError as error:
            raise RobotError("post-no-station", socket=path, reason=error.strerror) from None
        answers = Answers(numbered=not typed)
        for line in _typed_lines(typed, source) if typed else sys.stdin.buffer:
            try:
                link.sendall(line)
                if select.select([link], [], [], 0)[0]:
                    answers.tell(link.recv(4096))
            except OSError:
                with suppress(OSError):
                    answers.tell(link.recv(4096))  # why it refused the program
                raise RobotError("post-no-station", socket=path, reason="it ended") from None
        link.shutdown(SHUT_WR)
        link.settimeout(ENDED_S)
        with suppress(OSError):
            while heard := link.recv(4096):  # nothing more, once all lines are read
                answers.tell(heard)
    raise typer.Exit(3 if answers.refused else 0)


class Answers:
    """What the station says of the lines."""

    def __init__(self, numbered: bool) -> None:
        """`numbered`: a person knows the lines by their numbers."""
        self._numbered = numbered
        self.refused = 0
        """Number of lines that it refused."""
        self._rest = b""

    def tell(self, heard: bytes) -> None:
        """Print each answer. Ends the command where the station refuses the program."""
        *lines, self._rest = (self._rest + heard).split(b"\n")
        for line in lines:
            answer = json.loads(line)
            number = answer.get("line")
            place = f"line {number}: " if number and self._numbered else ""
            err.print(f"{place}{answer['text']}", style="red")
            if number is None:
                raise typer.Exit(1)
            self.refused += 1


def _typed_lines(name: str, source: str) -> Iterator[bytes]:
    """Yield the declaration, then the typed pose again and again; its time begins anew with each."""
    yield json.dumps({"source": source, "convention": name}).encode() + b"\n"
    written, numbers, began_s, rest = convention(name), list[float](), 0.0, ""
    err.print(f"Type the pose as {name}, then Enter; Ctrl-D ends.")
    while True:
        if select.select([sys.stdin], [], [], PERIOD_S)[0]:
            if not (data := os.read(sys.stdin.fileno(), 4096)):
                return
            *lines, rest = (rest + data.decode(errors="replace")).split("\n")
            for line in lines:
                found = [float(number) for number in _NUMBER.findall(line)]
                try:
                    _, pose = read_post(_line(found, 0.0), written)
                except StaleStateError as error:
                    err.print(str(error), style="red")
                    continue
                numbers, began_s = found, time.monotonic()
                err.print("stands at x {:.1f}, y {:.1f}, z {:.1f} mm".format(*(1000 * m for m in pose[:3])))
        stands_s = time.monotonic() - began_s
        yield _line(numbers, stands_s) if numbers and stands_s < STANDS_S else b""  # an answer may have come


def _line(numbers: list[float], t: float) -> bytes:
    return json.dumps({"base_from_flange": numbers, "t": t}).encode() + b"\n"
