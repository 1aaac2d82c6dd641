"""What a person is asked before anything moves: checked, from where the arm stands now."""

from __future__ import annotations

import msgspec

from recordings.errors import RecordingError
from recordings.files import require_free_space
from station.analysis.worker import check_run
from station.cell.errors import LimitError, RefusedError
from station.cell.limits import PlanCheck
from station.cell.status import MotionPreview
from station.protocol.verbs import Purpose
from station.session.context import SessionContext
from station.session.lease import ApprovalManager
from station.session.patience import RestingCheck
from station.session.queue import PlanRevision, PoseQueue
from station.session.supervisor import displacement

POSE_OVERHEAD_S = 0.8
"""Settle, expose, look, write: what a stop takes beside the move."""
_PROBLEMS_SHOWN = 12
_SLOW_SLIDER = 0.99


def begun_anew(context: SessionContext, purpose: Purpose) -> PlanRevision | None:
    """The loaded plan for a session that begins with this go; until then the last session stays shown."""
    queue = context.queue
    if purpose is not Purpose.RUN or context.recording is not None or queue is None:
        return None
    again = queue.anew()
    return PlanRevision(purpose, again, _open(again), queue.sha256, ())


def poses_to_drive(context: SessionContext, purpose: Purpose, index: int | None) -> tuple[int, ...]:
    """The poses a go for this purpose covers. RefusedError when there are none."""
    queue = context.queue
    if queue is None:
        raise RefusedError("no plan is loaded: load or make one first")
    if purpose in (Purpose.RETAKE, Purpose.RESUME) and context.recording is None:
        raise RefusedError("no session is open: run the plan to begin one")
    if purpose is Purpose.RETAKE:
        if index is None:
            raise RefusedError("say which pose to retake")
        if queue.status(index).state != "planned":
            queue.retake(index)
        return (index,)
    if purpose is Purpose.DRIFT_CHECK and context.recording is not None:
        raise RefusedError("a session is open: finish it first, then check")
    return _open(queue)


def _open(queue: PoseQueue) -> tuple[int, ...]:
    if not queue.open:
        raise RefusedError("no pose is left to take: retake some, or finish")
    return queue.open


async def summarise(
    context: SessionContext,
    purpose: Purpose,
    queue: PoseQueue,
    poses: tuple[int, ...],
    notes: tuple[str, ...],
    changes: tuple[str, ...] = (),
) -> MotionPreview:
    """Checks the whole way in the worker. LimitError lists what is wrong with it, RobotError with the arm."""
    robot = context.cell.robot
    try:
        require_free_space(context.root, context.cell.config.capture.free_space_bytes)
    except (RecordingError, OSError) as full:
        raise RefusedError(f"{full}. Nothing moved.") from None
    await RestingCheck(robot.check).news()
    start = robot.latest().joints_rad
    plan = queue.plan
    part = msgspec.structs.replace(plan, poses=tuple(queue.pose(index) for index in poses))
    check: PlanCheck = await context.workers.call(check_run, context.cell.config, part, start)
    if check.problems:
        raise LimitError(_problem_text(check))
    return MotionPreview(
        token=ApprovalManager.new_token(),
        purpose=_purpose_words(context, purpose, poses),
        plan_sha256=queue.sha256,
        poses=len(poses),
        path_m=round(check.path_m, 3),
        largest_step_rad=round(check.largest_step_rad, 4),
        top_speed_m_s=round(check.top_speed_m_s, 3),
        duration_s=round(check.duration_s + POSE_OVERHEAD_S * len(poses), 1),
        first_move=f"{displacement(context, start, part.poses[0].joints_rad)} to pose {poses[0] + 1}",
        changes=changes,
        warnings=(*notes, *_warnings(context)),
        start_joints_rad=start,
    )


def _problem_text(check: PlanCheck) -> str:
    shown = [str(problem) for problem in check.problems[:_PROBLEMS_SHOWN]]
    more = len(check.problems) - len(shown)
    tail = [f"… and {more} more"] if more > 0 else []
    return "the plan is refused, nothing moved:\n" + "\n".join([*shown, *tail])


def _purpose_words(context: SessionContext, purpose: Purpose, poses: tuple[int, ...]) -> str:
    if purpose is Purpose.RETAKE:
        return f"retake pose {poses[0] + 1}"
    if context.queue is not None and context.queue.plan.motion == "sweep":
        return f"sweep: {len(poses)} slow swings without a stop, the camera running"
    if purpose is Purpose.DRIFT_CHECK:
        return "drift check of the installed calibration"
    if context.recording is None:
        return "run plan"
    if purpose is Purpose.NEXT_POSE:
        return f"one pose more for session {context.recording.name}"
    if purpose is Purpose.REPLAN:
        return f"go on with session {context.recording.name}, the poses that are left planned anew"
    return f"go on with session {context.recording.name}"


def _warnings(context: SessionContext) -> list[str]:
    warnings = []
    slider = context.cell.robot.latest().target_speed_fraction
    if slider < _SLOW_SLIDER:
        warnings.append(f"the speed slider stands at {100 * slider:.0f} %")
    if context.cell.simulated:
        warnings.append("SIMULATED cell: nothing real moves")
    if context.cell.source == "playback":
        warnings.append("PLAYBACK of a recording: no arm moves")
    return warnings
