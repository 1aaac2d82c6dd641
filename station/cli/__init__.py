"""The command line `station`: a table of commands (`app`), each in a module that loads when it runs.

STOP is carried out before anything large is loaded.
"""

from __future__ import annotations

import signal
import sys


def main() -> None:
    """Run one command; without arguments, open the operator screen."""
    if sys.argv[1:2] == ["stop"]:
        from station.protocol.stop_client import main as stop

        if (code := stop(sys.argv[2:])) is not None:
            sys.exit(code)
    # Ctrl-C is STOP, also where a shell started this in the background with SIGINT ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if len(sys.argv) == 1:
        sys.argv.append("tui")
    from recordings.cli.lazy import run
    from station.cli.app import STATION

    run("station", STATION)
