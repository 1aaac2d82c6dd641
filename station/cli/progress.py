"""A session in a terminal that is no full screen: a bar, and a line for every pose and warning."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.text import Text

from station.cell.status import Event, StationStatus


class SessionProgress:
    """Context manager; call it with every status. Silent when `quiet`.

    The bar appears with the first status, so that a question before the go has the terminal to itself.
    """

    def __init__(self, console: Console, quiet: bool) -> None:
        self._quiet = quiet
        self._bar = Progress(
            TextColumn("{task.description:<34}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console,
            disable=quiet,
        )
        self._task: TaskID | None = None
        self._last: Event | None = None

    def __enter__(self) -> SessionProgress:
        return self

    def say(self, text: str) -> None:
        """One line about what is going on outside a session."""
        if not self._quiet:
            self._bar.console.print(Text(text, "dim"))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def skip(self, status: StationStatus) -> None:
        """Skip the events of this status: they happened before."""
        if status.events:
            self._last = status.events[-1]

    def __call__(self, status: StationStatus) -> None:
        if self._quiet:
            return
        session = status.session
        if self._task is None:
            self._bar.start()
            self._task = self._bar.add_task("", total=len(session.poses))
        where = f"pose {session.current + 1} " if session.current is not None else ""
        self._bar.update(
            self._task,
            description=f"{where}{status.state.value}",
            total=len(session.poses),
            completed=session.captured,
        )
        for event in self._new(status):
            number = f"pose {event.pose_index + 1:>2}  " if event.pose_index is not None else ""
            style = {"warning": "yellow", "error": "red"}.get(event.level, "dim")
            self._bar.console.print(Text(f"{number}{event.text}", style))

    def _new(self, status: StationStatus) -> list[Event]:
        events = list(status.events)
        if self._last in events:
            events = events[events.index(self._last) + 1 :]
        if status.events:
            self._last = status.events[-1]
        return events
