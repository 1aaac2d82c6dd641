"""A recording in the live screen, beside the daemon's own: looking only."""

from __future__ import annotations

from typing import ClassVar

from textual import work
from textual.binding import Binding, BindingType

from station.status import StationState, StationStatus
from station.tui.link import Link
from station.tui.live import LiveScreen

WATCHABLE = (StationState.IDLE, StationState.DISCONNECTED)
"""A cell at rest: nobody looks at an old recording while the arm works or waits for an answer."""


class ReplayScreen(LiveScreen):
    """Shows `link`'s statuses in place of the daemon's. STOP still goes to the daemon."""

    HELP = (
        "PLAYBACK of a recording. Nothing can be commanded; F12 still stops this cell's arm. Escape leaves."
    )
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "close", "Back", tooltip="Leave the playback"),
    ]

    def __init__(self, link: Link) -> None:
        super().__init__()
        self.link = link
        self._played: StationStatus | None = None

    def on_mount(self) -> None:
        self.play()

    def show(self, status: StationStatus | None) -> None:
        """The cell's own status shows nothing here, but its work ends the playback."""
        if status is not None and status.state not in WATCHABLE:
            self.notify(f"The playback was closed: the cell is {status.state.value}.", severity="warning")
            self.action_close()
            return
        super().show(self._played)

    @work(exclusive=True, exit_on_error=False)
    async def play(self) -> None:
        async for status in self.link.statuses():
            self._played = status
            super().show(status)

    async def on_unmount(self) -> None:
        await self.link.close()

    def action_close(self) -> None:
        if self.is_attached:
            self.dismiss()
