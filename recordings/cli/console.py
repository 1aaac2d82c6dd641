"""Output of all command lines: a console that prints other people's text without obeying it, and JSON."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.console import Console, ConsoleOptions, ConsoleRenderable, RenderHook, RenderResult
from rich.measure import Measurement
from rich.segment import Segment

from recordings.plain_text import plain_text

OpenReport = Annotated[bool, typer.Option("--open", help="Open the report in a browser")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout and nothing else")]


def print_json(value: object) -> None:
    """Print a struct in one line, paths in it as text, arrays as lists."""
    sys.stdout.write(msgspec.json.encode(value, enc_hook=_plain_value).decode() + "\n")


def _plain_value(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else plain_text(os.fspath(value))


def plain_console(**settings: Any) -> Console:
    """Make a console without markup and emoji, so that brackets in a name are printed as they are."""
    console = Console(**{"highlight": False, "markup": False, "emoji": False, **settings})
    console.push_render_hook(_Hook())
    return console


class ProgressLine(msgspec.Struct, frozen=True, omit_defaults=True, tag_field="kind", tag="progress"):
    """How far the work is, for a program that shows it: one JSON object a line."""

    what: str
    """What is done now, in words."""
    done: int = 0
    total: int = 0
    """0: nobody knows how much it is."""


@contextmanager
def progress_bar(label: str, console: Console) -> Iterator[Callable[[int, int, str], None]]:
    """Show a bar until the end. Yields a function to call with done, total and a text."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    texts = TextColumn(label), TextColumn("{task.description}", markup=False)
    columns = (texts[0], BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), texts[1])
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total, name: bar.update(task, completed=done, total=total, description=name)


def open_in_browser(page: Path) -> bool:
    """Open a local file in the desktop's browser; False: there is no desktop here, or no way to ask it."""
    mac = sys.platform == "darwin"
    command = shutil.which("open" if mac else "xdg-open")
    if command is None or not (mac or os.environ.keys() & {"DISPLAY", "WAYLAND_DISPLAY"}):
        return False
    quiet = subprocess.DEVNULL  # what a browser says would be written across the terminal
    asked = subprocess.Popen([command, page], stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
    threading.Thread(target=asked.wait, daemon=True).start()
    return True


def open_report(page: Path, console: Console) -> None:
    """Open a report, or say that there is no desktop."""
    if not open_in_browser(page):
        console.print(f"No desktop was found here: open {page} in a browser.", soft_wrap=True)


class _Hook(RenderHook):
    def process_renderables(self, renderables: Iterable[ConsoleRenderable]) -> list[ConsoleRenderable]:
        return [_Plain(renderable) for renderable in renderables]


class _Plain:
    def __init__(self, inside: ConsoleRenderable) -> None:
        self._inside = inside

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for segment in console.render(self._inside, options):
            yield segment if segment.control else Segment(plain_text(segment.text), segment.style)

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        return Measurement.get(console, options, self._inside)
