"""Solve, Verify, Install: the verdict of one calibration first, then what each step needs of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.content import Content
from textual.widgets import DataTable, Static

from calibrate.files.calibration import Calibration
from calibrate.files.formatting import arm_sentences
from calibrate.files.gate import Gate
from calibrate.files.validity import ValidityState, validity_text
from calibrate.files.verification import agrees, touch_sigmas
from calibrate.files.versions import LogEntry, read_log
from calibrate.geometry import difference
from calibrate.quality.checks import FEWEST_FOR_TREND, CheckEntry, find_trend
from station.operate.ending import Way, after_drift_check, after_solve
from station.tui.installed import Result, drift_history, local, state_root
from station.tui.screen import Box, Panel, Rows, StationScreen
from station.tui.task import Known
from station.tui.touch_test import run_touch_test
from station.tui.widgets.canvas import Series, curve
from station.tui.words import UNKNOWN, Mark, facts, limit_bar, many, mark, shortened, signed

NO_RESULT = "No result yet. F9 solves the session just captured; on 7, Enter shows older ones."
STYLES = {"PASS": "-pass", "PASS WITH A REASON": "-reason", "FAIL": "-fail"}
SIGNS: dict[str, str] = {"PASS": "✓", "PASS WITH A REASON": "▲", "FAIL": "✗"}
BAR_CELLS, NAME_CELLS = 14, 25


def verdict_lines(result: Result) -> Content:
    """The verdict; the accuracy in a sentence; what speaks against it; what was checked."""
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
    rows = [Content.styled(f"{SIGNS[result.verdict]} {result.verdict}, {state}", "bold")]
    rows.append(Content.styled(f"  {_accuracy(calibration)}", "bold"))
    if result.installed and (validity := result.state.validity) is not None:
        doubted = validity.state is not ValidityState.VALID
        rows.append(Content.styled(f"  {validity_text(validity)}", "bold $warn" if doubted else ""))
    rows += [Content(f"  {why}") for why in _against(result, calibration)]
    if ended is not None:
        rows.append(
            Content(f"  It was installed before, and {ended.how} by {ended.by}. i installs it again.")
        )
    narrow, touches = sum(gate.narrow for gate in quality.gates), calibration.verification
    gates = f"{len(quality.gates) - len(failed)} of {len(quality.gates)} gates passed"
    said = [
        gates + f", {narrow} narrowly" * bool(narrow),
        f"{many(len(calibration.views.rejected), 'view')} rejected",
        f"touch test: {sum(map(agrees, touches))} of {len(touches)} corners" if touches else "no touch test",
        f"session {calibration.provenance.session}",
    ]
    if calibration.source != "real":
        said.append(f"{calibration.source.upper()}: never for a real cell")
    return Content("\n").join([*rows, Content(f"  {'. '.join(said)}.")])


def _accuracy(calibration: Calibration) -> str:
    """The gate that failed, or how far a point may be off."""
    quality = calibration.quality
    if quality.failed:
        return quality.failed[0].text.partition(" FAIL")[0]
    if quality.predicted_error_mm is None or quality.working_distance_m is None:
        return (
            f"Standard uncertainty of the camera's position: {calibration.sigma.translation_mm:.2f} mm (1σ)."
        )
    judged = next((gate for gate in quality.gates if gate.name == "predicted_error_m"), None)
    limit = f" The limit is {judged.shown(judged.limit)}." if judged is not None else ""
    at = f"Predicted error at {quality.working_distance_m:.2f} m"
    return f"{at}: {quality.predicted_error_mm:.2f} mm (1σ).{limit}"


def _against(result: Result, calibration: Calibration) -> list[str]:
    """Say what speaks against it, or who installed it all the same."""
    if result.installed and result.state.now is not None and (taken := result.state.now.override) is not None:
        return [f"Override by {taken.who}: “{taken.reason}”"]
    end = after_solve(calibration, () if result.installed else result.objections)
    others = [] if result.installed else [f"▲ {objection}" for objection in result.objections]
    return others if end.way is Way.INSTALL or end.text in result.objections else [str(end), *others]


def gate_row(gate: Gate) -> tuple[Content, ...]:
    """Mark, name, value, bar, limit, word."""
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
        Content.styled(f"{gate.sense} {gate.shown(gate.limit)}", "$dim"),
        word,
    )


def accuracy_card(calibration: Calibration) -> Content:
    quality = calibration.quality
    if quality.predicted_error_mm is None:
        return facts(("", f"± {calibration.sigma.translation_mm:.2f}", "mm, camera position (1σ)"))
    far = f"of a point {quality.working_distance_m or 0:.2f} m away (1σ)"
    return _card(far, ("", f"± {quality.predicted_error_mm:.2f}", "mm"))


def _card(below: str, *values: tuple[str, str, str]) -> Content:
    return facts(*values) + Content("\n") + Content.styled(below, "$dim")


def proof_card(calibration: Calibration) -> Content:
    held = calibration.quality.holdout
    if held is None:
        return Content.styled(f"{UNKNOWN} no views were held out", "$dim")
    below = f"held-out error over {many(len(held.pairs), 'sample')}"
    return _card(below, ("", f"{1000 * held.e_t_m:.2f}", "mm"), ("", f"{held.e_R:.4f}", "rotation"))


def change_card(result: Result, calibration: Calibration) -> Content:
    """Draw what installing would change."""
    installed = result.state.now
    if result.installed:
        return mark("done", "this one is installed")
    if installed is None:
        return Content.styled("Nothing is installed yet.", "$dim")
    if installed.mount != calibration.mount:
        return mark("look", f"installed: {installed.mount}, this one: {calibration.mount}")
    delta = difference(calibration.transform.matrix, installed.transform.matrix)
    moved_mm, turned_deg = 1000 * np.linalg.norm(delta[:3]), np.degrees(np.linalg.norm(delta[3:]))
    below = f"from the installed one of {local(installed.created)}"
    return _card(below, ("", f"{moved_mm:.2f}", "mm"), ("", f"{turned_deg:.3f}", "°"))


def pose_table(result: Result, calibration: Calibration) -> Content:
    """The camera pose, this one beside the installed one; positions in millimetres."""
    installed = result.state.now
    beside = installed is not None and not result.installed and installed.mount == calibration.mount
    frame = f"{calibration.result.parent_frame}_from_{calibration.result.child_frame}"
    rows = [Content.styled(f"{frame:<26}" + ("installed        difference" if beside else ""), "$dim")]
    sigmas = 1000 * np.sqrt(np.diag(np.array(calibration.covariance))[:3])
    for axis, ours, sigma, k in zip("xyz", calibration.result.translation_m, sigmas, range(3), strict=True):
        row = Content.assemble(
            (f"{axis} ", "bold"),
            (f"{signed(1000 * ours):>9}", "bold $strong"),
            (f" ± {sigma:.2f} mm", "$dim"),
        )
        if beside and installed is not None:
            theirs = installed.result.translation_m[k]
            row += Content.styled(
                f"   {signed(1000 * theirs):>9} mm  {signed(1000 * (ours - theirs)):>8} mm", "$dim"
            )
        rows.append(row)
    rows.append(Content.styled(f"rotation ± {calibration.sigma.rotation_deg:.3f}° (1σ)", "$dim"))
    quaternion = " ".join(signed(q, 5) for q in calibration.result.rotation_xyzw)
    rows.append(Content.styled(f"x y z w  {quaternion}", "$dim"))
    return Content("\n").join([*rows, *map(Content, arm_sentences(calibration))])


def residual_lines(calibration: Calibration, width: int, height: int) -> Content:
    """Reprojection error per view against the limit; rejected views with their reason first."""
    rms = {v.index: v.rms_px for v in calibration.quality.views if v.rms_px is not None}
    limit = next((g.limit for g in calibration.quality.gates if g.name == "view_rms_px"), None)
    scale = limit or max(rms.values(), default=1.0)
    rows = [mark("look", f"view {r.index + 1} rejected: {r.reason}") for r in calibration.views.rejected]
    cells = max(8, width - 18)
    # A limit far above every view would leave nothing to be seen.
    shown = max([4 * max(rms.values(), default=0.0)], default=scale)
    reach = min(scale, shown) or 1.0
    rows.append(
        Content.styled(f"bars to {reach:.2g} px" + (f", limit {limit:g} px" if limit else ""), "$dim")
    )
    weights = {v.index: v.weight for v in calibration.views.weights}
    for index, value in sorted(rms.items()):
        doubt = weights.get(index, 1.0) < 0.5
        colour = "$bad" if limit and value > limit else "$warn" if doubt else "$accent"
        row = Content.styled(f"{index + 1:>3} ", "$dim") + limit_bar(value, reach, cells, colour, 1.0)
        rows.append(
            row + Content.assemble((f" {value:.3f} px", "$foreground"), (" suspect" * doubt, "$warn"))
        )
    return Content("\n").join(rows)


class ResultScreen(StationScreen):
    """Common base of the three: the verdict on top, and what may be done with a calibration."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("i", "act('install')", "Install", tooltip="Make this the cell's calibration; b undoes it"),
        Binding("h", "act('test')", "Touch test", tooltip="Bring the tip onto corners of the board"),
        Binding(
            "e", "act('export')", "Export", tooltip="Write it for ROS, OpenCV, URDF … beside the recording"
        ),
        Binding(
            "b", "act('roll back')", "Roll back", tooltip="Back to the calibration that was installed before"
        ),
        Binding("x", "act('discard')", "Discard", tooltip="Delete this result; the recording stays"),
    ]

    def body(self) -> ComposeResult:
        yield Static(NO_RESULT, id="verdict")
        with Vertical(id="result"):
            yield from self.evidence()

    def evidence(self) -> ComposeResult:
        yield from ()

    def on_mount(self) -> None:
        self.watch(self.desk, "result", self._changed, init=False)

    def _changed(self) -> None:
        self.show(self.desk.known())

    def on_screen_resume(self) -> None:
        super().on_screen_resume()
        self.desk.look_at_results()

    def show(self, known: Known) -> None:
        super().show(known)
        result = known.result
        if result is getattr(self, "_drawn", ()):
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
        """Fill what is no panel."""

    def action_act(self, what: str) -> None:
        result = self.desk.result
        if result is None or result.calibration is None:
            self.notify(f"There is no result to {what}: F9 on 7 makes one.")
            return
        desk, path = self.desk, Path(result.path)
        match what:
            case "install":
                desk.install(path, result.state.end_of(result.calibration))
            case "roll back":
                desk.roll_back(path, result.calibration.camera_name)
            case "export":
                desk.export(path)
            case "discard":
                desk.discard(path)
            case "test":
                work = self._touch_test(path)
                desk.run_worker(work, group="job", exclusive=True, exit_on_error=False)

    async def _touch_test(self, path: Path) -> None:
        if await run_touch_test(self.desk, path):
            await self.desk.show_result(str(path))


