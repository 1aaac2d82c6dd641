"""Result: the verdict of one calibration first, then what was checked, and what installing changes."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from textual import events, work
from textual.app import ComposeResult
from textual.binding import ActiveBinding, Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.content import Content
from textual.widgets import DataTable, Static

from calibrate.files.calibration import Calibration
from calibrate.files.formatting import (
    accuracy_text,
    arm_sentences,
    excluded_text,
    exclusion_sentences,
    figures,
    held_out_text,
    noise_text,
    pendant_texts,
    pose_text,
    use_text,
)
from calibrate.files.install import change_text
from calibrate.files.touch import LIMIT_SIGMAS, agrees, touch_sigmas, touch_text
from calibrate.files.validity import ValidityState, validity_text
from calibrate.results import Gate
from calibrate.words import Word, word_of, words_in, words_of_gates
from recordings.cli.console import open_in_browser
from station.operate.next_step import StepKind, after_solve
from station.protocol.results import Result
from station.tui.frame import WIDE
from station.tui.help import Explained
from station.tui.jobs import install_result, solve_session, undo_install
from station.tui.screen import Box, Rows, StationScreen
from station.tui.task import Action, Known
from station.tui.touch_corners import run_touch_test
from station.tui.view_table import VIEW_COLUMNS, ViewRow, told_of, view_cells, view_rows
from station.tui.words import (
    MARKS,
    VERDICTS,
    Mark,
    dim,
    limit_bar,
    lines,
    local,
    mark,
    sentence,
    shortened,
)

NO_RECORDING = "The recording of this result is not on this station: solve it where it is."
NO_RESULT = "No result yet: F9 solves what was captured. On 5, Enter shows older ones."
CHECK_KEYS = "v: views  Enter explains"
VIEW_KEYS = "v: checks  x: exclude  F9: solve  u: all views  Enter explains"
BAR_CELLS, NAME_CELLS = 12, 27
JOBS = {"install": install_result, "touch test": run_touch_test, "undo": undo_install}
RESULT_GROUPS = ("Result", "Installed")
"""Groups of words that stand first where the words of a result are explained."""
Row = tuple[tuple[Content, ...], str, Word]
"""A row of the table of checks, and what Enter tells of it: what was found, and the word for it."""


def verdict_lines(result: Result) -> Content:
    """Write the verdict, the accuracy in a sentence, what to do, and what was checked."""
    calibration = result.calibration
    if calibration is None:
        return Content(result.problem or NO_RESULT)
    quality = calibration.quality
    became = result.became
    new = "ready to install" if result.verdict == "PASS" else "installs only with a reason"
    said = use_text(calibration)
    if result.verdict == "PASS WITH A REASON":
        said = accuracy_text(calibration)
    sign, _ = MARKS[VERDICTS[result.verdict]]
    verdict = f"{result.verdict}{excluded_text(calibration)}"
    head = f"{sign} {verdict}, {became or new}"
    if result.withdrawn:
        sign, _ = MARKS["failed"]
        head = f"{sign} WITHDRAWN: out of use, programs are refused it. It was {verdict}."
        said = accuracy_text(calibration)
    held_out = held_out_text(calibration)
    beside = f"\n{held_out}." if held_out else ""
    rows = [Content.styled(f"{head}{beside}\n{said}", "bold")]
    if result.installed and (validity := result.state.validity) is not None:
        doubted = validity.state is not ValidityState.VALID
        rows.append(Content.styled(sentence(validity_text(validity)), "bold $warn" if doubted else ""))
    rows += map(Content, _to_do(result, calibration))
    if became and not result.installed and (last := result.state.last) is not None:
        why = f" (“{last.reason}”)" if last.reason else ""
        rows.append(Content(f"The last change: {last.action} by {last.who}, {local(last.wall)}{why}."))
    if calibration.source != "real":
        rows.append(Content.styled(f"{calibration.source.upper()}: never for a real cell.", "$sim"))
    narrow = sum(gate.narrow for gate in quality.gates)
    shown = figures(calibration)
    counted = {key: f"{f.value} {f.label} {f.about}" for key, f in shown.items()}
    told = (
        counted["gates"] + f", {narrow} narrowly" * bool(narrow),
        counted["views"],
        counted.get("touch", "No touch test"),
        f"Session {calibration.provenance.session}",
    )
    return lines(*rows, Content(f"{'. '.join(told)}."))


def _to_do(result: Result, calibration: Calibration) -> Iterator[str]:
    """Yield objections and the way on; of an overridden installation who gave which reason."""
    if (taken := result.taken) is not None:
        yield f"Override by {taken.who}: “{taken.reason}”"
        return
    step = after_solve(calibration, result.objections)
    if step.kind is not StepKind.INSTALL and step.text not in result.objections:
        yield str(step)
    yield from (f"▲ {objection}" for objection in result.objections)


def check_rows(result: Result, calibration: Calibration) -> list[Row]:
    """List everything that was checked: gates (failed and narrow ones first), touched corners, drift."""
    gates = sorted(
        calibration.quality.gates, key=lambda gate: (gate.passed, not gate.narrow, gate.sense is None)
    )
    rows = [_gate_row(gate) for gate in gates]
    for touch in calibration.verification:
        sigmas, name = touch_sigmas(touch), f"touch, corner {touch.corner}"
        kind: Mark = "done" if agrees(touch) else "failed"
        row = _row(kind, name, f"{sigmas:.1f} σ", sigmas, LIMIT_SIGMAS, "≤ 3.0 σ")
        rows.append((row, touch_text(touch), word_of("touch test")))
    for entry in reversed(result.state.drift if result.installed else ()):
        kind = "failed" if not entry.passed else "look" if entry.trend is not None else "done"
        name = time.strftime("drift check %d %b", time.localtime(entry.wall_s))
        value = f"{1000 * float(np.linalg.norm(entry.shift[:3])):.2f} mm"
        row = _row(kind, name, value, entry.statistic, entry.threshold)
        rows.append((row, entry.advice, word_of("drift check")))
    return rows


def _gate_row(gate: Gate) -> Row:
    kind: Mark = "failed" if not gate.passed else "look" if gate.narrow else "done"
    name = gate.title.partition(" (")[0]
    word = words_of_gates().get(gate.name, word_of("gate"))  # a file may tell a gate of a later version
    if gate.sense is None:
        return _row(kind, name), gate.text, word
    limit = f"{gate.sense} {gate.shown(gate.limit)}"
    return _row(kind, name, gate.shown(gate.value), gate.value, gate.limit, limit), gate.text, word


def _row(
    kind: Mark,
    name: str,
    shown: str = "",
    value: float | None = None,
    limit: float | None = None,
    limit_text: str = "",
) -> tuple[Content, ...]:
    """Make the cells of a row: mark and name, value, bar, limit."""
    colour = MARKS[kind][1]
    bar = Content() if value is None or limit is None else limit_bar(value, limit, BAR_CELLS, colour)
    style = "bold $strong" if kind in ("failed", "look") else "$foreground"
    return (
        mark(kind) + Content(" ") + Content.styled(shortened(name, NAME_CELLS), style),
        Content.styled(shown, "bold $strong"),
        bar,
        dim(limit_text),
    )


def evidence(result: Result, calibration: Calibration) -> Content:
    """Write what excluding views and what installing changes, the camera's pose, and the views."""
    return Content("\n\n").join(
        lines(Content.styled(title, "bold $accent"), *rows)
        for title, rows in evidence_sections(result, calibration).items()
    )


