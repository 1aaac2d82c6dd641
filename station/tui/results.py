"""Work on recordings and results from the screen: solve, recover, install, go back, export, discard.

Long work runs in a process of its own, its lines shown, and can be cancelled.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path

from textual import work
from textual.reactive import reactive

from calibrate.errors import CalibrationError
from calibrate.files.calibration import read_calibration
from calibrate.files.exports import FORMATS, FrameNames, export, follow_command
from calibrate.files.install import Cell, install, rollback
from calibrate.files.versions import InstalledVersion, before_current, installed_versions, same_solve
from recordings.files import ASKED_FOR, write_atomically
from station.cell.session_folder import CALIBRATION_FILE
from station.cell.status import SessionStatus
from station.operate.drift_check import check_arguments, judged, recorded, start_drift_check
from station.protocol.verbs import Check
from station.tui.desk import Desk
from station.tui.dialogs import ChooseFormat, Confirm, JobScreen, Reason
from station.tui.installed import Ended, Marks, Result, local, marks, read_installed, read_result, state_root
from station.tui.task import Known

OVERRIDABLE = ("gate-failed", "objection")
"""Codes of refusals that a person may override with a reason."""
NO_VERDICT = "Another plan was loaded: the drift check has no verdict. Its views, if any, are on 7 (k)."


class ResultsDesk(Desk):
    """A desk that also works on recordings and calibration files."""

    result_path: reactive[str] = reactive("", repaint=False, always_update=True)
    """The calibration file that the result screen shows; empty: that of the session just captured."""

    result: reactive[Result | None] = reactive(None, repaint=False)
    """Facts of that file for the screens; None: there is none."""
    looked: reactive[int] = reactive(0, repaint=False)
    """Counts the times that anything below the root was found changed."""
    checks: tuple[Check, ...] = ()
    """The preflight check, as it was last seen."""
    _marks: tuple[str, Marks] = ("", frozenset())
    _looking = False

    def known(self) -> Known:
        """All that rail and next action are made of."""
        return replace(super().known(), checks=self.checks, result=self.result)

    def watch_result_path(self) -> None:
        self.look_at_results()

    @work(group="look", exit_on_error=False)
    async def look_at_results(self) -> None:
        """Read the shown result again where it changed on the disk; another screen or a shell may do that."""
        if self._looking:
            return  # what is under way comes to the newest, too
        self._looking = True
        try:
            while (found := await self._found()) not in (None, self._marks):
                assert found is not None
                path, self._marks = found[0], found
                self.result = await asyncio.to_thread(read_result, path) if path else None
                self.looked += 1
        finally:
            self._looking = False

    async def _found(self) -> tuple[str, Marks] | None:
        """The shown file, and marks of all below the root; None without a root."""
        path = self.result_path or (self.status.session.calibration if self.status is not None else "")
        root = state_root(path) if path else self.root
        return None if root is None else (path, await asyncio.to_thread(marks, root))

    def forget_look(self) -> None:
        """Take whatever is found next for changed."""
        self._marks = ("", frozenset())

    async def show_result(self, calibration: str) -> None:
        self.result_path = calibration
        await self.switch_mode("solve")

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
            self.notify("Nothing is finished yet: F7 finishes a session; older ones are on 7.")

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
        await self.switch_mode("capture")
        session = await recorded(self, plan_sha256)
        if session is None:
            self.notify(NO_VERDICT, timeout=10)
        else:
            await self._check(session.recording, session.folder)
            if (end := judged(session.folder, self.camera)) is not None:
                self.notify(str(end), title="Drift check", timeout=60, markup=False)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def install(self, path: Path, ended: Ended | None) -> None:
        """Ask, then install below the daemon's root. A simulated result only on a simulated cell's root.

        `ended`: how this one stopped being installed before; None: it never was.
        """
        body = f"{path}\nbecomes what every program of this cell reads. b on 6 undoes it."
        body += "" if ended is None else f"\n\nIt was installed before, and {ended.how} by {ended.by}."
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

    async def _install(self, path: Path, reason: str) -> CalibrationError | None:
        """Install; return the refusal, None when it is installed."""
        cell: Cell = "simulated" if self.status is not None and self.status.simulated else "real"
        try:
            made = await asyncio.to_thread(
                install,
                path,
                state_root(path),
                cell=cell,
                override=reason,
                max_age_days=self.max_age_days,
            )
        except CalibrationError as refusal:
            return refusal
        self.notify("Installed. b on 6 goes back to the one before.")
        self._say_hooks(made)
        return None

    @work(exclusive=True, group="job", exit_on_error=False)
    async def roll_back(self, path: Path, camera: str) -> None:
        """Ask, naming both, then switch back to the calibration before the installed one."""
        root = state_root(path)
        known = installed_versions(root, camera)
        current = next((g for g in known if g.current), None)
        older = before_current(known)
        if current is None or older is None:
            there = "nothing is" if current is None else "only one was ever"
            self.notify(f"There is no older calibration to go back to: {there} installed.")
            return
        body = f"Now: {_named(current)}\nBefore: {_named(older)}\nPrograms then read the one before."
        if not await self.push_screen_wait(
            Confirm("Go back to the calibration before?", body, yes="Go back")
        ):
            return
        made = await self.attempt(asyncio.to_thread(rollback, root, camera=camera))
        if made is not None:
            self.notify("The calibration before is installed again; a drift check proves it (7, k).")
            self._say_hooks(made)

    def _say_hooks(self, version: InstalledVersion) -> None:
        for run in version.hooks:
            if run.failed:
                why = run.problem or f"exit code {run.exit_code}"
                self.notify(f"{run.program}: {why}", title="A hook failed", severity="warning", markup=False)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def export(self, path: Path) -> None:
        chosen = await self.push_screen_wait(ChooseFormat())
        if chosen is None:
            return
        output = path.with_name(f"calibration-{chosen}{FORMATS[chosen].suffix}")

        def write() -> Path:
            calibration, root = read_calibration(path), state_root(path)
            names = FrameNames.of_camera(calibration.camera_name)
            installed = read_installed(root, calibration.camera_name)
            if same_solve(calibration, installed.now):
                follow = follow_command(root, calibration.camera_name)
                names = replace(names, validity=installed.validity, follow=follow)
            write_atomically(output, export(calibration, chosen, names), ASKED_FOR)
            return output

        if await self.attempt(asyncio.to_thread(write)) is not None:
            self.notify(f"Written: {output}", timeout=20, markup=False)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def discard(self, path: Path) -> None:
        body = f"{path}\nis deleted. The recording stays and can be solved again."
        if await self.push_screen_wait(Confirm("Discard this result?", body, yes="Discard")):
            path.unlink(missing_ok=True)
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
