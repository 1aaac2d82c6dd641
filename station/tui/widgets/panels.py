"""Small text panels of the live screen: each turns one part of the status into a few aligned lines."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable

from rich.text import Text
from textual.reactive import reactive
from textual.widgets import Static

from station.cell.status import SessionStatus, StationState, StationStatus
from station.tui.words import POSE_MARKS, degrees, duration, mm

CLOCKS_POOR_MS = 20.0
"""The default of `capture.time_bound_s`: poses known worse than that are refused."""
NARROW = 29
"""Letters in a line of the right column on the narrowest screen."""
MAP_ROWS = 4
SPACED = 13 * MAP_ROWS
Lines = Callable[[StationStatus], list[str]]


class Panel(Static):
    """A titled box that redraws only when its own lines change."""

    status: reactive[StationStatus | None] = reactive(None)
    old: reactive[bool] = reactive(False)
    """No longer how it is; said in the title too."""

    def __init__(self, title: str, lines: Lines, *, id: str, wrap: bool = False) -> None:
        """`wrap`: what is longer than the panel is wide goes on below; else it is cut."""
        super().__init__(id=id, classes="panel")
        self.border_title = self._title = title
        self._lines, self._wrap = lines, wrap
        self._shown = ""

    def on_resize(self) -> None:
        if self._wrap:
            self.watch_status(self.status)

    def watch_old(self, old: bool) -> None:
        self.border_title = f"{self._title}: OLD" if old else self._title

    def watch_status(self, status: StationStatus | None) -> None:
        if status is None:
            return  # what was known last stands there, marked old
        lines = self._lines(status)
        if self._wrap and (width := self.content_size.width):
            lines = [part for line in lines for part in textwrap.wrap(line, width) or [""]]
        text = "\n".join(lines)
        if text != self._shown:
            # Laying the screen out again is dear, and only needed when the panel grows or shrinks.
            grown = text.count("\n") != self._shown.count("\n") or not (text and self._shown)
            self._shown = text
            self.update(Text(text, no_wrap=True, overflow="ellipsis"), layout=grown)


def _line(name: str, text: str, good: bool | None) -> str:
    return f"{name:<8}{text:<15.15}{ {True: 'ok', False: 'BAD', None: '-'}[good]:>3}"


def device_lines(status: StationStatus) -> list[str]:
    robot, camera, recorder, bounds = status.robot, status.camera, status.recorder, status.clock
    if status.playback:
        lines = [_line("robot", "not live", None), _line("camera", "not live", None)]
    else:
        lines = [
            _line("robot", f"{robot.rate_hz:.0f} Hz {robot.age_ms:.0f} ms", robot.connected),
            _line("camera", f"{camera.fps:.0f} fps drop {camera.dropped}", camera.connected),
        ]
    if status.trigger.present:
        pulses, frames = status.trigger.pulses, status.trigger.frames
        lines.append(_line("trigger", f"{pulses} = {frames}", pulses == frames))
    recording = f"sync {recorder.sync_ms:.0f} ms" if recorder.recording else "not recording"
    lines.append(_line("record", recording, False if recorder.error else recorder.recording or None))
    known_ms = [ms for ms in (bounds.camera_bound_ms, bounds.controller_bound_ms) if ms is not None]
    if known_ms:
        lines.append(
            _line(
                "clocks",
                f"±{sum(known_ms):.1f}ms {bounds.camera_source or ''}",
                sum(known_ms) < CLOCKS_POOR_MS,
            )
        )
    return lines


def detection_lines(status: StationStatus) -> list[str]:
    seen = status.detection
    if not seen.found:
        return [seen.reason or "no board in view", seen.advice or f"saturated {100 * seen.saturated:.1f} %"]
    tilt = "-" if seen.tilt_rad is None else degrees(seen.tilt_rad, 0)
    far = "-" if seen.distance_m is None else mm(seen.distance_m, 0)
    return [
        f"board {seen.corners}/{seen.expected}  sharp {seen.sharpness:.2f}  sat {100 * seen.saturated:.1f} %",
        seen.advice or f"fills {100 * seen.coverage:.0f} %  tilt {tilt}  at {far}",
    ]


def robot_lines(status: StationStatus) -> list[str]:
    robot = status.robot
    if robot.joints_rad is None or robot.base_from_flange is None:
        return ["no robot state"]
    x, y, z = (row[3] * 1000 for row in robot.base_from_flange[:3])
    joints = [f"{math.degrees(q):7.1f}" for q in robot.joints_rad]
    return [
        f"flange {x:7.1f}{y:7.1f}{z:7.1f}",
        f"joints {''.join(joints[:3])}",
        f"       {''.join(joints[3:])}",
    ]


_AT_REST = (StationState.IDLE, StationState.PAUSED)


def progress_lines(status: StationStatus) -> list[str]:
    session = status.session
    if session.current is None or session.current >= len(session.poses):
        return _counted(session)
    pose = session.poses[session.current]
    if pose.state == "done" and status.state in _AT_REST:
        return _counted(session)
    if pose.state == "failed":
        return [f"{pose.name}: failed", pose.reason]
    steps = ("moving", "settling", "capturing", "writing")
    at = steps.index(pose.state) if pose.state in steps else (4 if pose.state == "done" else -1)
    words = ("move", "settle", "capture", "write")
    marks = [f"{w} {'██' if i < at else '█▒' if i == at else '░░'}" for i, w in enumerate(words)]
    left = "" if session.remaining_s is None else f" {duration(session.remaining_s)} left"
    why = "played, no arm moves" if status.playback else pose.why
    return [f"{pose.name}: {why}", " ".join(marks) + left]


def _counted(session: SessionStatus) -> list[str]:
    """Progress of a session while no pose is under way, and what comes next."""
    if not session.poses:
        return ["no plan loaded"]
    if not session.name:
        return [f"{len(session.poses)} poses planned: F5 shows the path and asks"]
    done = sum(pose.counts for pose in session.poses)
    again = sum(pose.kept for pose in session.poses)
    closed = ""
    if session.recording:
        closed = ", finished: k on 4 judges it" if session.check else ", finished: F9 solves it"
    if session.calibration:
        closed = ", solved: 3 shows it"
    if again and not closed:
        closed = f", {again} to be captured again"
    return [f"{done} of {len(session.poses)} poses captured{closed}"]


def pose_map_lines(status: StationStatus) -> list[str]:
    """A mark a pose; of a long plan the rows around the pose that is being taken."""
    marks = "".join(POSE_MARKS[p.state] for p in status.session.poses)
    if not marks:
        return ["no plan: 2, then n makes one"]
    if len(marks) <= SPACED:
        rows, first = [" ".join(marks[i : i + 13]) for i in range(0, len(marks), 13)], 0
    else:
        rows = [marks[i : i + NARROW] for i in range(0, len(marks), NARROW)]
        first = max(0, min((status.session.current or 0) // NARROW - 1, len(rows) - MAP_ROWS))
    shown = rows[first : first + MAP_ROWS]
    if len(shown) < len(rows):
        last = min(len(marks), (first + MAP_ROWS) * NARROW)
        return [*shown, f"{first * NARROW + 1} to {last} of {len(marks)}"]
    left_out = {"skipped", "failed"} & {p.state for p in status.session.poses}
    return [*shown, "+ done - skipped x failed"] if left_out else shown


_SHADES = " ░▒▓█"


def coverage_lines(status: StationStatus) -> list[str]:
    """The image as a grid: the fuller a part, the more corners were seen there."""
    counts = status.estimate.image_coverage
    if not counts:
        return ["no corners yet"]
    expected = max(1, status.detection.expected)
    return [
        " ".join(_SHADES[min(len(_SHADES) - 1, -(-count // expected))] * 3 for count in row) for row in counts
    ]


def estimate_lines(status: StationStatus) -> list[str]:
    estimate = status.estimate
    if estimate.sigma_translation_mm is None or estimate.translation_mm is None:
        seen = f"{estimate.views} view{'s' * (estimate.views != 1)}"
        return [seen, estimate.advice] if status.playback and estimate.advice else [f"{seen}: too few yet"]
    x, y, z = estimate.translation_mm
    session = status.session
    next_key = "3 shows the final one" if session.calibration else "F9 finds the final one"
    if session.check:
        next_key = "k on screen 4 judges it"
    advice = next_key if session.recording else estimate.advice
    left = estimate.improve and not (estimate.enough or session.recording)
    rotation = "" if estimate.sigma_rotation_deg is None else f"  {estimate.sigma_rotation_deg:.3f}°"
    return [
        f"{x:7.1f} {y:7.1f} {z:7.1f} mm",
        f"± {estimate.sigma_translation_mm:.2f} mm{rotation}",
        *(["p on screen 2 plans the rest"] if left else []),
        advice or ("enough" if estimate.enough else "not final"),
    ]