def evidence_sections(result: Result, calibration: Calibration) -> dict[str, list[Content]]:
    """Make the sections of the evidence, by their titles."""
    without = exclusion_lines(calibration)
    return {
        **({"Excluded views": without} if without else {}),
        "Change": change_lines(result, calibration),
        "Camera pose": pose_lines(calibration),
        "Views": view_lines(calibration),
    }


def exclusion_lines(calibration: Calibration) -> list[Content]:
    """Compare with the solve of all views, where a person excluded some; u goes back to it."""
    told = [Content(words) for words in exclusion_sentences(calibration)]
    return [*told, dim("u solves with all views again")] if told else []


def change_lines(result: Result, calibration: Calibration) -> list[Content]:
    installed = result.state.now
    if result.withdrawn:
        return [mark("failed", "this one was installed, and is withdrawn")]
    if result.installed:
        return [mark("done", "this one is installed")]
    if result.state.withdrawn:
        return [dim("The one that was installed is withdrawn: nothing is compared with it.")]
    if installed is None:
        return [dim("Nothing is installed yet.")]
    if installed.mount != calibration.mount:
        return [mark("look", f"installed: {installed.mount}, this one: {calibration.mount}")]
    return [Content(f"{change_text(installed, calibration)}, of {local(installed.created)}")]


def pose_lines(calibration: Calibration) -> list[Content]:
    """Write the camera pose, also as pendants show it, its standard uncertainty, and the arm's part in it."""
    result, sigma = calibration.result, calibration.sigma
    written = pendant_texts(calibration)
    return [
        dim(f"{result.parent_frame}_from_{result.child_frame}"),
        *(Content.styled(words.strip(), "bold $strong") for words in pose_text(calibration).split(",")),
        *(Content.assemble((f"{maker:<6}", "$dim"), text) for maker, text in written.items()),
        dim(f"position ± {sigma.translation_mm:.2f} mm, rotation ± {sigma.rotation_deg:.3f}° (1σ)"),
        *map(Content, arm_sentences(calibration)),
    ]


