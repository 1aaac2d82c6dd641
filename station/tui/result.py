"""Result: the gates first, then the camera pose with its uncertainty, then the views."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
from rich.text import Text
from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, VerticalScroll
from textual.widgets import Static

from calibrate.errors import CalibrationError
from calibrate.files.calibration import Calibration, read_calibration
from calibrate.files.formatting import arm_sentences
from calibrate.files.install import objections_beside
from calibrate.files.validity import ValidityState, validity_text
from calibrate.files.verification import agrees, touch_text
from calibrate.files.versions import same_solve
from calibrate.geometry import difference
from station.tui.installed import LOOK_S, Ended, Installed, Marks, marks, read_installed, state_root
from station.tui.screen import StationScreen

NO_RESULT = "No result yet. F9 solves the session just captured; on screen 4, v shows older ones."
NOTHING = Installed()
BAR_CELLS = 24
REASONED = {False: "installs only with a reason", True: "installed, overridden"}


def ended_words(end: Ended) -> str:
    return f"It was installed before, and {end.how} by {end.by}"


def verdict_text(
    calibration: Calibration, state: Installed = NOTHING, objections: Sequence[str] = ()
) -> Text:
    """The checklist: what passed, what failed and what to do about it.

    `objections`: what else installing would ask a reason for.
    """
    installed, end = same_solve(calibration, state.now), state.end_of(calibration)
    gates = sorted(calibration.quality.gates, key=lambda gate: gate.passed)  # the failed ones first
    touches = sorted(calibration.verification, key=agrees)
    against = [
        _many(len(calibration.quality.failed), "GATE") + " FAILED",
        _many(sum(not agrees(touch) for touch in touches), "CORNER") + " OFF IN THE TOUCH TEST",
        _many(len(objections), "OBJECTION"),
    ]
    against = [words for words in against if not words.startswith("0 ")]
    stamp = "" if calibration.source == "real" else f"{calibration.source.upper()}: never for a real cell\n"
    ready = state.held if installed else end.how.upper() if end else "READY TO INSTALL"
    head = ", ".join(against) + f": {REASONED[installed]}" if against else ready
    text = Text().append(stamp, "bold").append(f"{head}\n", "bold reverse" if against else "bold")
    if installed and state.now is not None and (taken := state.now.override) is not None:
        text.append(f"Override by {taken.who}: “{taken.reason}”\n")
    if installed and state.validity is not None:
        doubted = state.validity.state is not ValidityState.VALID
        text.append(f"{validity_text(state.validity)}\n", "bold reverse" if doubted else "")
    if end is not None:
        text.append(f"{ended_words(end)}. i installs it again\n")
    text.append(f"session {calibration.provenance.session}\n")
    for passed, words in (
        *((False, words) for words in objections),
        *((agrees(touch), f"touch test, {touch_text(touch)}") for touch in touches),
        *((gate.passed, gate.text) for gate in gates),
    ):
        text.append(f"\n[{'ok' if passed else 'FAIL'}] ", style="" if passed else "bold reverse")
        text.append(words)
    return text


def _many(count: int, what: str) -> str:
    return f"{count} {what}{'S' * (count != 1)}"


def answer_text(calibration: Calibration) -> Text:
    """The camera pose in millimetres and degrees, with standard uncertainties (1σ)."""
    result, quality = calibration.result, calibration.quality
    x, y, z = (1000 * v for v in result.translation_m)
    sx, sy, sz = 1000 * np.sqrt(np.diag(np.array(calibration.covariance))[:3])
    lines = [
        f"{result.parent_frame}_from_{result.child_frame}",
        f"x {x:9.2f} ± {sx:.2f} mm",
        f"y {y:9.2f} ± {sy:.2f} mm",
        f"z {z:9.2f} ± {sz:.2f} mm",
        "quaternion " + " ".join(f"{q:.5f}" for q in result.rotation_xyzw),
        f"rotation ± {calibration.sigma.rotation_deg:.3f}°",
    ]
    if quality.predicted_error_mm is not None and quality.working_distance_m is not None:
        lines.append(f"a point at {quality.working_distance_m:.2f} m: ± {quality.predicted_error_mm:.2f} mm")
    if quality.holdout is not None:
        e_t, e_R = quality.holdout.e_t_m, quality.holdout.e_R
        lines.append(f"held-out error e_t {1000 * e_t:.2f} mm, e_R {e_R:.4f}")
    return Text("\n".join([*lines, *arm_sentences(calibration), *quality.warnings]))


def residual_text(calibration: Calibration) -> Text:
    """Rejected views with their reasons, then reprojection per view as bars."""
    rms = {v.index: v.rms_px for v in calibration.quality.views if v.rms_px is not None}
    longest = max(rms.values(), default=1.0)
    lines = [
        f"{index + 1:>3} {'█' * max(1, round(BAR_CELLS * value / longest)):<{BAR_CELLS}} {value:.2f} px"
        for index, value in sorted(rms.items())
    ]
    rejected = [f"{r.index + 1:>3} REJECTED {r.name}: {r.reason}" for r in calibration.views.rejected]
    return Text("\n".join([*rejected, "reprojection error per view", *lines]))


def change_text(calibration: Calibration, installed: Calibration | None) -> Text:
    """Describe what installing would change."""
    if installed is None:
        return Text("\nnothing is installed yet")
    if same_solve(calibration, installed):
        return Text("\nthis one is installed")
    if installed.mount != calibration.mount:
        return Text(f"\ninstalled: {installed.mount}, this one: {calibration.mount}")
    delta = difference(calibration.transform.matrix, installed.transform.matrix)
    moved_mm, turned_deg = 1000 * np.linalg.norm(delta[:3]), np.degrees(np.linalg.norm(delta[3:]))
    return Text(
        f"\nagainst the installed one the camera is {moved_mm:.2f} mm and {turned_deg:.3f}° elsewhere"
    )


class ResultScreen(StationScreen):
    """A calibration file: its verdict, its numbers, and what may be done with it."""

    HELP = "The newest result, or the one picked on the sessions screen. Installing can be undone."
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("i", "install", "Install", tooltip="Make this the cell's calibration; b undoes it"),
        Binding("b", "roll_back", "Back", tooltip="Back to the calibration that was installed before"),
        Binding("h", "touch_test", "Touch test", tooltip="Bring the tip onto corners of the board"),
        Binding("e", "export", "Export", tooltip="Write it for ROS, OpenCV, URDF … beside the recording"),
        Binding("x", "discard", "Discard", tooltip="Delete this result; the recording stays"),
    ]

    def __init__(self) -> None:
        super().__init__()
        self._calibration: Calibration | None = None
        self._loaded = ""
        """Its file; the one to be shown next may be another already."""
        self._state = NOTHING
        self._marks: Marks = frozenset()

    def body(self) -> ComposeResult:
        with Horizontal(id="result"):
            with VerticalScroll(id="result-left"):
                yield Static(NO_RESULT, id="verdict")
            with VerticalScroll(id="result-right"):
                yield Static(id="answer")
                yield Static(id="change")
                yield Static(id="residuals")

    def on_mount(self) -> None:
        self.query_one("#result-left").focus()
        self.watch(self.desk, "result_path", self._picked, init=False)
        self.set_interval(LOOK_S, self.look_again)

    def on_screen_resume(self) -> None:
        super().on_screen_resume()
        self.load()

    def _picked(self) -> None:
        self.load()

    async def look_again(self) -> None:
        """Another screen or a shell may have installed, gone back or solved again."""
        path = self._shown
        if not path or not self.is_current:
            return
        before, self._marks = self._marks, await asyncio.to_thread(marks, state_root(path))
        if self._marks != before:
            self.load()

    @property
    def _shown(self) -> str:
        """The file that was picked, else that of the session just captured; empty: neither."""
        status = self.desk.status
        return self.desk.result_path or (status.session.calibration if status is not None else "")

    @work(exclusive=True, group="load", exit_on_error=False)
    async def load(self) -> None:
        path = self._shown
        found, why, objections = None, NO_RESULT, []
        if path:
            try:
                root = state_root(path)
                found = await asyncio.to_thread(read_calibration, Path(path))
                self._state = await asyncio.to_thread(read_installed, root, found.camera_name)
                objections = await asyncio.to_thread(objections_beside, found, root)
            except CalibrationError as problem:
                why = str(problem)
        self._calibration, self._loaded = found, path  # only now: keys work on what is shown
        texts = [Text(why), Text(), Text(), Text()]
        if found is not None:
            change = change_text(found, self._state.now)
            verdict = verdict_text(found, self._state, objections)
            texts = [verdict, answer_text(found), change, residual_text(found)]
        for name, text in zip(("verdict", "answer", "change", "residuals"), texts, strict=True):
            self.query_one(f"#{name}", Static).update(text)

    def _path(self) -> str | None:
        if self._calibration is None:
            self.notify("There is no result to use: F9 on the sessions screen makes one.")
            return None
        return self._loaded

    def action_install(self) -> None:
        if (path := self._path()) is not None and self._calibration is not None:
            end = self._state.end_of(self._calibration)
            self.desk.install(path, f"{ended_words(end)}." if end is not None else "")

    def action_roll_back(self) -> None:
        if (path := self._path()) is not None:
            self.desk.roll_back(path)

    def action_touch_test(self) -> None:
        if (path := self._path()) is not None:
            self.desk.touch_test(path)

    def action_export(self) -> None:
        if (path := self._path()) is not None:
            self.desk.export(path)

    def action_discard(self) -> None:
        if (path := self._path()) is not None:
            self.desk.discard(path)