def _panel(
    title: str, text: Callable[[Result, Calibration, int, int], Content], *, id: str, below: str = ""
) -> Panel:
    """A panel of the shown result: `text` of it, and of the room."""

    def body(known: Known, width: int, height: int) -> Content:
        result = known.result
        if result is None or result.calibration is None:
            return Content()
        return text(result, result.calibration, width, height)

    return Panel(title, body, id=id, below=below)


class SolveScreen(ResultScreen):
    """The gates with value and limit, the camera pose, the views."""

    MODE, TIP = "solve", "The verdict, and what it stands on"
    HELP = (
        "The newest result, or the one picked on 7. Enter on a gate shows its details. Installing can be "
        "undone."
    )

    def evidence(self) -> ComposeResult:
        with Horizontal(id="cards"):
            yield _panel("Accuracy", lambda r, c, w, h: accuracy_card(c), id="accuracy")
            yield _panel("Proof", lambda r, c, w, h: proof_card(c), id="proof")
            yield _panel("Change", lambda r, c, w, h: change_card(r, c), id="change")
        with Horizontal(id="solve"):
            with Vertical(id="solve-left"):
                with Box("Quality gates", id="gates-box", below="Enter tells why"):
                    yield Rows("gate", "value", "", "limit", "", id="gates")
                yield _panel("Camera pose", lambda r, c, w, h: pose_table(r, c), id="answer")
            yield _panel(
                "Reprojection error per view",
                lambda r, c, w, h: residual_lines(c, w, h),
                id="residuals",
                below="reprojection error",
            )

    def on_mount(self) -> None:
        super().on_mount()
        self.query_one(Rows).focus()

    def tell(self, calibration: Calibration) -> None:
        self._gates = sorted(calibration.quality.gates, key=lambda gate: (gate.passed, not gate.narrow))
        self.query_one(Rows).show([gate_row(gate) for gate in self._gates])
        passed = sum(gate.passed for gate in self._gates)
        self.query_one("#gates-box").border_title = f"Quality gates  {passed} of {len(self._gates)} passed"

    def on_data_table_row_selected(self, event: DataTable.RowSelected) -> None:
        self.notify(self._gates[event.cursor_row].text, timeout=10, markup=False)


