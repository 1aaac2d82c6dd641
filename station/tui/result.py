"""Solve, Verify, Install: the verdict of one calibration first, then what each step needs of it."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Sequence
from typing import ClassVar

import numpy as np
from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.content import Content
from textual.widgets import DataTable, Static

from calibrate.files.calibration import Calibration
from calibrate.files.formatting import (
    arm_sentences,
    error_text,
    figures,
    noise_text,
)
from calibrate.files.gate import Gate
from calibrate.files.touch import agrees, touch_sigmas
from calibrate.files.validity import ValidityState, validity_text
from calibrate.files.versions import LogEntry
from calibrate.geometry import difference
from station.operate.ending import Way, after_solve
from station.tui.desk import Desk
from station.tui.drift import drift_lines
from station.tui.installed import Result, local
from station.tui.results import discard, export_result, install_result, undo_install
from station.tui.screen import Box, Panel, Rows, StationScreen
from station.tui.task import Known
from station.tui.touch_corners import run_touch_test
from station.tui.words import Mark, dim, facts, limit_bar, lines, mark, shortened, signed

NO_RESULT = "No result yet. F9 solves the session just captured; on 7, Enter shows older ones."
STYLES = {"PASS": "-pass", "PASS WITH A REASON": "-reason", "FAIL": "-fail"}
SIGNS: dict[str, str] = {"PASS": "✓", "PASS WITH A REASON": "▲", "FAIL": "✗"}
BAR_CELLS, NAME_CELLS = 14, 25
INSTALL = "Make this the cell's calibration; b undoes it"
TOUCH_TEST = "Bring the tip onto corners of the board"
EXPORT = "Write it for ROS, OpenCV, URDF … beside the recording"
UNDO = "Back to the calibration before; the first one is taken out of use"
DISCARD = "Delete this result; the recording stays"


def verdict_lines(result: Result) -> Content:
    """Write the verdict, the accuracy in a sentence, objections, and what was checked."""
    calibration = result.calibration
    if calibration is None:
        return Content(result.problem or NO_RESULT)
    quality, failed = calibration.quality, calibration.quality.failed
    ended = result.state.end_of(calibration)
    if result.installed:
        state = result.state.held
    elif ended is not None:
        state = ended.how.upper()
    else:
        state = "ready to install" if result.verdict == "PASS" else "installs only with a reason"
    said = failed[0].text.partition(" FAIL")[0] if failed else error_text(calibration)
    rows = [Content.styled(f"{SIGNS[result.verdict]} {result.verdict}, {state}\n{said}", "bold")]
    if result.installed and (validity := result.state.validity) is not None:
        doubted = validity.state is not ValidityState.VALID
        rows.append(Content.styled(validity_text(validity), "bold $warn" if doubted else ""))
    rows += map(Content, _against(result, calibration))
    if ended is not None:
        rows.append(Content(f"It was installed before, and {ended.how} by {ended.by}. i installs it again."))
    shown = figures(calibration, calibration.verification)
    counted = {key: f"{f.value} {f.label} {f.about}" for key, f in shown.items()}
    narrow = sum(gate.narrow for gate in quality.gates)
    told = (
        counted["gates"] + f", {narrow} narrowly" * bool(narrow),
        counted["views"],
        counted.get("touch", "no touch test"),
        f"session {calibration.provenance.session}",
    )
    if calibration.source != "real":
        rows.append(Content.styled(f"{calibration.source.upper()}: never for a real cell.", "$sim"))
    return lines(*rows, Content(f"{'. '.join(told)}."))


def _against(result: Result, calibration: Calibration) -> list[str]:
    """List objections; of an overridden installation who gave which reason."""
    if result.installed and result.state.now is not None and (taken := result.state.now.override) is not None:
        return [f"Override by {taken.who}: “{taken.reason}”"]
    end = after_solve(calibration, () if result.installed else result.objections)
    others = [] if result.installed else [f"▲ {objection}" for objection in result.objections]
    return others if end.way is Way.INSTALL or end.text in result.objections else [str(end), *others]


def gate_row(gate: Gate) -> tuple[Content, ...]:
    """Make a row of a gate: mark, name, value, bar, limit, pass or fail."""
    kind: Mark = "failed" if not gate.passed else "look" if gate.narrow else "done"
    colour = {"failed": "$bad", "look": "$warn", "done": "$ok"}[kind]
    style = "bold $strong" if kind != "done" else "$foreground"
    short = shortened(gate.title.partition(" (")[0], NAME_CELLS)
    name = mark(kind) + Content(" ") + Content.styled(short, style)
    word = Content.styled({"failed": "FAIL", "look": "narrow", "done": "pass"}[kind], colour)
    if gate.sense is None or gate.value is None or gate.limit is None:
        return name, Content(""), Content(""), Content(""), word
    return (
        name,
        Content.styled(gate.shown(gate.value), "bold $strong"),
        limit_bar(gate.value, gate.limit, BAR_CELLS, colour),
        dim(f"{gate.sense} {gate.shown(gate.limit)}"),
        word,
    )


def change_lines(result: Result, calibration: Calibration) -> Content:
    """Draw what installing would change."""
    installed = result.state.now
    if result.installed:
        return mark("done", "this one is installed")
    if installed is None:
        return dim("Nothing is installed yet.")
    if installed.mount != calibration.mount:
        return mark("look", f"installed: {installed.mount}, this one: {calibration.mount}")
    delta = difference(calibration.transform.matrix, installed.transform.matrix)
    moved_mm, turned_deg = 1000 * np.linalg.norm(delta[:3]), np.degrees(np.linalg.norm(delta[3:]))
    below = f"\nfrom the installed one of {local(installed.created)}"
    moved = facts(("", f"{moved_mm:.2f}", "mm"), ("", f"{turned_deg:.3f}", "°"))
    return moved + dim(below)


def pose_table(result: Result, calibration: Calibration) -> Content:
    """Write the camera pose beside the installed one; positions in millimetres."""
    installed = result.state.now
    beside = installed is not None and not result.installed and installed.mount == calibration.mount
    frame = f"{calibration.result.parent_frame}_from_{calibration.result.child_frame}"
    rows = [dim(f"{frame:<26}" + ("installed        difference" if beside else ""))]
    sigmas = 1000 * np.sqrt(np.diag(np.array(calibration.covariance))[:3])
    for axis, ours, sigma, k in zip("xyz", calibration.result.translation_m, sigmas, range(3), strict=True):
        row = Content.assemble(
            (f"{axis} ", "bold"),
            (f"{signed(1000 * ours):>9}", "bold $strong"),
            (f" ± {sigma:.2f} mm", "$dim"),
        )
        if beside and installed is not None:
            theirs = installed.result.translation_m[k]
            row += dim(f"   {signed(1000 * theirs):>9} mm  {signed(1000 * (ours - theirs)):>8} mm")
        rows.append(row)
    rows.append(dim(f"rotation ± {calibration.sigma.rotation_deg:.3f}° (1σ)"))
    quaternion = " ".join(signed(q, 5) for q in calibration.result.rotation_xyzw)
    rows.append(dim(f"x y z w  {quaternion}"))
    return lines(*rows, *map(Content, arm_sentences(calibration)))


def residual_lines(calibration: Calibration) -> Content:
    """Draw the reprojection error of each view; rejected views with their reason come first."""
    rms = {v.index: v.rms_px for v in calibration.quality.views if v.rms_px is not None}
    limit = next((g.limit for g in calibration.quality.gates if g.name == "view_rms_px"), None)
    rows = [mark("look", f"view {r.index + 1} rejected: {r.reason}") for r in calibration.views.rejected]
    # A limit far above every view would leave nothing to be seen.
    reach = min(limit or math.inf, 4 * max(rms.values(), default=0.0)) or 1.0
    rows.append(dim(f"bars to {reach:.2g} px" + (f", limit {limit:g} px" if limit else "")))
    weights = {v.index: v.weight for v in calibration.views.weights}
    for index, value in sorted(rms.items()):
        doubt = weights.get(index, 1.0) < 0.5
        colour = "$bad" if limit and value > limit else "$warn" if doubt else "$accent"
        bar = limit_bar(value, reach, BAR_CELLS, colour, 1.0)
        suspect = mark("look", " suspect") if doubt else Content()
        rows.append(dim(f"{index + 1:>3} ") + bar + Content(f" {value:.3f} px ") + suspect)
    return lines(*rows)


WORKS: dict[str, Callable[[Desk, Result, Calibration], Awaitable[None]]] = {
    "install": install_result,
    "touch test": run_touch_test,
    "export": export_result,
    "undo": undo_install,
    "discard": discard,
}


class ResultScreen(StationScreen):
    """What Solve, Verify and Install share: the verdict on top, and the keys that act on a result."""

    LOOK = "look_at_results"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("i", "act('install')", "Install", tooltip=INSTALL),
        Binding("h", "act('touch test')", "Touch test", tooltip=TOUCH_TEST),
        Binding("e", "act('export')", "Export", tooltip=EXPORT),
        Binding("b", "act('undo')", "Undo", tooltip=UNDO),
        Binding("x", "act('discard')", "Discard", tooltip=DISCARD),
    ]

    _drawn: object = ()
    """The result that was drawn last; a value that no result has before the first."""

    def body(self) -> ComposeResult:
        yield Static(NO_RESULT, id="verdict")
        with Vertical(id="result"):
            yield from self.evidence()

    def evidence(self) -> ComposeResult:
        yield from ()

    def show(self, known: Known) -> None:
        super().show(known)
        result = known.result
        if result is self._drawn:
            return
        self._drawn = result
        verdict = self.query_one("#verdict", Static)
        verdict.set_classes("" if result is None else STYLES[result.verdict])
        verdict.update(Content(NO_RESULT) if result is None else verdict_lines(result))
        self.query_one("#result").display = result is not None and result.calibration is not None
        if result is not None and result.calibration is not None:
            self.tell(result.calibration)
        self.draw_panels(known)

    def tell(self, calibration: Calibration) -> None:
        """Draw the parts that are not panels."""

    @work(exclusive=True, group="job", exit_on_error=False)
    async def action_act(self, what: str) -> None:
        """Do what a key says with the shown result."""
        result = self.known.result
        if result is None or result.calibration is None:
            self.notify(f"There is no result to {what}: F9 on 7 makes one.")
        else:
            await WORKS[what](self.desk, result, result.calibration)


def _panel(
    title: str, text: Callable[[Result, Calibration, int, int], Content], *, id: str, below: str = ""
) -> Panel:
    """Make a panel that is drawn from the shown result; `text` also gets width and height."""

    def body(known: Known, width: int, height: int) -> Content:
        result = known.result
        if result is None or result.calibration is None:
            return Content()
        return text(result, result.calibration, width, height)

    return Panel(title, body, id=id, below=below)


class SolveScreen(ResultScreen):
    """The gates with value and limit, and the reprojection error of each view."""

    MODE, TIP = "solve", "The verdict, and what it stands on"
    HELP = (
        "The newest result, or the one picked on 7. Enter on a gate shows its details. Installing can be "
        "undone."
    )

    def evidence(self) -> ComposeResult:
        with Horizontal(id="solve"):
            with Box("Quality gates", id="gates-box", below="Enter tells why"):
                yield Rows("gate", "value", "", "limit", "", id="gates")
            with VerticalScroll(id="residuals-box", classes="panel"):
                yield Static(id="residuals")

    def tell(self, calibration: Calibration) -> None:
        self._gates = sorted(calibration.quality.gates, key=lambda gate: (gate.passed, not gate.narrow))
        self.query_one(Rows).show([gate_row(gate) for gate in self._gates])
        passed = sum(gate.passed for gate in self._gates)
        self.query_one("#gates-box").border_title = f"Quality gates  {passed} of {len(self._gates)} passed"
        self.query_one("#residuals-box").border_title = "Reprojection error per view"
        self.query_one("#residuals", Static).update(residual_lines(calibration))

    def on_data_table_row_selected(self, event: DataTable.RowSelected) -> None:
        self.notify(self._gates[event.cursor_row].text, timeout=10, markup=False)


class VerifyScreen(ResultScreen):
    """Independent evidence: the touch test, held-out views, and drift checks over time."""

    MODE, TIP = "verify", "Touch test and drift checks"
    HELP = "h starts the touch test: a tip on corners of the board, by hand. d on 7 captures a drift check."

    def evidence(self) -> ComposeResult:
        with Horizontal(id="verify"):
            yield _panel("Touch test", lambda r, c, w, h: touch_lines(c), id="touches", below="h starts it")
            yield _panel("Held-out views", lambda r, c, w, h: held_out_lines(c), id="held-out")
        yield _panel(
            "Drift checks of the installed calibration",
            lambda r, c, w, h: drift_lines(r.drift, w, h),
            id="drift",
            below="d on 7 captures one",
        )


def touch_lines(calibration: Calibration) -> Content:
    if not calibration.verification:
        return Content("\n").join(
            [
                mark("todo", "not yet"),
                Content("The one check that needs no mathematics: a pointer's tip"),
                Content("is put over corners of the board, and your hand tells how"),
                Content("far it lands beside them. Every motion asks first."),
            ]
        )
    rows = []
    for touch in calibration.verification:
        x, y = touch.offset_mm
        kind: Mark = "done" if agrees(touch) else "failed"
        rows.append(
            mark(kind, f"corner {touch.corner:>3}")
            + Content("  ")
            + facts(
                ("x", signed(x), ""),
                ("y", signed(y), "mm"),
                ("", f"{touch_sigmas(touch):.1f}", "σ of at most 3.0"),
            )
        )
    return lines(*rows)


def held_out_lines(calibration: Calibration) -> Content:
    folds = calibration.quality.cross_validation
    held_out = figures(calibration).get("held_out")
    rows = [dim("no views were held out")]
    if held_out is not None:
        rows = [facts(("", held_out.value, f"{held_out.label} {held_out.about}"))]
    if folds is not None:
        rows.append(
            facts(
                ("left-out views:", f"{folds.rms_mm:.2f}", "mm"), ("claimed", f"{folds.claimed_mm:.2f}", "mm")
            )
        )
    return lines(*rows, Content(noise_text(calibration)))


class InstallScreen(ResultScreen):
    """The camera pose beside the installed one, the change, and every earlier installation."""

    MODE, TIP = "install", "What is installed, and what would change"
    HELP = "i installs the shown calibration, b undoes that; e writes it for other programs."

    def evidence(self) -> ComposeResult:
        with Horizontal(id="install"):
            yield _panel("Camera pose", lambda r, c, w, h: pose_table(r, c), id="answer")
            yield _panel(
                "What installing does",
                lambda r, c, w, h: install_lines(r, c),
                id="change",
                below="i installs  b undoes it",
            )
        yield _panel("Installed so far", lambda r, c, w, h: log_lines(r.log, h), id="versions")


def install_lines(result: Result, calibration: Calibration) -> Content:
    told = dim("Every program that reads this cell's calibration gets it at once.")
    return lines(change_lines(result, calibration), told)


def log_lines(entries: Sequence[LogEntry], height: int) -> Content:
    if not entries:
        return dim("Nothing was installed yet.")
    return Content("\n").join(
        Content.assemble(
            (f"{local(entry.wall)}  ", "$dim"),
            (f"{entry.action:<9}", "bold $strong"),
            f"version {entry.generation}  ",
            (f"{entry.who}  {entry.change}", "$dim"),
            (f"  “{entry.reason}”" if entry.reason else "", "$warn"),
        )
        for entry in reversed(entries[-max(1, height) :])
    )
