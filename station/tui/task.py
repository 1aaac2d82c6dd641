"""The task in four steps, and the one next action: pure functions of what is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from calibrate.files.validity import validity_text
from calibrate.handeye.metrics import FEWEST_TO_SOLVE
from station.cell.config import StationConfig
from station.cell.status import (
    NO_IMAGE,
    NOT_LOOKED,
    DetectionStatus,
    GuidanceStatus,
    SessionStatus,
    StationState,
    StationStatus,
)
from station.operate.goal import above_goal
from station.operate.next_step import StepKind, after_solve
from station.protocol.results import Kept, Result
from station.protocol.states import LATCHED, RUNNING
from station.protocol.verbs import Check
from station.tui.words import UNKNOWN, Mark, duration, many, sentence

STEPS = ("connect", "plan", "capture", "result")
DIGITS = {mode: str(place) for place, mode in enumerate((*STEPS, "sessions", "log"), start=1)}
NEED_CONTROL = ("F2", "F3", "F5", "F7", "n")
"""Keys of the one next action that are refused while another client has control."""
_STILL = {StationState.IDLE, StationState.PAUSED, StationState.FREE_DRIVE}


@dataclass(frozen=True)
class Step:
    """One step of the rail: what it holds, or what it waits for."""

    mode: str
    mark: Mark
    text: str
    brief: str = ""
    """What stands in place of `text` on a narrow screen."""


@dataclass(frozen=True)
class Action:
    """The one thing to do next."""

    key: str
    label: str
    why: str
    at: str = ""
    """The screen on which the key works; empty: on all."""
    look: bool = False
    """A person should look first."""

    def on(self, mode: str) -> Action:
        """Add the key that leads there, on any other screen."""
        if not self.at or self.at == mode:
            return self
        then = f"then {self.key}. " if self.key else ""
        return Action(DIGITS[self.at], self.label, then + self.why, look=self.look)


@dataclass(frozen=True)
class Known:
    """All that the screens know and are drawn from: the app has one, replaced by another at every change."""

    status: StationStatus | None = None
    """The newest status; kept when the daemon is gone."""
    checks: Sequence[Check] = ()
    """The preflight check, as it was last seen."""
    result: Result | None = None
    """Result of the session, or the picked one; None: nothing is solved."""
    silent_s: float | None = None
    """Seconds without an answer from the daemon; None while it answers."""
    busy: str = ""
    """Long work of the daemon for this screen, in words; empty: none."""
    gone: str = ""
    """Why there is no daemon; empty: there is one, or none was asked yet."""
    configuration: StationConfig | None = None
    """Facts of the cell; None until the daemon told them."""
    own_id: int | None = None
    """The number by which the lease names this screen; None: not told yet."""
    sessions: tuple[Kept, ...] | None = None
    """Recorded sessions below the daemon's root, newest first; None: not read yet."""

    @property
    def live(self) -> StationStatus | None:
        """The status as the daemon tells it; None: there is no daemon."""
        return None if self.gone else self.status

    @property
    def shown(self) -> StationStatus:
        """The newest status, also when it is out of date."""
        return self.status or StationStatus()

    @property
    def old(self) -> bool:
        """The status is out of date."""
        return bool(self.gone) or self.silent_s is not None

    @property
    def hand_guided(self) -> bool:
        """Views are taken by hand, also while one is saved; a STOP leaves the outline in the status."""
        state, outline = self.shown.state, self.shown.guidance.outline
        return state is StationState.FREE_DRIVE or (state in RUNNING and bool(outline))

    @property
    def blind(self) -> bool:
        """No picture is live: the status is old, or the camera gives no image."""
        return self.old or self.shown.detection.cause == NO_IMAGE

    @property
    def in_control(self) -> str:
        """Who else has control, so that this screen's keys for it would be refused; empty: nobody."""
        lease = self.shown.lease
        if self.live is None or self.own_id is None or lease.client_id in (None, self.own_id):
            return ""
        return lease.holder

    @property
    def has_control(self) -> bool:
        """This screen has control."""
        holder = None if self.live is None else self.live.lease.client_id
        return holder is not None and holder == self.own_id

    @property
    def works(self) -> bool:
        """The arm works, or may: nothing else should cost the daemon time."""
        return self.live is not None and self.live.state in RUNNING

    @property
    def goal_mm(self) -> float | None:
        """Placed-point error at which the views are enough; None: not told yet."""
        return None if self.configuration is None else 1000 * self.configuration.capture.goal_m

    @property
    def missing(self) -> Check | None:
        return next((check for check in self.checks if check.state == "failed"), None)


