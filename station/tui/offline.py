"""What the screen does with results, in processes of its own: solve, recover, install, export, discard."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Label, OptionList

from calibrate.calibration import Calibration
from calibrate.errors import CalibrationError
from calibrate.formats import FORMATS
from calibrate.install import load_installed
from station.tui.confirm import Confirm
from station.tui.jobs import JobScreen

if TYPE_CHECKING:
    from station.tui.app import StationApp

CALIBRATION_FILE = "calibration.yaml"


class ChooseFormat(ModalScreen[str | None]):
    """Which other program shall read it."""

    BINDINGS = [Binding("escape", "dismiss(None)", "Cancel")]  # noqa: RUF012  (as textual declares it)

    def compose(self) -> ComposeResult:
        with Vertical(id="choose"):
            yield Label("Export for", id="choose-title")
            yield OptionList(*FORMATS, id="formats")

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        self.dismiss(str(event.option.prompt))


def state_root(calibration: str) -> Path:
    """A session lies in ROOT/sessions/NAME; what is installed lies below the same ROOT."""
    return Path(calibration).resolve().parents[2]


def installed_beside(calibration: str) -> Calibration | None:
    """What consumers of this cell read now; None when there is nothing or it is damaged."""
    try:
        return load_installed(state_root(calibration), allow_simulated=True)
    except CalibrationError:
        return None


async def solve(app: StationApp, recording: str, folder: str) -> str | None:
    """The calibration file, or None when it did not come to one."""
    output, report = (str(Path(folder) / name) for name in (CALIBRATION_FILE, "report.html"))
    to = ("-o", output, "--report", report)
    code = await app.push_screen_wait(
        JobScreen(f"Solving {Path(folder).name}", "calibrate.cli", "solve", recording, *to)
    )
    return output if code in (0, 4) else None


async def recover(app: StationApp, folder: str) -> None:
    await app.push_screen_wait(
        JobScreen(f"Recovering {Path(folder).name}", "recordings.cli", "recover", folder)
    )


async def install(app: StationApp, path: str) -> None:
    """Asks, then installs below the daemon's root. A simulated result only on a simulated cell's root."""
    body = f"{path}\nbecomes what every consumer of this cell reads. `calibrate rollback` undoes it."
    if not await app.push_screen_wait(Confirm("Install this calibration?", body, yes="Install")):
        return
    cell = "simulated" if app.status is not None and app.status.simulated else "real"
    where = ("--root", str(state_root(path)), "--cell", cell)
    code = await app.push_screen_wait(JobScreen("Installing", "calibrate.cli", "install", path, *where))
    if code == 0:
        app.notify("Installed. `calibrate rollback` goes back to the one before.")
    elif code == 4:
        app.notify("A gate failed: nothing was installed. `calibrate install --override REASON` takes over.")


async def export(app: StationApp, path: str) -> None:
    chosen = await app.push_screen_wait(ChooseFormat())
    if chosen is None:
        return
    output = str(Path(path).with_name(f"calibration-{chosen}{FORMATS[chosen].suffix}"))
    command = ("export", path, "--to", chosen, "-o", output)
    if await app.push_screen_wait(JobScreen(f"Exporting for {chosen}", "calibrate.cli", *command)) == 0:
        app.notify(f"Written: {output}")


async def discard(app: StationApp, path: str) -> bool:
    """True when it is gone."""
    body = f"{path}\nis deleted. The recording stays and can be solved again."
    if not await app.push_screen_wait(Confirm("Discard this result?", body, yes="Discard")):
        return False
    Path(path).unlink(missing_ok=True)
    return True
