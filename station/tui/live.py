"""Capture: what the operator watches while the arm works. Log: everything that was said meanwhile."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
from rich.text import Text
from textual.app import ComposeResult
from textual.containers import Horizontal, Vertical
from textual.content import Content
from textual.widgets import ProgressBar, RichLog, Static

from station.cell.config import CaptureConfig
from station.cell.layout import CellLayout
from station.cell.status import Event, PoseStatus, SessionStatus, StationState, StationStatus
from station.protocol.states import LATCHED, RUNNING
from station.tui.frame import Line
from station.tui.screen import Box, Panel, StationScreen
from station.tui.task import Known
from station.tui.widgets.canvas import Series, curve
from station.tui.widgets.preview import PreviewPane
from station.tui.widgets.scene import cell_scene, fields_of
from station.tui.words import UNKNOWN, clock, degrees, dim, duration, facts, lines, mark, mm

BURNT = 0.01
"""Share of saturated pixels from which on a person should look."""
_STEPS = {"moving": "move", "settling": "settle", "capturing": "capture", "writing": "save"}
_LEVELS = {"debug": "$dim", "info": "", "warning": "$warn", "error": "bold $bad"}
_SIGNS = {"debug": "", "info": "", "warning": "▲ ", "error": "✗ "}
_FOLDERS = re.compile(r"(?<!\S)/\S*/(?=[^/\s]+/[^/\s]+)")
"""All but the last two names of an absolute path."""
CHIPS: dict[str, tuple[str, str]] = {
    "done": ("✓", "$ok on $okbg"),
    "planned": ("·", "$dim"),
    "skipped": ("-", "$dim"),
    "failed": ("✗", "bold $bad on $badbg"),
}
STOPPED_BY = {
    "protective-stop": "The robot stopped itself (protective stop): it probably touched something.",
    "emergency-stop": "An emergency stop is pressed.",
    "safeguard-stop": "A guard or a scanner stopped the arm.",
}
"""By the cause of a stop that a person clears at the pendant."""
LEGEND = "✓ saved  ! saved, look  ▶ now  · to come  - skipped  ✗ failed"


def event_text(event: Event, width: int = 0) -> Content:
    """`width`: cells of the line; where a path makes it longer, its last two names stand for it. 0: whole."""
    pose = "" if event.pose_index is None else f"pose {event.pose_index + 1} "
    when, said = clock(event.wall_ns), _SIGNS[event.level] + pose + event.text
    if 0 < width <= len(when) + len(said):
        said = _FOLDERS.sub("…/", said)
    return Content.assemble((when, "$faint"), "  ", (said, _LEVELS[event.level]))


def quality_line(status: StationStatus) -> Content:
    """The board in the newest image: each with a mark, a value and, where it is poor, a word."""
    seen = status.detection
    if not seen.found:
        advice = f"  {seen.advice}" if seen.advice else ""
        return mark("look", seen.reason or "no board in view") + dim(advice)
    burnt = seen.saturated > BURNT
    judged = (
        ("corners", f"{seen.corners}/{seen.expected}", seen.corners == seen.expected),
        ("sharp", f"{seen.sharpness:.2f}", burnt or not seen.advice),
        ("saturated", f"{100 * seen.saturated:.1f} %", not burnt),
    )
    parts = [
        mark("done" if good else "look") + " " + facts((name, value, "")) for name, value, good in judged
    ]
    if seen.tilt_rad is not None:
        parts.append(facts(("tilt", degrees(seen.tilt_rad, 0), "")))
    if seen.distance_m is not None:
        parts.append(facts(("at", mm(seen.distance_m, 0), "")))
    parts.append(facts(("fills", f"{100 * seen.coverage:.0f} %", "")))
    line = Content("  ").join(parts)
    return line + Content.styled(f"   {seen.advice}", "$warn") if seen.advice else line


def pose_line(status: StationStatus) -> Content:
    """Steps of the pose under way, or what comes next at rest."""
    session = status.session
    pose = _under_way(status)
    if pose is None:
        return counted_line(session)
    if pose.state == "failed":
        return mark("failed", f"{pose.name}: {pose.reason}")
    at = list(_STEPS).index(pose.state) if pose.state in _STEPS else (4 if pose.state == "done" else -1)
    parts = []
    for i, word in enumerate(_STEPS.values()):
        if i == at:
            parts.append(Content.styled(f" ▶ {word} ", "bold $strong on $accentbg"))
        else:
            parts.append(mark("done" if i < at else "todo", word))
    return Content.styled(" ─ ", "$line").join(parts)


def _under_way(status: StationStatus) -> PoseStatus | None:
    session = status.session
    if session.place is None:
        return None
    pose = session.poses[session.place]
    resting = status.state in (StationState.IDLE, StationState.PAUSED)
    return None if pose.state == "done" and resting else pose


def counted_line(session: SessionStatus) -> Content:
    """Progress of a session while no pose is under way, and what comes next."""
    if not session.poses:
        return dim("No plan yet: 2, then n makes one.")
    if not session.name:
        return dim("Not begun: F5 shows the motion and asks first.")
    again = sum(pose.kept for pose in session.poses)
    if session.calibration:
        return mark("done", "finished and solved: 4 shows the result")
    if session.recording:
        return mark("done", "finished: k on 7 judges it" if session.check else "finished: F9 solves it")
    return dim(f"{again} to be captured again" if again else "resting")


def progress_lines(known: Known, width: int, height: int) -> Content:
    """Draw how many are saved, the steps of this pose, a chip a pose."""
    status = known.shown
    session, pose = status.session, _under_way(status)
    saved = sum(pose.counts for pose in session.poses)
    left = (
        ()
        if session.remaining_s is None or status.state not in RUNNING
        else (("", duration(session.remaining_s), "left"),)
    )
    head = facts(("", str(saved), f"of {len(session.poses)} saved"), *left)
    if status.playback:
        head += Content.styled("   played, no arm moves", "$sim")
    why = "" if pose is None else f"{pose.name}: {pose.why}" if pose.why else pose.name
    return lines(head, pose_line(status), dim(why), *chips(session, width, max(1, height - 3)))


def chips(session: SessionStatus, width: int, rows: int) -> Iterator[Content]:
    """A chip a pose, in the order of driving; of a long plan the rows around the one under way."""
    each = 4 if len(session.poses) < 100 else 5
    per_row = max(1, (width + 1) // (each + 1))
    made = [_chip(pose, pose.index == session.current, each) for pose in session.poses]
    whole = [made[i : i + per_row] for i in range(0, len(made), per_row)]
    first = max(0, min((session.place or 0) // per_row - 1, len(whole) - rows))
    for row in whole[first : first + rows]:
        yield Content(" ").join(row)


def _chip(pose: PoseStatus, current: bool, cells: int) -> Content:
    number = f"{pose.index + 1:>{cells - 2}}"
    if current and pose.state in _STEPS:
        return Content.styled(f"{number}▶ ", "bold $strong on $accentbg")
    if pose.kept or (pose.state == "done" and pose.attempt > 1):
        return Content.styled(f"{number}! ", "$warn on $warnbg")
    sign, style = CHIPS.get(pose.state, ("▶", "bold $strong on $accentbg"))
    return Content.styled(f"{number}{sign} ", style)


def error_lines(known: Known, width: int, height: int) -> Content:
    """The expected error as it falls towards its goal: measured solid, planned dotted."""
    status = known.shown
    estimate, poses = status.estimate, status.session.poses
    goal = estimate.goal_mm
    now = estimate.sigma_translation_mm
    head = facts(("", f"± {now:.2f}" if now is not None else f"± {UNKNOWN}", "mm"))
    if goal:
        head += Content.assemble(("   goal ", "$dim"), (f"± {goal:.2f}", "$warn"))
    if estimate.enough:
        head += Content("   ") + mark("done", "reached")
    measured = [(i + 1.0, p.estimated_sigma_mm) for i, p in enumerate(poses) if p.estimated_sigma_mm]
    planned = [
        (i + 1.0, p.predicted_sigma_mm)
        for i, p in enumerate(poses)
        if p.predicted_sigma_mm and p.predicted_sigma_mm < 100 * (goal or 0.5)
    ]
    end = f"by the plan ± {planned[-1][1]:.2f} mm" if planned else ""
    rows = [head]
    if end and height > 6:
        rows.append(dim(f"{end} after {len(poses)} poses" + _advice(estimate.advice, width)))
    rows.append(
        curve(
            [Series(planned, "$faint", dash=2), Series(measured, "$accent")],
            goal,
            width,
            height - len(rows),
            ends=f"pose 1|{len(poses)}" if height > 6 else "",
        )
    )
    return lines(*rows)


def _advice(advice: str, width: int) -> str:
    return f". {advice}" if advice and len(advice) < width - 36 else ""


_HEAT = ("$dim on $h0", "$foreground on $h1", "$strong on $h2", "$onaccent on $h3", "$onaccent on $h4")


def coverage_lines(known: Known, width: int, height: int, scene: CellLayout | None = None) -> Content:
    """The picture as a grid: in how many images each part showed the board, and which poses fill the rest."""
    status = known.shown
    views = status.estimate.image_views
    if not views:
        return dim("no image of the board yet")
    columns = len(views[0])
    cell = max(3, min(9, (width - 2) // columns - 1))
    most = max(1, max(max(row) for row in views))
    tall = 2 if height >= 2 * len(views) + 1 else 1
    rows: list[Content] = []
    for row in views:
        words = [("empty" if cell > 5 else "--") if not count else str(count) for count in row]
        heat = [0 if not count else 1 + min(3, 4 * count // (most + 1)) for count in row]
        shown = [
            Content.styled(word.center(cell), _HEAT[h] if h else "$warn on $h0")
            for word, h in zip(words, heat, strict=True)
        ]
        rows.append(Content(" ").join(shown))
        if tall == 2:
            rows.append(Content(" ").join(Content.styled(" " * cell, _HEAT[h]) for h in heat))
    if len(rows) < height:
        rows.append(_empty_words(status, scene))
    return lines(*rows[:height])


def _empty_words(status: StationStatus, scene: CellLayout | None) -> Content:
    views = status.estimate.image_views
    empty = np.array(views) == 0
    if not empty.any():
        return mark("done", "the board was seen in every part")
    said = f"{int(empty.sum())} of {empty.size} parts empty"
    if scene is not None:
        open_poses = [p for p in status.session.poses if p.state == "planned"]
        filling = [str(p.index + 1) for p in open_poses if (fields_of(scene, p, *empty.shape) & empty).any()]
        if filling:
            return mark("look", said) + dim(f": pose {', '.join(filling[:6])} will show it there")
    return mark("look", said)


def device_lines(known: Known, width: int, height: int) -> Content:
    """Each device with its rate; two a line."""
    status = known.shown
    robot, camera, recorder, bounds = status.robot, status.camera, status.recorder, status.clock
    if status.playback:
        return dim("robot not live   camera not live")
    parts = [
        _device("robot", robot.connected, f"{robot.rate_hz:.0f} Hz"),
        _device(
            "camera",
            camera.connected,
            f"{camera.fps:.0f} fps" + f", {camera.dropped} lost" * bool(camera.dropped),
        ),
    ]
    if status.trigger.present:
        pulses, frames = status.trigger.pulses, status.trigger.frames
        parts.append(_device("trigger", pulses == frames, f"{pulses} = {frames}"))
    if recorder.recording or recorder.error:
        parts.append(_device("record", not recorder.error, f"sync {recorder.sync_ms:.0f} ms"))
    else:
        parts.append(mark("todo", "not recording"))
    known_ms = [ms for ms in (bounds.camera_bound_ms, bounds.controller_bound_ms) if ms is not None]
    if known_ms:
        capture = CaptureConfig() if known.configuration is None else known.configuration.capture
        parts.append(
            _device(
                "clocks",
                sum(known_ms) <= 1000 * capture.time_bound_s,
                f"± {sum(known_ms):.1f} ms {bounds.camera_source or ''}".rstrip(),
            )
        )
    rows = [Content("")]
    for part in parts:
        longer = rows[-1] + Content("   ") + part if rows[-1] else part
        if longer.cell_length > width and rows[-1]:
            rows.append(part)
        else:
            rows[-1] = longer
    return lines(*rows)


def _device(name: str, good: bool, text: str) -> Content:
    return mark("done" if good else "failed", name) + dim(f" {text}")


def newest_events(known: Known, width: int, height: int) -> Content:
    """The newest events, as many as fit."""
    shown = reversed(known.shown.events[-max(1, height) :])
    return lines(*(event_text(event, width) for event in shown))


class Stopped(Static):
    """Over the capture while STOP or a fault is latched: what happened, and the way on in three steps."""

    def show(self, known: Known) -> None:
        status = known.live
        latched = status is not None and status.state in LATCHED and not known.old
        self.display = latched
        if status is None or not latched:
            return
        self.border_title = f"■ {status.state.value.upper()}"
        self.border_subtitle = "latched until F8"
        self.update(stopped_text(status))


def stopped_text(status: StationStatus) -> Content:
    session, robot = status.session, status.robot
    on_way = _under_way(status)
    again = (
        f" Pose {on_way.index + 1} was on its way and is captured again."
        if on_way and on_way.state != "done"
        else ""
    )
    saved = (
        f"{session.captured} of {len(session.poses)} poses are saved.{again}"
        if session.poses
        else "No session was running."
    )
    pendant = mark("look", robot.held) if robot.held else mark("done", "nothing to clear there")
    safety = Content.assemble(("safety ", "$dim"), (robot.safety or UNKNOWN, "bold $strong"))
    told = "The arm was told to stop. " if status.cause == "stop" else ""
    return lines(
        Content.styled(STOPPED_BY.get(status.cause, told + status.reason), "bold $strong"),
        Content(""),
        Content(saved),
        Content(""),
        Content.assemble(
            (" 1  ", "bold $strong"),
            ("Look at the cell. ", "bold"),
            "Is anybody in reach? Did the arm touch anything?",
        ),
        Content.assemble((" 2  ", "bold $strong"), ("At the pendant: ", "bold"), safety, "  ", pendant),
        Content.assemble(
            (" 3  ", "bold $strong"),
            (" F8  Acknowledge ", "bold $onaccent on $warn"),
            ("  Nothing moves by it; F5 then asks again.", "$dim"),
        ),
    )


class LiveScreen(StationScreen):
    """The camera's picture as large as it can be; progress, error, coverage and devices beside it."""

    MODE, TIP = "capture", "The running capture"
    HELP = (
        "The running capture. F5 asks before the arm moves; F12 stops it at once, on every screen. Poses: "
        f"{LEGEND}."
    )

    def body(self) -> ComposeResult:
        with Horizontal(id="live"):
            with Vertical(id="live-left"):
                with Box("Camera", id="picture", below="+ found corners"):
                    yield PreviewPane(id="preview")
                    yield Line(lambda known, _: quality_line(known.shown), id="quality")
                yield Panel("What happened", newest_events, id="events", below="8 all")
            with Vertical(id="live-right"):
                with Box("Poses", id="progress"):
                    yield ProgressBar(id="bar-of-poses", show_eta=False, show_percentage=False)
                    yield Panel("", progress_lines, id="poses")
                yield Panel("Expected error of the camera's position (1σ)", error_lines, id="error")
                yield Panel(
                    "Where in the image the board was seen",
                    self._coverage,
                    id="coverage",
                    below="images per part",
                )
                yield Panel("Devices", device_lines, id="devices")
        yield Stopped(id="stopped")

    def _coverage(self, known: Known, width: int, height: int) -> Content:
        status = known.shown
        return coverage_lines(known, width, height, cell_scene(known.configuration, status))

    def show(self, known: Known) -> None:
        super().show(known)
        self.draw_panels(known)
        self.query_one(Stopped).show(known)
        status = known.status
        if status is None:
            return
        session = status.session
        title = "Poses"
        if session.place is not None and status.state in RUNNING:
            number = session.poses[session.place].index + 1
            title = f"Pose {number} ({session.place + 1} of {len(session.poses)})"
        self.query_one("#progress").border_title = f"{title}: OLD" if known.old else title
        self.query_one("#picture").border_title = (
            f"Camera  {status.camera.model}"
            if status.camera.connected or status.playback
            else "Camera: not connected"
        )
        bar = self.query_one(ProgressBar)
        saved, total = float(sum(pose.counts for pose in session.poses)), float(len(session.poses) or 1)
        if (bar.progress, bar.total) != (saved, total):
            bar.update(total=total, progress=saved)
        self.query_one("#quality", Line).show(known)
        self.query_one("#live").set_class(status.state in LATCHED, "-dimmed")


class LogScreen(StationScreen):
    """All events, newest last, to scroll through."""

    MODE, TIP = "log", "Event log"
    HELP = "All events the daemon still holds; the same lines are in the journal and in the recording."

    def __init__(self) -> None:
        super().__init__()
        self._last: Event | None = None

    def body(self) -> ComposeResult:
        yield RichLog(id="log", wrap=True, max_lines=2000)

    def show(self, known: Known) -> None:
        super().show(known)
        status = known.status
        events = () if status is None else status.events
        start = events.index(self._last) + 1 if self._last in events else 0
        log = self.query_one("#log", RichLog)
        for event in events[start:]:
            log.write(Text(event_text(event).plain, style=_RICH[event.level]))
            self._last = event


_RICH = {"debug": "dim", "info": "", "warning": "yellow", "error": "bold red"}