def beyond_goal(known: Known) -> str:
    """Say that no view lowers the error to the goal, by the images so far; empty where one may."""
    seen = known.shown.estimate
    return above_goal(seen.floor_mm, known.goal_mm, seen.predicted_error_mm, seen.with_more_views_mm)


def steps(known: Known) -> tuple[Step, ...]:
    """The rail, from left to right."""
    status = known.live
    if status is None:
        return tuple(Step(mode, "todo", UNKNOWN) for mode in STEPS)
    made = [_connect(known, status), _plan(status), _capture(known, status), _result(known)]
    now = _now(made, status, known)
    return tuple(
        Step(step.mode, "now", step.text, step.brief)
        if place == now and step.mark in ("todo", "done")
        else step
        for place, step in enumerate(made)
    )


def _now(made: list[Step], status: StationStatus, known: Known) -> int:
    if status.state in RUNNING or status.state in (StationState.PAUSED, StationState.FREE_DRIVE):
        return 2
    undone = [place for place, step in enumerate(made) if step.mark != "done"]
    to_run = status.session.poses and not status.session.recording
    if known.result is not None and known.result.calibration is not None and not to_run:
        return 3
    return undone[0] if undone else 3


def _connect(known: Known, status: StationStatus) -> Step:
    devices = [status.robot.connected, status.camera.connected]
    devices += [True] if status.trigger.identity else []
    if known.missing is not None:
        return Step("connect", "look", f"{known.missing.name} missing")
    ready = sum(devices)
    text = f"{many(ready, 'device')} ready" if all(devices) else f"{ready} of {len(devices)} devices"
    return Step("connect", "done" if all(devices) else "look", text)


def _plan(status: StationStatus) -> Step:
    poses = status.session.poses
    if status.robot.by_hand:
        return Step("plan", "done", "by hand")
    if not poses:
        return Step("plan", "todo", "no plan yet")
    return Step("plan", "done", many(len(poses), "pose"), str(len(poses)))


def _capture(known: Known, status: StationStatus) -> Step:
    session, state = status.session, status.state
    count = f"{session.captured} of {len(session.poses)}"
    brief = f"{session.captured}/{len(session.poses)}"
    if state in (StationState.STOPPED, StationState.FAULT):
        return Step("capture", "stopped", f"{state.value} at {count}", brief)
    if known.hand_guided:
        return Step("capture", "now", f"{many(session.captured, 'view')} by hand", str(session.captured))
    if not session.poses:
        return Step("capture", "todo", "not begun" if status.robot.by_hand else "after plan")
    if session.recording:
        return Step("capture", "done", f"{count} saved", brief)
    if state in RUNNING:
        left = "" if session.remaining_s is None else f", {duration(session.remaining_s)} left"
        return Step("capture", "now", f"{count}{left}", brief)
    if not session.name:
        return Step("capture", "todo", "not begun")
    return Step("capture", "now", f"{count}, {state.value}", brief)


def _result(known: Known) -> Step:
    result, status = known.result, known.live
    if result is None:
        waits = status is None or not status.session.recording
        return Step("result", "todo", "after capture" if waits else "not solved yet")
    calibration = result.calibration
    if calibration is None:
        return Step("result", "failed", "unreadable")
    if result.installed:
        return Step("result", "look" if result.state.doubted else "done", result.state.held.lower())
    gates, failed = calibration.quality.gates, calibration.quality.failed
    return Step(
        "result", "failed" if failed else "todo", f"{len(gates) - len(failed)} of {len(gates)} gates passed"
    )


