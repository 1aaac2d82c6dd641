"""Motion that a person may approve: its poses, a preview from where the arm is, and the one-use approval.

The daemon's side; how a client asks for a motion and shows it to a person: `operate.motion`.
"""

from __future__ import annotations

import math
import secrets
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from calibrate.arms.kinematics import forward
from recordings.errors import RecordingError
from recordings.files import require_free_space
from recordings.geometry import difference
from recordings.schema.messages import RobotState, Vector6
from station.cell.arm_acceptance import StopTestMove
from station.cell.config import vector6
from station.cell.errors import LimitError, RefusedError
from station.cell.layout import approval_sha256, arm_model, cell_geometry, require_kept_clear
from station.cell.limits import PlanCheck, check_plan
from station.cell.pose_plan import Plan
from station.cell.session_folder import require_writable
from station.cell.status import APPROVAL_LIFETIME_S, MotionPreview
from station.protocol.verbs import PLANNED_ELSEWHERE, Purpose
from station.session.context import SessionContext
from station.session.queue import PoseQueue
from station.session.threads import DISK

POSE_OVERHEAD_S = 0.8
"""Time per pose besides the move: settling, exposure, detection, writing."""
START_TOLERANCE_RAD = 0.005
"""Largest joint difference between where the arm stood when the motion was offered and at its start."""
_PROBLEMS_SHOWN = 12
_SLOW_SLIDER = 0.99


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses that one approval covers; no others may be driven to.

    At each pose an image is captured, or, in a stop test, the move to it is stopped half way.
    """

    purpose: Purpose
    queue: PoseQueue
    """Poses of the session: the open one, or the one that begins with the approval."""
    poses: tuple[int, ...]
    """Pose numbers, in order."""
    stop_test: StopTestMove | None = None
    """Move of a stop test, which records nothing; None: images are captured."""


def session_motion(context: SessionContext, purpose: Purpose) -> Motion:
    """Choose the poses that an approval for this purpose would cover.

    RefusedError when there are none, or when another cell or device began the open session.

    A new session gets poses of its own: until the approval the last session stays shown.
    """
    queue, begun = context.loaded(), context.recording is not None
    if purpose is Purpose.RESUME and not begun:
        raise RefusedError("no-session")
    if purpose is Purpose.DRIFT_CHECK and begun:
        raise RefusedError("session-open")
    if purpose is Purpose.RUN and not begun:
        queue = queue.anew()
    if not queue.open:
        raise RefusedError("no-pose-left")
    context.require_same_cell(connected=False)
    return Motion(purpose, queue, queue.open)


async def offered(context: SessionContext, motion: Motion, client_id: int) -> MotionApproval:
    """Check the whole path in the worker and make what a client may approve, with its preview.

    LimitError: not free; ConfigError: nobody knows where camera or board are; RobotError.
    """
    if context.cell.source != "playback":  # there no arm moves
        require_kept_clear(context.cell.config)
    try:
        await DISK.run(require_writable, context.root)
        await DISK.run(require_free_space, context.root, context.cell.config.capture.free_space_bytes)
    except (RecordingError, OSError) as full:
        raise RefusedError("disk-full", reason=str(full)) from None
    state = await context.ready_state()
    start = vector6(state.joints_rad)
    queue, poses = motion.queue, motion.poses
    plan = msgspec.structs.replace(queue.plan, poses=tuple(queue.pose(index) for index in poses))
    check: PlanCheck = await context.workers.call(check_plan, plan, start, cell_geometry(context.cell.config))
    if check.problems:
        raise await _refused(context, plan, check, start)
    overhead_s = 0.0 if motion.stop_test else POSE_OVERHEAD_S * len(poses)
    preview = MotionPreview(
        token=secrets.token_urlsafe(16),
        purpose=_purpose_words(context, motion),
        approval_sha256=approval_sha256(queue.plan, context.cell.config),
        poses=len(poses),
        path_m=round(check.path_m, 3),
        largest_step_rad=round(check.largest_step_rad, 4),
        top_speed_m_s=round(check.top_speed_m_s, 3),
        duration_s=round(check.duration_s + overhead_s, 1),
        first_move=f"{_displacement(context, start, plan.poses[0].joints_rad)} to pose {poses[0] + 1}",
        warnings=(*_skipped(motion), *await _warnings(context, state)),
        stop_test=motion.stop_test,
    )
    return MotionApproval(motion, preview, client_id, start)


def _displacement(context: SessionContext, before: Sequence[float], after: Sequence[float]) -> str:
    """Describe the flange's motion between two joints (6,), as '84 mm and 22°'."""
    delta = difference(*forward(arm_model(context.cell.config.robot), [after, before]))
    distance_m, angle_rad = np.linalg.norm(delta[:3]), np.linalg.norm(delta[3:])
    return f"{1000 * distance_m:.0f} mm and {np.degrees(angle_rad):.0f}°"