class VerifyScreen(ResultScreen):
    """Proofs apart from the images it was made of: the touch test, and drift checks over time."""

    MODE, TIP = "verify", "Touch test and drift checks"
    HELP = "h starts the touch test: a tip over corners of the board, by hand. d on 7 captures a drift check."

    def evidence(self) -> ComposeResult:
        with Horizontal(id="verify"):
            yield _panel("Touch test", lambda r, c, w, h: touch_lines(c), id="touches", below="h starts it")
            yield _panel("Held-out views", lambda r, c, w, h: held_out_lines(c), id="held-out")
        yield _panel(
            "Drift checks of the installed calibration",
            lambda r, c, w, h: drift_lines(drift_history(state_root(r.path), c.camera_name), w, h),
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
    return Content("\n").join(rows)


def held_out_lines(calibration: Calibration) -> Content:
    folds = calibration.quality.cross_validation
    rows = [proof_card(calibration)]
    if folds is not None:
        rows.append(
            facts(
                ("left-out views:", f"{folds.rms_mm:.2f}", "mm"), ("claimed", f"{folds.claimed_mm:.2f}", "mm")
            )
        )
    if calibration.quality.noise:
        noise = calibration.quality.noise
        rows.append(
            facts(
                ("robot", f"{noise['robot_mm']:.3f}", "mm"),
                ("", f"{noise['robot_deg']:.4f}", "°"),
                ("corners", f"{noise['corner_px']:.3f}", "px (1σ)"),
            )
        )
    return Content("\n").join(rows)


def drift_lines(entries: Sequence[CheckEntry], width: int, height: int) -> Content:
    """The camera's shift over time against what would be found, and a sentence; from five checks on."""
    if not entries:
        return Content.styled("No drift check yet. d on 7 captures one: eight poses, two minutes.", "$dim")
    trend = find_trend(entries, entries[-1].generation)
    end = after_drift_check(entries[-1], "" if trend is None else trend.text)
    shifts = [1000 * float(np.linalg.norm(entry.shift[:3])) for entry in entries]
    kind: Mark = "done" if end.way is Way.KEEP else "look" if entries[-1].passed else "failed"
    head = facts(("", f"{shifts[-1]:.2f}", "mm")) + Content("  ") + mark(kind, str(end))
    days = [(entry.wall_s - entries[0].wall_s) / 86400 for entry in entries]
    limits = [
        s * np.sqrt(e.threshold / e.statistic)
        for s, e in zip(shifts, entries, strict=True)
        if e.statistic > 0
    ]
    limit = float(np.median(limits)) if limits else None
    if len(entries) < FEWEST_FOR_TREND:
        said = f"{many(len(entries), 'check')}: too few to say whether it drifts."
    elif trend is None:
        said = f"No trend in {len(entries)} checks."
    else:
        rate = trend.shift_mm / max(trend.days, 1e-9)
        left = (limit - shifts[-1]) / rate if limit is not None and rate > 0 else 0.0
        soon = f" The limit is reached in about {_span(left)}." if left > 0 else " The limit is reached."
        said = f"Rising by {7 * rate:.2f} mm a week.{soon}"
    drawn = curve(
        [Series(list(zip(days, shifts, strict=True)), "$accent")],
        limit,
        width,
        height - 2,
        log=False,
        ends=f"{_day(entries[0])}|{_day(entries[-1])}",
    )
    return Content("\n").join([head, Content.styled(said, "$foreground"), drawn])


def _day(entry: CheckEntry) -> str:
    return time.strftime("%d %b", time.localtime(entry.wall_s))


def _span(days: float) -> str:
    return many(round(days / 7), "week") if days >= 14 else many(max(1, round(days)), "day")


class InstallScreen(ResultScreen):
    """Comparison with the installed one, what speaks against this one, and every version before."""

    MODE, TIP = "install", "What is installed, and what would change"
    HELP = "i installs the shown calibration, b goes back to the one before; e writes it for other programs."

    def evidence(self) -> ComposeResult:
        with Horizontal(id="install"):
            yield _panel("Camera pose", lambda r, c, w, h: pose_table(r, c), id="answer")
            yield _panel(
                "What installing does",
                lambda r, c, w, h: install_lines(r, c),
                id="change",
                below="i installs  b rolls back",
            )
        yield _panel(
            "Installed so far", lambda r, c, w, h: log_lines(_log(r.path, c.camera_name), h), id="versions"
        )


def install_lines(result: Result, calibration: Calibration) -> Content:
    rows = [change_card(result, calibration)]
    rows += [mark("look", objection) for objection in result.objections if not result.installed]
    if calibration.source != "real":
        rows.append(
            Content.styled(f"{calibration.source.upper()}: for this {calibration.source} cell only.", "$sim")
        )
    rows.append(Content.styled("Every program that reads this cell's calibration gets it at once.", "$dim"))
    return Content("\n").join(rows)


def _log(path: str, camera: str) -> Sequence[LogEntry]:
    try:
        return read_log(state_root(path), camera)
    except OSError:
        return ()


def log_lines(entries: Sequence[LogEntry], height: int) -> Content:
    if not entries:
        return Content.styled("Nothing was installed yet.", "$dim")
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