def next_action(known: Known) -> Action:
    """Choose the one next action; its reason names alternatives."""
    status = known.live
    if known.silent_s is not None:
        why = f"No answer for {known.silent_s:.0f} s. What stands below is old."
        if known.shown.robot.by_hand:
            return Action("", "Wait", why, look=True)
        return Action("", "EMERGENCY STOP if it moves", f"{why} The arm's watchdog stops it.", look=True)
    if status is None:
        return _without_daemon(known)
    latched = status.state in LATCHED or status.state is StationState.DISCONNECTED
    if known.busy and not latched:
        why = " ".join(words for words in (known.busy, status.reason) if words)
        return Action("", "Wait", why, look=bool(status.reason))
    action = _by_state(known, status) or _at_rest(known, status)
    if known.in_control and action.key in NEED_CONTROL:
        why = f"{known.in_control} has control, and gives it back there. F12 stops the arm from here too."
        return Action("", "Only watch", why, look=True)
    if status.robot.by_hand and action.key in ("F5", "n"):
        why = " ".join(
            words for words in (sentence(status.reason), "You move the arm, it is only read.") if words
        )
        return Action("F3", "Take views by hand", why, look=action.look)
    return action


def _without_daemon(known: Known) -> Action:
    if known.status is None:
        return Action("", "Wait", known.gone or "Connecting …", look=bool(known.gone))
    session, safe = known.status.session, ""
    if session.name and session.captured and not session.recording:
        safe = f"Your {many(session.captured, 'pose')} {'is' if session.captured == 1 else 'are'} safe. "
    why = f"{safe}The daemon ended{'' if known.status.robot.by_hand else ': the controller stops the arm'}."
    return Action("Ctrl-Q", "Close, then run station", why, look=True)


def _by_state(known: Known, status: StationStatus) -> Action | None:
    """Choose the action where the arm works or is held; None at rest."""
    state, held = status.state, status.robot.condition.held
    if state in LATCHED:
        why = f"{sentence(status.reason)} Look at the cell first; F8 moves nothing.".strip()
        return Action("F8", "Acknowledge", why, look=True)
    if state is StationState.DISCONNECTED and not (status.robot.by_hand and status.session.recording):
        why = sentence(status.reason) or "The robot does not answer."
        return Action("", "See what is missing", why, at="connect", look=True)
    if status.guidance.outline and state in (*RUNNING, StationState.FREE_DRIVE):
        return _by_hand(known, status)
    if state in RUNNING:
        good = "Good enough already: F7 finishes. " if status.estimate.enough else ""
        if beyond := beyond_goal(known):
            good = f"{sentence(beyond)} {'F7 finishes. ' if status.estimate.enough else ''}"
        failed = [pose for pose in status.session.poses if pose.state == "failed"]
        lost = f"{many(len(failed), 'pose')} failed: {failed[-1].reason}" if failed else ""
        why = status.pending or status.reason or lost or f"{good}F12 stops it at once, F6 after this pose."
        return Action("", "Watch the arm", why)
    if state is StationState.SEALING:
        return Action("", "Wait", "The recording is being finished.")
    if held and state in _STILL:
        return Action("", "At the pendant", sentence(held), look=True)
    if state is StationState.PAUSED:
        saved = f"{status.session.captured} of {len(status.session.poses)} are saved; F7 finishes with these."
        why = " ".join(words for words in (sentence(status.reason), saved) if words)
        left = status.robot.by_hand or any(pose.state == "planned" for pose in status.session.poses)
        key, label = ("F5", "Continue") if left else ("F7", "Finish")
        return Action(key, label, why, look=bool(status.reason))
    if state is StationState.FREE_DRIVE:
        return Action("F2", "Capture an image here", "Guide the arm by the pendant's button; F3 ends it.")
    return None


