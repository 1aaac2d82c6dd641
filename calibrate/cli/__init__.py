"""`calibrate`: the entry point of the command line."""

from __future__ import annotations


def main() -> None:
    """Exit codes: 0 good, 1 failed, 2 usage or configuration, 3 done with loss, 4 a gate failed."""
    from calibrate.cli.app import CALIBRATE
    from recordings.cli.lazy import run

    run("calibrate", CALIBRATE)
