"""Work on recordings and results from the screen: solve, recover, install, go back, export, discard.

Long work runs in a process of its own, its lines shown, and can be cancelled.
"""

from __future__ import annotations

import asyncio
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical
from textual.reactive import reactive
from textual.screen import ModalScreen
from textual.widgets import Button, Label, RichLog

from calibrate.errors import CalibrationError
from calibrate.files.calibration import read_calibration
from calibrate.files.exports import FORMATS, FrameNames, export
from calibrate.files.install import Cell, install, rollback
from calibrate.files.versions import InstalledVersion, before_current, installed_versions, same_solve
from recordings.files import ASKED_FOR, write_atomically
from station.cell.session_folder import CALIBRATION_FILE
from station.cell.status import SessionStatus
from station.operate.drift_check import check_arguments, recorded, start_drift_check
from station.tui.desk import Desk
from station.tui.dialogs import ChooseFormat, Confirm, Reason
from station.tui.installed import local, read_installed, state_root
from station.tui.touch_test import run_touch_test
from station.tui.words import duration

TERMINATE_S = 5.0
OVERRIDABLE = ("gate-failed", "objection")
"""Codes of refusals that a person may override with a reason."""
NO_VERDICT = (
    "Another plan was loaded: the drift check has no verdict. Its views, if any, are on screen 4 (k)."
)


