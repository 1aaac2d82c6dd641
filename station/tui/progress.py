"""Progress of a capture: the steps of the pose under way, and a chip for every pose."""

from __future__ import annotations

from collections.abc import Iterator

from textual.content import Content

from station.cell.status import PoseStatus, SessionStatus, StationState, StationStatus
from station.protocol.states import RUNNING
from station.tui.capture_panels import hand_lines
from station.tui.task import Known
from station.tui.words import Mark, dim, duration, facts, lines, mark

_STEPS = {
    StationState.MOVING: "move",
    StationState.SETTLING: "settle",
    StationState.CAPTURING: "capture",
    StationState.WRITING: "save",
}
_MARKS: dict[str, Mark] = {"planned": "todo", "skipped": "todo", "done": "done", "failed": "failed"}
CHIPS: dict[Mark, tuple[str, str]] = {
    "done": ("✓", "$ok on $okbg"),
    "todo": ("·", "$dim"),
    "look": ("!", "$warn on $warnbg"),
    "failed": ("✗", "bold $bad on $badbg"),
    "now": ("▶", "bold $strong on $accentbg"),
}
LEGEND = "✓ saved  ! look  ▶ now  · to come  ✗ failed"


def pose_line(status: StationStatus) -> Content:
    """Draw the steps of the pose under way; at rest say what comes next."""
    pose = pose_under_way(status)
    if pose is None:
        again = sum(pose.kept for pose in status.session.poses)
        return dim(f"{again} to be captured again" if again else "resting")
    if pose.state == "failed":
        return mark("failed", pose.reason)
    at = list(_STEPS).index(status.state) if status.state in _STEPS else -1
    if pose.state == "done":
        at = len(_STEPS)
    parts = []
    for i, word in enumerate(_STEPS.values()):
        if i == at:
            parts.append(Content.styled(f" ▶ {word} ", "bold $strong on $accentbg"))
        else:
            parts.append(mark("done" if i < at else "todo", word))
    return Content(" ").join(parts)


def pose_under_way(status: StationStatus) -> PoseStatus | None:
    """Return the pose that the arm works at; None at rest."""
    session = status.session
    if session.current is None:
        return None
    pose = session.poses[session.current]
    resting = status.state in (StationState.IDLE, StationState.PAUSED)
    return None if pose.state == "done" and resting else pose


def progress_lines(known: Known, width: int, height: int) -> Content:
    """Draw how many poses are saved, the steps of the present one, and a chip for each; by hand the guide."""
    status = known.shown
    if known.hand_guided:
        return hand_lines(known, width, height)
    session, pose = status.session, pose_under_way(status)
    if not session.poses:
        return dim("no plan yet")
    saved = sum(pose.counts for pose in session.poses)
    left = (
        ()
        if session.remaining_s is None or status.state not in RUNNING
        else (("", duration(session.remaining_s), "left"),)
    )
    head = facts(("", str(saved), f"of {len(session.poses)} saved"), *left)
    if status.source == "playback":
        head += Content.styled("   played, no arm moves", "$sim")
    why = "" if pose is None else f"{pose.name}: {pose.why}" if pose.why else pose.name
    return lines(head, pose_line(status), dim(why), *chips(session, width, max(1, height - 3)))


def chips(session: SessionStatus, width: int, rows: int) -> Iterator[Content]:
    """Draw a chip for each pose in driving order; of a long plan the rows around the present pose."""
    each = 4 if len(session.poses) < 100 else 5
    per_row = max(1, (width + 1) // (each + 1))
    made = [_chip(pose, pose.index == session.current, each) for pose in session.poses]
    whole = [made[i : i + per_row] for i in range(0, len(made), per_row)]
    first = max(0, min((session.current or 0) // per_row - 1, len(whole) - rows))
    for row in whole[first : first + rows]:
        yield Content(" ").join(row)


def _chip(pose: PoseStatus, current: bool, cells: int) -> Content:
    number = f"{pose.index + 1:>{cells - 2}}"
    kind = pose_mark(pose)
    if current and pose.state == "planned":
        kind = "now"
    sign, style = CHIPS[kind]
    return Content.styled(f"{number}{'-' if pose.state == 'skipped' else sign} ", style)


def pose_mark(pose: PoseStatus) -> Mark:
    """Choose the mark of a pose."""
    return "look" if pose.kept else _MARKS[pose.state]
