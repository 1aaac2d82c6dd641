"""`station`, where every command begins. STOP is carried out before anything large is loaded."""

from __future__ import annotations

import sys


def main() -> None:
    if sys.argv[1:2] == ["stop"]:
        from station.protocol.stop_client import main as stop

        if (code := stop(sys.argv[2:])) is not None:
            sys.exit(code)
    from station.cli.app import main as run

    run()
