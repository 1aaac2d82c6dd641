"""A session that a crash cut: found again at the next start, finished or resumed by a person."""

from __future__ import annotations

from recordings.errors import RecordingError
from station.analysis.pool import WorkerError
from station.analysis.worker import seen_before
from station.cell.errors import StationError
from station.cell.session_folder import interrupted_session
from station.cell.status import StationState
from station.session.context import SessionContext
from station.session.queue import PoseQueue
from station.session.recording import SessionRecording, to_the_end
from station.session.run import seal, sealed

_LOOK_BACK_S = 120.0


def find_interrupted(context: SessionContext) -> None:
    """Brings its poses back and stands in `stopped` until a person looked. Nothing moves."""
    found = interrupted_session(context.root)
    if found is None:
        return
    folder, state = found
    if state.source != context.cell.source:
        context.store.event(
            "interrupted-elsewhere",
            f"Session {folder.name} of a {state.source} cell is unfinished and cannot continue here: this "
            f"cell is {context.cell.source}. `recordings recover {folder}` saves it.",
            "warning",
        )
        return
    context.queue = PoseQueue(state.plan, state.poses)
    context.recording = SessionRecording(
        context.root, context.cell, folder, state.parts, state.elapsed_s, state.check
    )
    reason = (
        f"The daemon ended during session {folder.name}; its {context.queue.done} poses are on the disk. "
        "Look at the arm, acknowledge, then resume or finish."
    )
    context.store.enter(StationState.STOPPED, reason, "interrupted")
    context.show_poses()
    context.store.update_session(elapsed_s=state.elapsed_s, check=state.check)
    context.store.event("interrupted", reason, "warning", captured=context.queue.done)


async def look_back(context: SessionContext) -> None:
    """Reads what the images from before a restart show, for the estimate and the next pose.

    Read from the recording, which is made whole first; nothing when it is known already.
    """
    recording, queue = context.recording, context.queue
    if recording is None or recording.recorder is not None or context.seen or queue is None or not queue.done:
        return
    try:
        await context.recover_segments(recording)
        found = await context.workers.call(
            seen_before, recording.whole, context.cell.config.board, timeout_s=_LOOK_BACK_S
        )
    except (RecordingError, WorkerError) as error:
        context.store.problem(error, said="the estimate begins anew, without the images so far: {}")
        return
    context.seen.update({view.index: view for view in found})


async def close_or_seal(context: SessionContext) -> None:
    """Finishes: of an open recording the end is written, an interrupted one is made whole."""
    recording = context.require_recording()
    try:
        if recording.recorder is None:  # nothing was added since the crash
            context.store.enter(StationState.SEALING)
            await to_the_end(_make_whole(context, recording))
        else:
            await seal(context)
    except (RecordingError, StationError) as error:
        recording.abandon()
        context.store.problem(error, "error", said="not finished: {}")
        if context.store.state is not StationState.STOPPED:
            context.store.enter(StationState.FAULT, f"Recording: {error}", error.code)


async def _make_whole(context: SessionContext, recording: SessionRecording) -> None:
    await context.recover_segments(recording)
    await recording.save_state(context.require_queue(), recording.whole)
    sealed(context, recording.whole)