def _by_hand(known: Known, status: StationStatus) -> Action:
    guidance, seen = status.guidance, status.detection
    if status.state in RUNNING:
        return Action("", "Hold still", "The view is being taken.")
    if guidance.enough:
        saved = f"{many(status.session.captured, 'view')} are saved."
        beyond = "" if status.session.check else sentence(beyond_goal(known))
        return Action("F7", "Enough: finish", f"{saved} {beyond}".strip())
    return to_wanted(guidance, seen)


def to_wanted(guidance: GuidanceStatus, seen: DetectionStatus) -> Action:
    """Tell the way from what is seen to the wanted view."""
    if seen.cause == NO_IMAGE:
        return Action("", "No image", sentence(seen.reason), look=True)
    if seen.cause == NOT_LOOKED:
        return Action("", "Wait", sentence(seen.reason), look=True)
    if not seen.found:
        return Action("", "Show the whole board", seen.reason)
    why = guidance.warning or "The outline in the picture shows it. A new view is taken when all is still."
    return Action("", guidance.words or "Hold still", why, look=bool(guidance.warning))


def _at_rest(known: Known, status: StationStatus) -> Action:
    session, result, missing = status.session, known.result, known.missing
    recorded = session.recording or status.checked.recording
    if missing is not None and not recorded:  # solving and installing need no device
        why = sentence(missing.remedy or missing.text)
        return Action("", f"Mend: {missing.name}", why, at="connect", look=True)
    if _to_judge(known, status.checked):
        return Action("k", "Judge the drift check", "Its recording is finished.", at="sessions")
    if session.poses and not session.recording:
        skipped = sum(pose.state == "skipped" for pose in session.poses)
        left_out = f", {skipped} skipped," if skipped else ""
        asks = f"Shows the motion to {many(len(session.poses) - skipped, 'pose')}{left_out} and asks first."
        return Action("F5", "Start the capture", f"{sentence(status.reason)} {asks}".strip())
    if result is not None:
        return _with_result(result, status)
    if not session.poses:
        return Action("F5", "Plan and start", "Plans, shows the motion and asks first.")
    if session.captured < FEWEST_TO_SOLVE:
        few = f"{too_few(session.captured)} F5 takes the plan again, n on 2 makes another."
        return Action("F5", "Capture again", few, look=True)
    return Action("F9", "Solve", f"{many(session.captured, 'pose')} saved; solving takes some seconds.")


def too_few(captured: int) -> str:
    """Say that a finished session has too few poses to be solved."""
    return (
        f"{many(captured, 'pose') if captured else 'No pose'} saved: {FEWEST_TO_SOLVE} are needed to solve."
    )


def _to_judge(known: Known, checked: SessionStatus) -> bool:
    """A drift check was recorded, and nobody has asked yet what it says."""
    if not checked.recording or not checked.captured:
        return False
    return not any(kept.session.name == checked.name and kept.check for kept in known.sessions or ())


def _with_result(result: Result, status: StationStatus) -> Action:
    calibration = result.calibration
    if calibration is None:
        return Action("", "Choose a session", result.problem, at="sessions", look=True)
    step = after_solve(calibration, result.objections)
    if result.installed and (validity := result.state.validity) is not None and result.state.doubted:
        return Action("n", "Plan 25 poses", sentence(validity_text(validity)), at="plan", look=True)
    if result.installed:
        return Action("d", "Drift check", "Installed. Check in some days that it still holds.", at="result")
    if step.kind is StepKind.INSTALL:
        needless = calibration.verification or status.source == "simulated"
        touch = "" if needless else " Or h: a touch test first."
        return Action("i", "Install", f"PASS: {step.text}.{touch}", at="result")
    if step.kind is StepKind.RETAKE:
        return Action("n", "Plan and retake", step.text, at="plan", look=True)
    if step.text in result.objections:
        return Action(
            "", "See what speaks against it", f"{step.text} i asks for a reason.", at="result", look=True
        )
    return Action("", "See what failed", f"Look for: {step.text}", at="result", look=True)
