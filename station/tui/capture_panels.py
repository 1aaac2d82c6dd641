"""Panels of the capture screen: image quality, placed-point error, coverage of the image."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence

from textual.content import Content

from station.cell.status import DetectionStatus, GuidanceStatus, PoseStatus
from station.tui.task import Known, beyond_goal
from station.tui.words import ERROR_SHOWN_MM, dim, error_facts, facts, limit_bar, lines, mark

STILL_CELLS = 12
LABEL_CELLS, HALVES = 7, (" .:", " ▄█")
"""Cells of the axis of the errors; signs of an empty, a half and a full cell, planned and by images."""


def quality_line(seen: DetectionStatus) -> Content:
    """Judge the board in the newest image: corners, sharpness and light, with advice where one is poor."""
    if not seen.found:
        advice = f"  {seen.advice}" if seen.advice else ""
        return mark("look", seen.reason or "no board in view") + dim(advice)
    judged = (
        (f"corners {seen.corners}/{seen.expected}", seen.corners == seen.expected),
        ("sharp", seen.cause != "blurred"),
        ("light", not seen.cause.endswith("exposed")),
    )
    parts = [mark("done" if good else "look", name) for name, good in judged]
    if seen.tilt_rad is not None:
        parts.append(facts(("tilt", f"{math.degrees(seen.tilt_rad):.0f}°", "")))
    if seen.distance_m is not None:
        parts.append(facts(("", f"{1000 * seen.distance_m:.0f} mm", "")))
    parts.append(facts(("fills", f"{100 * seen.coverage:.0f} %", "")))
    line = Content("  ").join(parts)
    return line + Content.styled(f"   {seen.advice}", "$warn") if seen.advice else line


def still_line(guidance: GuidanceStatus, cells: int) -> Content:
    """Draw how still everything is, and say what moves."""
    colour = "$ok" if guidance.still >= 1.0 else "$warn"
    bar = limit_bar(guidance.still, 1.0, cells, colour, at=1.0)
    return dim("still ") + bar + dim(f" {guidance.moves or 'nothing moves'}")


def hand_lines(known: Known, width: int, height: int) -> Content:
    """Say how still everything is, what the last view was worth, and what the wanted one would be."""
    status = known.shown
    guidance = status.guidance
    now_mm, after_mm = status.estimate.predicted_error_mm, guidance.after_mm
    rows = [still_line(guidance, STILL_CELLS)]
    rows.append(facts(("view", str(status.session.captured), f"of {status.session.least_by_hand} or more")))
    if not status.session.check and after_mm is not None and (now_mm is None or after_mm < now_mm):
        rows.append(error_facts("with the next view", after_mm, None))
    return lines(*rows[:height])


def error_lines(known: Known, width: int, height: int) -> Content:
    """Write the placed-point error and the goal; draw it after each pose. A drift check has neither."""
    if known.shown.session.check:
        return dim("When all images are taken, they\njudge the installed calibration.")
    estimate, poses, goal = known.shown.estimate, known.shown.session.poses, known.goal_mm
    head = error_facts("", estimate.predicted_error_mm, estimate.working_distance_m)
    if goal:
        head += Content("  ") + mark("done" if estimate.enough else "todo", f"goal {goal:g} mm")
    said = [Content.styled(row, "$warn") for row in textwrap.wrap(beyond_goal(known), max(width, 1))]
    columns = error_columns(errors_after(poses, estimate.floor_mm), goal, width, height - 1 - len(said))
    return lines(head, *said, *columns)


def errors_after(
    poses: Sequence[PoseStatus], floor_mm: float | None = None
) -> list[tuple[float | None, bool]]:
    """Return the placed-point error after each pose (mm), and whether by images.

    Planned with a usual noise, it is no larger than what the images showed before: views only add; and no
    smaller than `floor_mm`, the part of this arm's noise, where images showed that.
    """
    errors, shown_mm = list[tuple[float | None, bool]](), math.inf
    for pose in poses:
        shown_mm = pose.estimated_sigma_mm or shown_mm
        planned_mm = pose.predicted_sigma_mm and min(max(pose.predicted_sigma_mm, floor_mm or 0.0), shown_mm)
        errors.append((pose.estimated_sigma_mm or planned_mm, bool(pose.estimated_sigma_mm)))
    return errors


def error_columns(
    columns: Sequence[tuple[float | None, bool]], goal: float | None, width: int, height: int
) -> Iterator[Content]:
    """Draw (error, by images) … as columns over a logarithmic axis, planned ones dotted, and the goal."""
    room = max(1, width - LABEL_CELLS)
    columns = columns[:: math.ceil(len(columns) / room) or 1]
    known = [error for error, _ in columns if error and error <= ERROR_SHOWN_MM]
    if not known or height < 3:
        return
    levels = [*known, goal] if goal else known
    low, high = min(levels) / 1.15, max(levels) * 1.15

    def halves(error: float) -> int:
        """Height of a column in half rows."""
        return round(2 * height * math.log(min(error, high) / low) / math.log(high / low))

    at_goal = halves(goal) // 2 if goal else -1
    labels = {height - 1: high, 0: low, at_goal: goal or low}
    wide = room // len(columns)
    for row in reversed(range(height)):
        label = f"{labels[row]:>5.2f}" if row in labels else ""
        parts = [(f"{label:>5} ", "$warn" if row == at_goal else "$dim"), ("│", "$line")]
        for error, measured in columns:
            filled = min(2, max(0, halves(error) - 2 * row)) if error else 0
            sign, style = HALVES[measured][filled], "$accent" if measured else "$dim"
            parts.append(("─" * wide, "$warn") if row == at_goal else (sign * wide, style))
        yield Content.assemble(*parts).simplify()


_HEAT = ("$foreground on $h1", "$strong on $h2", "$onaccent on $h3", "$onaccent on $h4")


def coverage_lines(known: Known, width: int, height: int) -> Content:
    """Draw the image as a grid: in how many images each part showed the board."""
    views = known.shown.estimate.image_views
    if not views:
        return dim("no image of the board yet")
    cell = max(3, min(9, (width - 2) // len(views[0]) - 1))
    counts = [count for row in views for count in row]

    def part(count: int) -> Content:
        if not count:
            return Content.styled("--".center(cell), "$warn on $h0")
        return Content.styled(str(count).center(cell), _HEAT[min(3, 4 * count // (max(counts) + 1))])

    rows = [Content(" ").join(map(part, row)) for row in views]
    empty = counts.count(0)
    said = f"{empty} of {len(counts)} parts empty"
    rows.append(mark("look", said) if empty else mark("done", "the board was seen in every part"))
    return lines(*rows[:height])
