"""`station`, where every command begins. STOP is carried out before anything large is loaded."""

from __future__ import annotations

import sys


def main() -> None:
    if sys.argv[1:2] == ["stop"]:
        from station.stop_client import main as stop

        if (code := stop(sys.argv[2:])) is not None:
            sys.exit(code)
    from station.command_line import main as run

    run()


if __name__ == "__main__":
    main()
