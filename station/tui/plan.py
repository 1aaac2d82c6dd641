"""Plan: every pose with its state and reason; add, drop, skip, retake before and while the arm works."""

from __future__ import annotations

from typing import ClassVar

from rich.text import Text
from textual import work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.widgets import DataTable, Static

from recordings.schema.messages import Matrix4
from station.cell.plan import PlannedPose
from station.cell.status import PoseStatus, StationStatus
from station.operate.motion import PREPARE_S
from station.protocol.verbs import Add, Drop, MakePlan, Reorder, Retake, Skip
from station.tui.screen import Rows, StationScreen
from station.tui.words import POSE_MARKS

COLUMNS = ("#", "pose", "state", "± then", "why it is there / what happened", "attempt", "corners")
NO_PLAN = "No plan yet: n makes one of 25 poses (some seconds, nothing moves); a adds the arm's posture."
RETAKE = "Capture this pose again at the next run; the view it has counts until then"
SKIP = "Leave this pose out; of one that has a view only its retake"
POSE_VERBS = {"retake": Retake, "skip": Skip, "drop": Drop}
MOVE = Binding.Group("Move", compact=True)
SIGMA_SHOWN_MM = 100.0

Point = tuple[float, float, str]


def row_of(pose: PoseStatus) -> tuple[str, ...]:
    """One line of the table, plain words and marks."""
    sigma_mm = pose.predicted_sigma_mm
    # The first poses alone determine nothing: a number in metres would only puzzle.
    gain = "-" if sigma_mm is None or sigma_mm > SIGMA_SHOWN_MM else f"{sigma_mm:.2f} mm"
    return (
        str(pose.index + 1),
        pose.name,
        f"{POSE_MARKS[pose.state]} {pose.state}",
        gain,
        pose.reason or pose.why,
        str(pose.attempt or ""),
        "" if pose.corners is None else str(pose.corners),
    )


def detail_of(pose: PoseStatus) -> str:
    """One pose in words, with what the table has no room for."""
    seen = "" if pose.corners is None else f" {pose.corners} corners in attempt {pose.attempt}."
    why = f" {pose.why}." if pose.why and pose.reason else ""
    return f"{pose.name}: {pose.reason or pose.why}.{why}{seen}"


def scatter(points: list[Point], width: int, height: int) -> list[str]:
    """Points (right, up, mark) scaled alike in both directions; a cell is twice as high as wide."""
    if not points:
        return []
    low_x, high_x = min(p[0] for p in points), max(p[0] for p in points)
    low_y, high_y = min(p[1] for p in points), max(p[1] for p in points)
    per_cell = max((high_x - low_x) / max(1, width - 1), (high_y - low_y) / max(1, 2 * (height - 1)), 1e-3)
    grid = [[" "] * width for _ in range(height)]
    for x, y, mark in points:
        row = height - 1 - round((y - low_y) / per_cell / 2)
        grid[max(0, min(height - 1, row))][min(width - 1, round((x - low_x) / per_cell))] = mark
    return ["".join(row).rstrip() for row in grid]


