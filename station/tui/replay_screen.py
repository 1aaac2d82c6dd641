"""A recording in the live screen, beside the daemon's own: looking only."""

from __future__ import annotations

from typing import ClassVar

from textual import work
from textual.binding import Binding, BindingType

from station.cell.status import StationState, StationStatus
from station.tui.live import LiveScreen
from station.tui.replay import ReplayLink
from station.tui.task import Known

WATCHABLE = (StationState.IDLE, StationState.DISCONNECTED)
"""A cell at rest: nobody looks at an old recording while the arm works or waits for an answer."""


JUMP_S = 10.0


class Player:
    """The keys of a playback; for a screen of its own beside a cell, and for a whole app without one."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("space", "play", "Play/Pause", tooltip="Stop the playback here, or go on"),
        Binding("left", "step(-1)", "Image back", tooltip="To the image before this one"),
        Binding("right", "step(1)", "Image on", tooltip="To the next image"),
        Binding("pageup", f"seek({-JUMP_S})", "10 s back", show=False, tooltip="Ten seconds back"),
        Binding("pagedown", f"seek({JUMP_S})", "10 s on", show=False, tooltip="Ten seconds on"),
        Binding("home", f"seek({-1e9})", "Start", show=False, tooltip="To the start of the recording"),
    ]
    player: ReplayLink

    def action_play(self) -> None:
        self.player.toggle()

    def action_step(self, by: int) -> None:
        self.player.step(by)

    def action_seek(self, by_s: float) -> None:
        self.player.seek(by_s)


class ReplayScreen(Player, LiveScreen):
    """Shows `link`'s statuses in place of the daemon's. STOP still goes to the daemon."""

    NAME = "Playback"
    HELP = (
        "PLAYBACK of a recording. Nothing can be commanded; F12 still stops this cell's arm. Escape leaves."
    )
    BINDINGS: ClassVar[list[BindingType]] = [
        *Player.BINDINGS,
        Binding("escape", "close", "Back", tooltip="Leave the playback"),
    ]

    def __init__(self, link: ReplayLink) -> None:
        super().__init__()
        self.link = self.player = link
        self._played: StationStatus | None = None

    def on_mount(self) -> None:
        self.play()

    def show(self, known: Known) -> None:
        """The cell's own status shows nothing here, but its work ends the playback."""
        status = known.status
        if status is not None and status.state not in WATCHABLE:
            self.notify(f"The playback was closed: the cell is {status.state.value}.", severity="warning")
            self.action_close()
            return
        super().show(Known(self._played))

    @work(exclusive=True, exit_on_error=False)
    async def play(self) -> None:
        async for status in self.link.statuses():
            self._played = status
            super().show(Known(status))

    async def on_unmount(self) -> None:
        await self.link.close()

    def action_close(self) -> None:
        if self.is_attached:
            self.dismiss()
