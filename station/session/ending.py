"""Ends of a run, an image by hand or a session: by an error, by the disk, or with a finished recording."""

from __future__ import annotations

import logging

from recordings.errors import ErrorData, RecordingError
from station.cell.errors import SafetyStopError, StationError
from station.cell.status import StationState
from station.session.context import RunRequests, SessionContext
from station.session.recording import to_the_end

log = logging.getLogger(__name__)


def failed(context: SessionContext, error: Exception) -> None:
    """End a run, or an image by hand, for an error; a STOP or lost control that ended it before stays."""
    if isinstance(error, RecordingError):
        disk_failed(context, error)
        return
    context.show_poses()
    if context.requests.halt:
        return
    if not isinstance(error, StationError):
        log.error("a defect of this program", exc_info=error)
        error = StationError("internal", error=repr(error))
    state = StationState.STOPPED if isinstance(error, SafetyStopError) else StationState.FAULT
    context.store.enter(state, error)
    context.store.problem(error, "error", context.store.status.session.current)


async def seal(context: SessionContext) -> None:
    """Finish the recording, also an interrupted one: sealing → idle. Raises RecordingError, StationError."""
    context.store.enter(StationState.SEALING)
    context.show_poses()
    context.requests = RunRequests(halt=context.requests.halt)
    await to_the_end(_seal(context))


async def _seal(context: SessionContext) -> None:
    """Finish the recording; a STOP meanwhile stays latched, or if acknowledged the state becomes idle."""
    recording, queue = context.require_recording(), context.loaded()
    if recording.recorder is None:  # nothing was added since the crash
        await context.recover_segments(recording)
    path = await recording.seal(queue)
    context.recording = None
    context.store.update_session(recording=str(path), remaining_s=0.0)
    # The most important first, as a narrow screen cuts the end.
    poses = len(queue.statuses)
    text = f"finished with {queue.done} of {poses} poses: {path}"
    context.store.event("finished", text, captured=queue.done, poses=poses, path=str(path))
    context.end_check()
    if context.store.state in (StationState.SEALING, StationState.PAUSED):
        context.store.enter(StationState.IDLE)


def disk_failed(context: SessionContext, error: RecordingError | StationError) -> None:
    """Report a disk error; the `.part` file stays for recovery, and a STOP meanwhile stays latched."""
    if context.recording is not None:
        context.recording.abandon()
    remedy = "What is saved is safe. Free space or mend the disk, then go on."
    reason = StationError.from_data(ErrorData(error.code, error.text, remedy))
    if context.store.state is StationState.STOPPED:
        context.store.update(reason=f"{context.store.status.reason} — {reason}")
    else:
        context.store.enter(StationState.FAULT, reason)
    context.store.problem(reason, "error", context.store.status.session.current)
    context.show_poses()


async def close_or_seal(context: SessionContext) -> None:
    """Finish the recording; on a disk error enter fault and leave the `.part` file."""
    try:
        await seal(context)
    except (RecordingError, StationError) as error:
        disk_failed(context, error)