class PlanSketch(Static):
    """Two small views; the highlighted pose is `@`, the arm's flange is `A`."""

    def __init__(self, *, id: str) -> None:
        super().__init__(id=id, classes="panel")
        self.border_title = "Where the arm goes"
        self._shown = ""
        self._last: tuple[StationStatus | None, int] = (None, 0)

    def on_resize(self) -> None:
        self.show(*self._last)

    def show(self, status: StationStatus | None, line: int) -> None:
        self._last = (status, line)
        if status is None or not self.size:
            return
        stops = [
            (pose.base_from_flange, "@" if i == line else POSE_MARKS[pose.state])
            for i, pose in enumerate(status.session.poses)
            if pose.base_from_flange is not None
        ]
        if status.robot.base_from_flange is not None:
            stops.append((status.robot.base_from_flange, "A"))
        width, height = max(10, self.size.width - 2), max(4, (self.size.height - 5) // 2)
        above = scatter([(x, y, m) for (x, y, _), m in map(_place, stops)], width, height)
        side = scatter([(x, z, m) for (x, _, z), m in map(_place, stops)], width, height)
        lines = ["from above (x right, y up)", *above, "from the side (x right, z up)", *side]
        if (text := "\n".join(lines)) != self._shown:
            self._shown = text
            self.update(Text(text, no_wrap=True), layout=False)


def _place(stop: tuple[Matrix4, str]) -> tuple[tuple[float, float, float], str]:
    matrix, mark = stop
    return (matrix[0][3], matrix[1][3], matrix[2][3]), mark


class PlanScreen(StationScreen):
    """The table is the plan as the daemon holds it; every change is asked of the daemon."""

    HELP = (
        "Poses in capture order. Nothing moves without your approval: F5, p and b show the motion and ask. "
        "Home and End go to the first and the last pose. ± then: the expected error after this pose, "
        "as planned."
    )
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("r", "pose('retake')", "Retake", tooltip=RETAKE),
        Binding("s", "pose('skip')", "Skip", tooltip=SKIP),
        Binding("d", "pose('drop')", "Drop", tooltip="Remove this pose from the plan"),
        Binding("a", "add", "Add", tooltip="Add the arm's present posture as a pose"),
        Binding("n", "make", "New", tooltip="Plan 25 poses from the configured guesses (seconds)"),
        Binding(
            "p",
            "app.start('improve')",
            "Replan",
            tooltip="Plan the remaining poses again",
        ),
        Binding("b", "app.start('best')", "Next pose", tooltip="Add and capture the most useful pose (asks)"),
        Binding("ctrl+up", "shift(-1)", "Move", group=MOVE, tooltip="Visit this pose earlier"),
        Binding("ctrl+down", "shift(1)", "Move", group=MOVE, tooltip="Visit this pose later"),
    ]

    def __init__(self) -> None:
        super().__init__()
        self._detail = NO_PLAN
        self._rows: list[tuple[str, ...]] = []

    def body(self) -> ComposeResult:
        with Horizontal(id="plan"):
            with Vertical(id="plan-left"):
                yield Rows(id="plan-table")
                yield Static(NO_PLAN, id="plan-detail")
            yield PlanSketch(id="plan-sketch")

    def on_mount(self) -> None:
        self.table.add_columns(*COLUMNS)
        self.table.focus()

    @property
    def table(self) -> Rows:
        return self.query_one(Rows)

    def show(self, status: StationStatus | None) -> None:
        super().show(status)
        if status is None:
            return  # what was known last stands there
        poses = status.session.poses
        rows = [row_of(pose) for pose in poses]
        if len(rows) != self.table.row_count:
            at = self.table.cursor_row
            self.table.clear()
            for row in rows:
                self.table.add_row(*row)
            self.table.move_cursor(row=at)  # a dropped pose leaves the next one marked
        else:
            for line, (row, before) in enumerate(zip(rows, self._rows, strict=True)):
                for column, text in enumerate(row):
                    if before[column] != text:
                        self.table.update_cell_at((line, column), text, update_width=True)  # type: ignore[arg-type]
        self._rows = rows
        self._explain(status, self.table.cursor_row)

    def on_data_table_row_highlighted(self, event: DataTable.RowHighlighted) -> None:
        self._explain(self.desk.status, event.cursor_row)

    def _explain(self, status: StationStatus | None, line: int) -> None:
        """The highlighted pose in words and in the sketch."""
        self.query_one(PlanSketch).show(status, line)
        poses = () if status is None else status.session.poses
        text = detail_of(poses[line]) if line < len(poses) else NO_PLAN
        if text != self._detail:
            self._detail = text
            self.query_one("#plan-detail", Static).update(Text(text))

    def _selected(self) -> int | None:
        status = self.desk.status
        if status is None or not status.session.poses:
            self.notify("No plan is loaded: n makes one, or `station plan` in a shell.", severity="warning")
            return None
        return status.session.poses[self.table.cursor_row].index

    def action_pose(self, verb: str) -> None:
        if (index := self._selected()) is not None:
            self.desk.send(POSE_VERBS[verb](index))

    def action_shift(self, by: int) -> None:
        status, line = self.desk.status, self.table.cursor_row
        if self._selected() is None or status is None:
            return
        if not 0 <= line + by < len(status.session.poses):
            self.notify(f"This pose is the {'first' if by < 0 else 'last'} already.")
            return
        order = [pose.index for pose in status.session.poses]
        order[line], order[line + by] = order[line + by], order[line]
        self.desk.send(Reorder(tuple(order)))
        self.table.move_cursor(row=line + by)

    def action_add(self) -> None:
        status = self.desk.status
        if status is None or status.robot.joints_rad is None:
            self.notify("The arm's posture is not known: no robot state.", severity="warning")
            return
        name = f"here-{max((pose.index for pose in status.session.poses), default=-1) + 2}"
        self.desk.send(Add(PlannedPose(name, status.robot.joints_rad, why="added on the screen")))

    @work(exit_on_error=False)
    async def action_make(self) -> None:
        await self.desk.ask(MakePlan(25, seed=1), timeout_s=PREPARE_S)
