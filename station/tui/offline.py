"""What the screen does with results, in processes of its own: solve, recover, install, export, discard."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Vertical
from textual.screen import ModalScreen
from textual.widgets import Input, Label, OptionList, Static
from textual.widgets.option_list import Option

from calibrate.files.exports import FORMATS
from calibrate.files.generations import Generation, before_current, generations
from calibrate.files.install import reason_problem
from station.operate.drift_check import check_arguments
from station.tui.confirm import Confirm
from station.tui.installed import local
from station.tui.jobs import JobScreen

if TYPE_CHECKING:
    from station.tui.app import StationApp

OVERRIDE = "--override"
PERSON = "To override:"
"""Before it the command says why it refuses, after it how a person overrules that."""
NOT_INSTALLED = " is not installed. "
"""Between the file's path and why."""
NOTHING_INSTALLED = "Nothing was installed."
CALIBRATION_FILE = "calibration.yaml"


class ChooseFormat(ModalScreen[str | None]):
    """Which other program shall read it."""

    BINDINGS = [Binding("escape", "dismiss(None)", "Cancel")]  # noqa: RUF012  (as textual declares it)

    def compose(self) -> ComposeResult:
        with Vertical(id="choose"):
            yield Label("Export for", id="choose-title")
            lines = [Option(f"{name:<20}  {kind.says}", id=name) for name, kind in FORMATS.items()]
            yield OptionList(*lines, id="formats", markup=False, compact=True)
            yield Label("Enter writes it beside the recording, Escape: no", id="choose-keys")

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        self.dismiss(event.option.id)


class Reason(ModalScreen[str]):
    """Why a person installs a calibration all the same; empty: not."""

    BINDINGS = [Binding("escape", "dismiss('')", "Cancel", tooltip="Install nothing")]  # noqa: RUF012

    def __init__(self, refusal: str) -> None:
        super().__init__()
        self._refusal = refusal

    def compose(self) -> ComposeResult:
        with Vertical(id="verify"):
            yield Label("It is not installed", id="verify-title")
            yield Static(self._refusal, markup=False)
            yield Input(id="reason", placeholder="your reason, if you take responsibility", compact=True)
            yield Label("", id="verify-problem", markup=False)
            yield Label(
                "Your name and the reason go into the file. Enter installs, Escape not.",
                id="verify-keys",
            )

    def on_input_submitted(self, event: Input.Submitted) -> None:
        if problem := reason_problem(event.value):
            self.query_one("#verify-problem", Label).update(problem)
        else:
            self.dismiss(event.value.strip())


def state_root(calibration: str) -> Path:
    """A session lies in ROOT/sessions/NAME; what is installed lies below the same ROOT."""
    return Path(calibration).resolve().parents[2]


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


async def install(app: StationApp, path: str, ended: str) -> None:
    """Asks, then installs below the daemon's root. A simulated result only on a simulated cell's root.

    `ended`: how this one stopped being installed before; empty: it never was.
    """
    body = f"{path}\nbecomes what every consumer of this cell reads. Key b on this screen undoes it."
    body += f"\n\n{ended}" if ended else ""
    if not await app.push_screen_wait(Confirm("Install this calibration?", body, yes="Install")):
        return
    cell = "simulated" if app.status is not None and app.status.simulated else "real"
    where = ("--root", str(state_root(path)), "--cell", cell)
    refusal = await _install(app, path, *where)
    if refusal and OVERRIDE in refusal:
        why = refusal.partition(PERSON)[0].partition(NOT_INSTALLED)[2] or refusal
        reason = await app.push_screen_wait(Reason(why.strip()))
        refusal = await _install(app, path, *where, OVERRIDE, reason) if reason else NOTHING_INSTALLED
    if refusal:
        app.notify(refusal, title="Not installed", severity="error", timeout=20)


async def _install(app: StationApp, path: str, *options: str) -> str:
    """Why not; empty when it is installed."""
    job = JobScreen("Installing", "calibrate.cli", "install", path, *options, close_on=(0, 1, 4))
    code = await app.push_screen_wait(job)
    if code == 0:
        app.notify("Installed. Key b on this screen goes back to the one before.")
        return ""
    if code < 0:
        app.notify("Cancelled: what is installed now stands on this screen.")
        return ""
    return " ".join(job.said) or NOTHING_INSTALLED


async def roll_back(app: StationApp, path: str) -> None:
    """Asks, naming both, then switches back to the calibration before the installed one."""
    root = state_root(path)
    known = generations(root)
    current = next((g for g in known if g.current), None)
    older = before_current(known)
    if current is None or older is None:
        there = "nothing is" if current is None else "only one was ever"
        app.notify(f"There is no older calibration to go back to: {there} installed.")
        return
    body = f"Now: {_named(current)}\nBefore: {_named(older)}\nConsumers then read the one before."
    if not await app.push_screen_wait(Confirm("Go back to the calibration before?", body, yes="Go back")):
        return
    if (
        await app.push_screen_wait(JobScreen("Going back", "calibrate.cli", "rollback", "--root", str(root)))
        == 0
    ):
        app.notify("The calibration before is installed again.")


def _named(generation: Generation) -> str:
    calibration = generation.calibration
    if calibration is None:
        return f"generation {generation.number}"
    taken = calibration.override
    reason = "" if taken is None else f" with the reason “{taken.reason}”"
    session = calibration.provenance.session
    return f"generation {generation.number}, session {session}, solved {local(calibration.created)}{reason}"


async def check(app: StationApp, recording: str, folder: str) -> None:
    """Does the installed calibration still hold on this recording? Its answer stays until it is read."""
    title = f"Does the installed calibration hold on {Path(folder).name}?"
    what = check_arguments(recording, folder)
    await app.push_screen_wait(JobScreen(title, "calibrate.cli", *what, close_on=()))


async def export(app: StationApp, path: str) -> None:
    chosen = await app.push_screen_wait(ChooseFormat())
    if chosen is None:
        return
    output = str(Path(path).with_name(f"calibration-{chosen}{FORMATS[chosen].suffix}"))
    command = ("export", path, "--to", chosen, "-o", output)
    if await app.push_screen_wait(JobScreen(f"Exporting for {chosen}", "calibrate.cli", *command)) == 0:
        app.notify(f"Written: {output}", timeout=20)


async def discard(app: StationApp, path: str) -> bool:
    """True when it is gone."""
    body = f"{path}\nis deleted. The recording stays and can be solved again."
    if not await app.push_screen_wait(Confirm("Discard this result?", body, yes="Discard")):
        return False
    Path(path).unlink(missing_ok=True)
    return True
