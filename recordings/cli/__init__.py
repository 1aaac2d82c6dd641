"""The command line `recordings`: a table of commands (`app`), each in a module that loads when it runs."""

from __future__ import annotations


def main() -> None:
    """Run one command."""
    from recordings.cli.app import RECORDINGS
    from recordings.cli.lazy import run

    run("recordings", RECORDINGS)