def view_lines(calibration: Calibration) -> list[Content]:
    rejected = (f"view {view.index + 1} rejected: {view.reason}" for view in calibration.views.rejected)
    return [Content(noise_text(calibration)), *(mark("look", text) for text in rejected)]


class Evidence(VerticalScroll):
    """Texts of the result to scroll through; Enter explains their words."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("enter", "screen.explain_words", "Words", show=False)]

    def __init__(self) -> None:
        super().__init__(id="evidence-box", classes="panel")
        self.border_title, self.border_subtitle = "Evidence", "Tab, Enter: its words"


class ResultScreen(StationScreen):
    """The newest calibration, or the one picked from the sessions."""

    MODE, TIP = "result", "The verdict, its checks, install and undo"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("i", "act('install')", "Install", tooltip="Make this the cell's calibration; b undoes it"),
        Binding("b", "act('undo')", "Undo", tooltip="Back to the calibration before, or none"),
        Binding("h", "act('touch test')", "Touch", tooltip="Bring the tip onto corners of the board"),
        Binding("o", "report", "Report", tooltip="Open the report in a browser"),
        # The tables and the one next action name these: the last row has no room.
        Binding("v", "views", "Views", show=False, tooltip="To the table of views, and back to the checks"),
        Binding("x", "exclude", "Exclude", show=False, tooltip="Mark this view to be excluded, or not"),
        Binding("f9", "solve_without", "Solve", tooltip="Solve again without the marked views"),
        Binding("u", "all_views", "All views", show=False, tooltip="Solve again with all views"),
        Binding("d", "app.drift_check", "Check", tooltip="Capture a drift check of what is installed"),
    ]

    _drawn: object = ()
    """The result that was drawn last; a value that no result has before the first."""
    _solve: object = ()
    """Path and time of the solve whose views are marked."""
    _views: Sequence[ViewRow] = ()
    _wanted: frozenset[int] = frozenset()
    """Pose numbers, from 0, of the views that the next solve excludes."""

    def body(self) -> ComposeResult:
        yield Static(NO_RESULT, id="verdict")
        with Horizontal(id="result"):
            with Vertical(id="tables"):
                with Box("Checks", id="checks-box", below=CHECK_KEYS):
                    yield Rows("check", "value", "", "limit", id="checks")
                with Box("Views", id="views-box", below=VIEW_KEYS):
                    yield Rows(*VIEW_COLUMNS, id="views")
            with Evidence():
                yield Static(id="evidence")

    def show(self, known: Known) -> None:
        if known.result is not self._drawn:
            self._draw(known.result)
        super().show(known)

    def _draw(self, result: Result | None) -> None:
        self._drawn = result
        verdict = self.query_one("#verdict", Static)
        doubted = result is not None and result.installed and result.state.doubted
        kind = "" if result is None else "look" if doubted else VERDICTS[result.verdict]
        if result is not None and result.withdrawn:
            kind = "failed"
        verdict.set_classes(f"-{kind}" if kind else "")
        verdict.update(Content(NO_RESULT) if result is None else verdict_lines(result))
        calibration = None if result is None else result.calibration
        self.query_one("#result").display = calibration is not None
        if result is not None and calibration is not None:
            self._rows = check_rows(result, calibration)
            self.query_one("#checks", Rows).show([cells for cells, _, _ in self._rows])
            self._show_views(result.path, calibration)
            self.query_one("#evidence", Static).update(evidence(result, calibration))

    def on_descendant_focus(self, event: events.DescendantFocus) -> None:
        """Mark a row of the table alone that the keys work on."""
        for table in self.query(Rows):
            table.show_cursor = table is event.widget

    def on_resize(self) -> None:
        """Name the tables' keys beside their titles where they have no lower border."""
        narrow = self.size.width < WIDE
        for box, title, keys in (("#checks-box", "Checks", CHECK_KEYS), ("#views-box", "Views", VIEW_KEYS)):
            self.query_one(box).border_title = f"{title}  {keys}" if narrow else title

    def _show_views(self, path: str, calibration: Calibration) -> None:
        """Draw the table of views; marks are kept while it is the same solve."""
        solve = (path, calibration.created)
        if solve != self._solve:
            self._solve = solve
            self._views = view_rows(calibration)
            self._wanted = frozenset(calibration.excluded_views)
            self.query_one("#views", Rows).move_cursor(row=0)
        self._draw_views(calibration)

    def _draw_views(self, calibration: Calibration) -> None:
        self.query_one("#views", Rows).show([view_cells(row, self._wanted) for row in self._views])
        self.NEXT = self._next_solve(calibration)
        self.refresh_bindings()

    def _next_solve(self, calibration: Calibration) -> Action | None:
        """The one next action while marks differ from what was solved."""
        if not self._is_marked(calibration):
            return None
        poses = ", ".join(str(index + 1) for index in sorted(self._wanted))
        what = f"Without pose {poses}." if poses else "With all views."
        return Action("F9", "Solve again", f"{what} x takes a mark back.")

    def _is_marked(self, calibration: Calibration) -> bool:
        return self._wanted != frozenset(calibration.excluded_views)

    @property
    def active_bindings(self) -> dict[str, ActiveBinding]:
        """All keys; F9 stands in the last row while nothing is solved, later the one next action names it."""
        keys = super().active_bindings
        solves = keys.get("f9")
        if solves is not None and self._is_solved:
            keys["f9"] = solves._replace(binding=replace(solves.binding, show=False))
        return keys

    @property
    def _is_solved(self) -> bool:
        return self.known.result is not None and self.known.result.calibration is not None

    def does_something(self, action: str) -> bool:
        result = self.known.result
        calibration = None if result is None else result.calibration
        if action == "all_views":
            return calibration is not None and bool(self._wanted or calibration.excluded_views)
        if action != "solve_without":
            return super().does_something(action)
        if calibration is None:
            return super().does_something("solve_newest")
        return self._is_marked(calibration)

    def on_data_table_row_selected(self, event: DataTable.RowSelected) -> None:
        """Explain a check or a view at Enter."""
        if event.data_table.id == "views":
            row = self._views[event.cursor_row]
            told = told_of(row)
            self.app.push_screen(Explained(f"Pose {row.index + 1}", told, words_in(told)))
            return
        _, text, word = self._rows[event.cursor_row]
        self.app.push_screen(Explained(word.title, text, [word]))

    def action_explain_words(self) -> None:
        """Explain the words of the verdict and of the evidence."""
        result = self.known.result
        if result is not None and result.calibration is not None:
            told = f"{verdict_lines(result)}\n{evidence(result, result.calibration)}"
            used = sorted(words_in(told), key=lambda word: word.group not in RESULT_GROUPS)
            self.app.push_screen(Explained("The words of this result", "", used))

    def action_views(self) -> None:
        """Go to the table of views, or back; where there is no room for both, one takes the other's place."""
        at_views = self._at_views()
        self.query_one("#result").set_class(not at_views, "-views")
        self.query_one("#checks" if at_views else "#views", Rows).focus()

    def _at_views(self) -> bool:
        return self.focused is self.query_one("#views", Rows)

    def action_exclude(self) -> None:
        """Mark the view at the cursor, or take its mark back; nothing is solved before F9."""
        result = self.known.result
        if result is None or result.calibration is None:
            self.notify(NO_RESULT)
            return
        if not self._at_views():
            self.action_views()
            return
        row = self._views[self.query_one("#views", Rows).cursor_row]
        if not row.can_be_used:
            self.notify(f"Pose {row.index + 1} takes no part: {row.reason}", markup=False)
            return
        self._wanted ^= {row.index}
        self._draw_views(result.calibration)
        self.show(self.known)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def action_solve_without(self) -> None:
        """Solve the shown session again, without the marked views."""
        if self.known.result is None or self.known.result.calibration is None:
            await self.app.run_action("solve_newest", self.app)
            return
        await self._solve_again(self.known.result, self._wanted)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def action_all_views(self) -> None:
        """Undo what was excluded, and every mark."""
        result = self.known.result
        calibration = None if result is None else result.calibration
        if result is None or calibration is None:
            self.notify(NO_RESULT)
            return
        self._wanted = frozenset()
        self._draw_views(calibration)
        self.show(self.known)
        if calibration.excluded_views:
            await self._solve_again(result, frozenset())

    async def _solve_again(self, result: Result, without: frozenset[int]) -> None:
        kept = (kept.session for kept in self.known.sessions or () if result.session)
        session = next((session for session in kept if session.name == result.session), None)
        if session is None or not session.recording:
            self.notify(NO_RECORDING)
            return
        await solve_session(self.link, session.recording, session.folder, without)

    def action_report(self) -> None:
        result = self.known.result
        if result is None or not result.report:
            self.notify("There is no report of it: F9 on 5 solves again and writes one.")
        elif not open_in_browser(Path(result.report)):
            self.notify(f"No desktop was found here. The report: {result.report}", timeout=60, markup=False)

    @work(exclusive=True, group="job", exit_on_error=False)
    async def action_act(self, what: str) -> None:
        """Do what a key says with the shown result."""
        result = self.known.result
        if result is None or result.calibration is None:
            self.notify(f"There is no result to {what}: F9 on 5 makes one.")
        else:
            await JOBS[what](self.link, result, result.calibration)
