"""Commands that packages above offer to `recordings` by an entry point: none is known here by its name."""

from __future__ import annotations

from importlib.metadata import entry_points

import typer

from recordings.cli.lazy import LazyCommand
from recordings.errors import RecordingError

GROUP = "recordings.commands"
"""Entry points: a command's name → a `LazyCommand`."""


def offered(name: str) -> LazyCommand:
    """The command that an installed package offers, or one that says what to install."""
    for point in entry_points(group=GROUP, name=name):
        command = point.load()
        assert isinstance(command, LazyCommand), point.value
        return command
    return LazyCommand(f"{__name__}:not_offered", "Not installed: the package `calibrate` brings it.")


def not_offered(
    context: typer.Context,
    arguments: list[str] = typer.Argument(None, hidden=True),  # noqa: B008  (how typer declares it)
) -> None:
    """Not installed: the package `calibrate` brings it."""
    raise RecordingError("command-not-installed", command=context.command_path, package="calibration-station")