async def _refused(context: SessionContext, plan: Plan, check: PlanCheck, start: Vector6) -> LimitError:
    """Make the error for a plan that is not free, special if only the path to its first pose is not."""
    refused = LimitError("plan", problems=len(check.problems), listed=_listed(check))
    if not check.moves or len(check.problems) > len(check.moves[0].problems):
        return refused
    cell, first_rad = context.cell, plan.poses[0].joints_rad
    if (await context.workers.call(check_plan, plan, first_rad, cell_geometry(cell.config))).problems:
        return refused
    advice = "Bring the arm to its first pose by hand"
    if plan.criterion is not None:
        advice = "Plan again from here"
        if cell.config_path:
            advice += f": `station plan --config {shlex.quote(cell.config_path)} -o plan.yaml`"
    return LimitError(
        PLANNED_ELSEWHERE,
        standing=_degrees(start),
        pose=check.moves[0].name,
        target=_degrees(first_rad),
        problem=check.problems[0].text,
        problems=len(check.problems),
        advice=advice,
    )


def _degrees(joints_rad: Sequence[float]) -> str:
    return ", ".join(f"{math.degrees(q):.0f}" for q in joints_rad) + "°"


def _listed(check: PlanCheck) -> str:
    shown = [str(problem) for problem in check.problems[:_PROBLEMS_SHOWN]]
    more = len(check.problems) - len(shown)
    return "\n".join([*shown, *([f"… and {more} more"] if more else [])])


def _purpose_words(context: SessionContext, motion: Motion) -> str:
    if motion.stop_test is not None:
        return motion.queue.plan.note
    if motion.purpose is Purpose.DRIFT_CHECK:
        return "drift check of the installed calibration"
    if context.recording is None:
        return "run plan"
    return f"continue session {context.recording.name}"


def _skipped(motion: Motion) -> list[str]:
    """Say which poses of the plan a person skipped, perhaps in the session before."""
    skipped = motion.queue.skipped
    poses = len(motion.queue.statuses)
    if motion.stop_test is not None or not skipped:
        return []
    numbers = ", ".join(str(index + 1) for index in skipped)
    return [f"{len(skipped)} of {poses} poses are skipped: {numbers}; retake on Plan takes one back"]


async def _warnings(context: SessionContext, state: RobotState) -> list[str]:
    warnings = []
    slider = state.target_speed_fraction
    if slider < _SLOW_SLIDER:
        warnings.append(f"the speed slider stands at {100 * slider:.0f} %")
    if trouble := await DISK.run(context.cell.acceptance_trouble, context.root):
        warnings.append(f"the arm's stops are {trouble}")
    if context.cell.source == "simulated":
        warnings.append("SIMULATED cell: nothing real moves")
    if context.cell.source == "playback":
        warnings.append("PLAYBACK of a recording: no arm moves")
    return warnings


@dataclass(frozen=True)
class MotionApproval:
    """Motion offered for approval: what it covers, from where, and for which client."""

    motion: Motion
    preview: MotionPreview
    client_id: int
    start_joints_rad: Vector6
    expires_s: float = 0.0
    approval: str = ""
    """Who approved it, and how."""

    @property
    def said(self) -> str:
        """Text on the approval for log and recording."""
        return f"{self.approval}: {self.preview.purpose}, plan and cell {self.preview.approval_sha256[:12]}"


class ApprovalManager:
    """Manager of the one offered motion that may be approved, once, or voided."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.waiting: MotionApproval | None = None
        self.voids = 0
        """Number of times approvals were voided: a preflight check that began before may not offer one."""

    def offer(self, asked: MotionApproval) -> None:
        """Offer a motion for `APPROVAL_LIFETIME_S`; an older offer is void."""
        self.waiting = replace(asked, expires_s=self._clock() + APPROVAL_LIFETIME_S)

    def void(self) -> None:
        """Withdraw the offered motion, if any."""
        self.voids += 1
        self.waiting = None

    def redeem(self, token: str, client_id: int, sha256: str, joints_rad: Sequence[float]) -> MotionApproval:
        """Return the approval, once. RefusedError when anything changed since the offer, then void."""
        asked, self.waiting = self.waiting, None
        if asked is None or not secrets.compare_digest(asked.preview.token.encode(), token.encode()):
            raise RefusedError("approval-used")
        if self._clock() > asked.expires_s:
            raise RefusedError("approval-expired", limit_s=APPROVAL_LIFETIME_S)
        if asked.client_id != client_id:
            raise RefusedError("approval-of-another")
        # A stop test does not depend on the plan. A new session's poses have the hash of those shown so far.
        if asked.motion.stop_test is None and asked.preview.approval_sha256 != sha256:
            raise RefusedError("plan-changed")
        require_start(joints_rad, asked.start_joints_rad, "since the approval was asked for")
        return asked


def require_start(joints_rad: Sequence[float], start_rad: Sequence[float], when: str) -> None:
    """Raise RefusedError when joints (6,) differ from `start_rad` by more than `START_TOLERANCE_RAD`."""
    moved_rad = float(np.abs(np.subtract(joints_rad, start_rad)).max())
    if not moved_rad <= START_TOLERANCE_RAD:  # nor is NaN where the arm stood
        advice = "Request the approval again."
        raise RefusedError(
            "arm-moved", when=when, moved_rad=moved_rad, limit_rad=START_TOLERANCE_RAD, advice=advice
        )