class JobScreen(ModalScreen[int]):
    """Runs `python -m MODULE ARGS…` and returns its exit code; Escape or Cancel ends it (-1).

    What it said stays until it is read, unless the code is one of `close_on`.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "cancel", "Cancel", tooltip="End this work; nothing half-written stays")
    ]

    def __init__(self, title: str, module: str, *args: str, close_on: tuple[int, ...] = (0, 4)) -> None:
        super().__init__()
        self._close_on = close_on
        self.said: list[str] = []
        self._title, self._command = title, (sys.executable, "-m", module, *args)
        self._process: asyncio.subprocess.Process | None = None
        self._exit_code: int | None = None
        self._cancelled = False

    def compose(self) -> ComposeResult:
        with Vertical(id="job"):
            yield Label(self._title, id="job-title")
            yield RichLog(id="job-lines", wrap=True, max_lines=500, min_width=0)
            yield Button("Cancel", id="job-cancel")

    def on_mount(self) -> None:
        self._begun_s = time.monotonic()
        self.set_interval(1.0, self._say_how_long)
        self.call_after_refresh(self.run_job)  # the width of its lines is known then

    def _say_how_long(self) -> None:
        """It may say nothing for a while; the seconds tell that it works."""
        if self._exit_code is None:
            spent = duration(time.monotonic() - self._begun_s)
            self.query_one("#job-title", Label).update(f"{spent} {self._title} …")

    @work(exclusive=True, exit_on_error=False)
    async def run_job(self) -> None:
        lines = self.query_one("#job-lines", RichLog)
        width = str(max(40, lines.scrollable_content_region.width))  # its own line breaks are then ours
        self._process = await asyncio.create_subprocess_exec(
            *self._command,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            env=os.environ | {"CALIBRATE_PROGRESS": "lines", "PYTHONUNBUFFERED": "1", "COLUMNS": width},
        )
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            self.said.append(line.decode(errors="replace").rstrip())
            lines.write(self.said[-1])
        self._exit_code = await self._process.wait()
        self.query_one("#job-title", Label).update(self._title)
        if self._cancelled and self._exit_code != 0:
            self.dismiss(-1)
        elif self._cancelled or self._exit_code in self._close_on:  # it may have been done all the same
            self.dismiss(self._exit_code)
        else:  # The person reads why before it goes away.
            close = self.query_one("#job-cancel", Button)
            close.label = "Close"
            close.focus()

    async def action_cancel(self) -> None:
        if self._process is None or self._exit_code is not None:
            self.dismiss(-1 if self._exit_code is None else self._exit_code)
            return
        self._cancelled = True
        self._process.terminate()
        try:
            await asyncio.wait_for(self._process.wait(), TERMINATE_S)
        except TimeoutError:
            self._process.kill()

    async def on_button_pressed(self) -> None:
        await self.action_cancel()


class ResultsDesk(Desk):
    """A desk that also works on recordings and calibration files."""

    result_path: reactive[str] = reactive("", repaint=False, always_update=True)
    """The calibration file that the result screen shows; empty: that of the session just captured."""

    async def show_result(self, calibration: str) -> None:
        self.result_path = calibration
        await self.switch_mode("result")

    async def job(
        self, title: str, module: str, *arguments: str, close_on: tuple[int, ...] = (0, 4)
    ) -> int | None:
        return await self.push_screen_wait(JobScreen(title, module, *arguments, close_on=close_on))

    @work(exclusive=True, group="job", exit_on_error=False)
    async def solve(self, recording: str, folder: str) -> None:
        output, report = (str(Path(folder) / name) for name in (CALIBRATION_FILE, "report.html"))
        what = ("solve", recording, "-o", output, "--report", report)
        if await self.job(f"Solving {Path(folder).name}", "calibrate.cli", *what) in (0, 4):
            await self.show_result(output)

    def action_solve_newest(self) -> None:
        session = SessionStatus() if self.status is None else self.status.session
        if session.recording:
            self.solve(session.recording, session.folder)
        else:
            self.notify("Nothing is finished yet: F7 finishes a session; older ones are on screen 4.")

    @work(exclusive=True, group="job", exit_on_error=False)
    async def recover(self, folder: str) -> None:
        await self.job(f"Recovering {Path(folder).name}", "recordings.cli", "recover", folder)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def check(self, recording: str, folder: str) -> None:
        await self._check(recording, folder)

    async def _check(self, recording: str, folder: str) -> None:
        """Judge the installed calibration on this recording; the verdict stays until it is read."""
        title = f"Drift check on {Path(folder).name}"
        await self.job(title, "calibrate.cli", *check_arguments(recording, folder), close_on=())

    @work(exclusive=True, group="drift", exit_on_error=False)
    async def drift_check(self) -> None:
        """Plan, ask, capture, also after pauses and new approvals in between; then the verdict."""
        status = self.status
        if status is None:
            return
        plan_sha256 = await self.start(start_drift_check(self, status, self.approves))
        if not plan_sha256:
            return
        await self.switch_mode("live")
        session = await recorded(self, plan_sha256)
        if session is None:
            self.notify(NO_VERDICT, timeout=10)
        else:
            await self._check(session.recording, session.folder)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def touch_test(self, calibration: str) -> None:
        if await run_touch_test(self, Path(calibration)):
            await self.show_result(calibration)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def install(self, path: str, ended: str) -> None:
        """Ask, then install below the daemon's root. A simulated result only on a simulated cell's root.

        `ended`: how this one stopped being installed before; empty: it never was.
        """
        body = f"{path}\nbecomes what every consumer of this cell reads. Key b on this screen undoes it."
        body += f"\n\n{ended}" if ended else ""
        if not await self.push_screen_wait(Confirm("Install this calibration?", body, yes="Install")):
            return
        refusal = await self._install(path, "")
        if refusal is not None and refusal.code in OVERRIDABLE:
            if not (reason := await self.push_screen_wait(Reason(refusal.text))):
                self.notify("Nothing was installed.")
                return
            refusal = await self._install(path, reason)
        if refusal is not None:
            self.notify(str(refusal), title="Not installed", severity="error", timeout=20, markup=False)

    async def _install(self, path: str, reason: str) -> CalibrationError | None:
        """Install; return the refusal, None when it is installed."""
        cell: Cell = "simulated" if self.status is not None and self.status.simulated else "real"
        try:
            made = await asyncio.to_thread(
                install,
                Path(path),
                state_root(path),
                cell=cell,
                override=reason,
                max_age_days=self.max_age_days,
            )
        except CalibrationError as refusal:
            return refusal
        self.notify("Installed. Key b on this screen goes back to the one before.")
        self._say_hooks(made)
        return None

    @work(exclusive=True, group="job", exit_on_error=False)
    async def roll_back(self, path: str) -> None:
        """Ask, naming both, then switch back to the calibration before the installed one."""
        root = state_root(path)
        try:
            camera = read_calibration(Path(path)).camera_name
        except CalibrationError as problem:
            self.notify(str(problem), severity="error", markup=False)
            return
        known = installed_versions(root, camera)
        current = next((g for g in known if g.current), None)
        older = before_current(known)
        if current is None or older is None:
            there = "nothing is" if current is None else "only one was ever"
            self.notify(f"There is no older calibration to go back to: {there} installed.")
            return
        body = f"Now: {_named(current)}\nBefore: {_named(older)}\nConsumers then read the one before."
        if not await self.push_screen_wait(
            Confirm("Go back to the calibration before?", body, yes="Go back")
        ):
            return
        made = await self.attempt(asyncio.to_thread(rollback, root, camera=camera))
        if made is not None:
            self.notify("The calibration before is installed again; a drift check proves it (4, k).")
            self._say_hooks(made)

    def _say_hooks(self, version: InstalledVersion) -> None:
        for run in version.hooks:
            if run.failed:
                why = run.problem or f"exit code {run.exit_code}"
                self.notify(f"{run.program}: {why}", title="A hook failed", severity="warning", markup=False)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def export(self, path: str) -> None:
        chosen = await self.push_screen_wait(ChooseFormat())
        if chosen is None:
            return
        output = Path(path).with_name(f"calibration-{chosen}{FORMATS[chosen].suffix}")

        def write() -> Path:
            calibration, root = read_calibration(Path(path)), state_root(path)
            names = FrameNames.of_camera(calibration.camera_name)
            installed = read_installed(root, calibration.camera_name)
            if same_solve(calibration, installed.now):
                names = replace(names, validity=installed.validity)
            text = export(calibration, chosen, names)
            write_atomically(output, text.encode(), ASKED_FOR)
            return output

        if await self.attempt(asyncio.to_thread(write)) is not None:
            self.notify(f"Written: {output}", timeout=20, markup=False)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def discard(self, path: str) -> None:
        body = f"{path}\nis deleted. The recording stays and can be solved again."
        if await self.push_screen_wait(Confirm("Discard this result?", body, yes="Discard")):
            Path(path).unlink(missing_ok=True)
            self.result_path = ""
            await self.switch_mode("sessions")


def _named(generation: InstalledVersion) -> str:
    calibration = generation.calibration
    if calibration is None:
        return f"version {generation.number}"
    taken = calibration.override
    reason = "" if taken is None else f", overridden: “{taken.reason}”"
    session = calibration.provenance.session
    return f"version {generation.number}, session {session}, solved {local(calibration.created)}{reason}"
