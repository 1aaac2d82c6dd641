"""Plan: every pose with its gain and reason, the cell around it; skip, retake."""

from __future__ import annotations

from typing import ClassVar

from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal
from textual.content import Content

from calibrate.arms.without_joints import joints_would_win
from station.cell.status import PoseStatus
from station.operate.goal import above_goal
from station.operate.motion import PREPARE_S
from station.protocol.verbs import MakePlan, Retake, Skip
from station.tui.capture_panels import errors_after
from station.tui.frame import Line
from station.tui.progress import pose_mark
from station.tui.screen import Box, Panel, Rows, StationScreen
from station.tui.task import Known, beyond_goal
from station.tui.widgets.cell_drawing import LEGEND, draw
from station.tui.words import ERROR_SHOWN_MM, MARKS, UNKNOWN, dim, error_facts, facts, mark

COLUMNS = ("#", "error", "state", "reason")
NO_PLAN = "No plan yet: F5 makes one and asks, n only makes it."
BY_HAND = "A person moves this arm: F3 takes views, and needs no plan."
RETAKE = "Capture this pose again at the next run; the view it has counts until then"
FAILED = "Capture all failed poses again at the next run"
SKIP = "Skip this pose; of a captured one only its retake"
NEW = "Plan 25 poses: takes some seconds, nothing moves"
NEW_PLAN = MakePlan(25, seed=1)
POSE_VERBS = {"retake": Retake, "skip": Skip}


def by_hand(known: Known) -> str:
    """Say that nothing is planned here, and what joints would win where the arm tells none."""
    robot = known.shown.robot
    if robot.state is None or robot.state.joints_rad:
        return BY_HAND
    told = "" if known.configuration is None else known.configuration.robot.arm_class
    return f"{BY_HAND} {joints_would_win(robot.model, told)}"


def row_of(pose: PoseStatus, error_mm: float | None) -> tuple[Content, ...]:
    """Make a row of the table."""
    shown = f"{error_mm:6.2f}" if error_mm and error_mm <= ERROR_SHOWN_MM else f"{UNKNOWN:>6}"
    kind = pose_mark(pose)
    word: str = "saved" if pose.state == "done" else pose.state
    if pose.kept:
        word = "to be captured again"
    failure = pose.reason if pose.state == "failed" else ""
    return (
        Content.styled(f"{pose.index + 1:>3} ", "$foreground") + mark(kind),
        facts(("", shown, "mm")),
        Content.styled(word, MARKS[kind][1]),
        Content.styled(failure or pose.why or pose.name, "$foreground"),
    )


def facts_line(known: Known) -> Content:
    """Sum the plan up in one line."""
    session, goal_mm = known.shown.session, known.goal_mm
    if not (poses := session.poses):
        return dim(by_hand(known) if known.shown.robot.by_hand else NO_PLAN)
    errors = [mm for mm, _ in errors_after(poses, known.shown.estimate.floor_mm) if mm is not None]
    end_mm = errors[-1] if errors else None
    line = facts(("", str(len(poses)), "poses" if len(poses) != 1 else "pose")) + Content("   ")
    if skipped := sum(pose.state == "skipped" for pose in poses):
        line += Content.styled(f"{skipped} skipped   ", "$warn")
    line += error_facts("placed-point error at the end", end_mm, session.working_distance_m)
    if end_mm is not None and goal_mm is not None:
        line += Content("   ") + mark("done" if end_mm <= goal_mm else "look", f"goal {goal_mm:g} mm")
    said = beyond_goal(known) or above_goal(session.floor_mm, goal_mm)
    return line + Content.styled(f"   {said}", "$warn") if said else line


class PlanScreen(StationScreen):
    """The daemon's plan as a table; every change is a request to the daemon."""

    MODE, TIP = "plan", "All poses, their gain and reason"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("n", "make", "New", tooltip=NEW),
        Binding("r", "pose('retake')", "Retake", tooltip=RETAKE),
        Binding("a", "retake_failed", "Retake failed", tooltip=FAILED),
        Binding("s", "pose('skip')", "Skip", tooltip=SKIP),
    ]

    def body(self) -> ComposeResult:
        yield Line(lambda known, _: facts_line(known), id="plan-facts")
        with Horizontal(id="plan"):
            with Box("Poses", id="plan-poses", below="placed-point error after each, 1σ  Enter tells all"):
                yield Rows(*COLUMNS, id="plan-table")
            yield Panel("The cell", self._cell, id="plan-cell", below=LEGEND)

    def show(self, known: Known) -> None:
        super().show(known)
        poses = known.shown.session.poses
        errors = errors_after(poses, known.shown.estimate.floor_mm)
        rows = [row_of(pose, mm) for pose, (mm, _) in zip(poses, errors, strict=True)]
        self.table.show(rows)

    def _cell(self, known: Known, width: int, height: int) -> Content:
        chosen = self.table.cursor_row if known.shown.session.poses else None
        return draw(known.configuration, known.shown, chosen, width, height)

    def on_data_table_row_selected(self) -> None:
        """Tell all of a pose, of which the table may show the beginning."""
        if (pose := self._chosen()) is not None:
            told = ". ".join(words for words in (pose.name, pose.why, pose.reason) if words)
            self.notify(told, timeout=10, markup=False)

    def _chosen(self) -> PoseStatus | None:
        """The pose at the cursor; None: a shorter plan came and is not drawn yet."""
        row, poses = self.table.cursor_row, self.known.shown.session.poses
        return poses[row] if row < len(poses) else None

    def action_pose(self, verb: str) -> None:
        status = self.known.live
        if status is None or not status.session.poses:
            self.notify("No plan is loaded: n makes one, or `station plan` in a shell.", severity="warning")
        elif (pose := self._chosen()) is not None:
            self.ask(POSE_VERBS[verb](pose.index))
            self.table.move_cursor(row=self.table.cursor_row + 1)

    @work(exclusive=True, group="retake failed", exit_on_error=False)
    async def action_retake_failed(self) -> None:
        """Plan every failed pose again, one request after the other; the first refusal ends it."""
        for pose in self.known.shown.session.poses:
            if pose.state == "failed" and await self.link.ask(Retake(pose.index)) is None:
                return

    def action_make(self) -> None:
        self.ask(NEW_PLAN, PREPARE_S)
