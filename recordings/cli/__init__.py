"""`recordings`, the command line of the recordings room."""

from __future__ import annotations


def main() -> None:
    from recordings.cli.app import main as run

    run()
