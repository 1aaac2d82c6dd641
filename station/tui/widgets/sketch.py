"""Where the arm goes: the flange's stops seen from above and from the side, in characters."""

from __future__ import annotations

from rich.text import Text
from textual.widgets import Static

from recordings.schema.messages import Matrix4
from station.cell.status import StationStatus
from station.tui.words import POSE_MARKS

Point = tuple[float, float, str]


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
