"""A session that a crash cut: found again at the next start, closed or gone on with by a person."""

from __future__ import annotations

import msgspec
import numpy as np

from recordings.errors import RecordingError
from station.analysis.pool import WorkerError
from station.analysis.worker import seen_before
from station.cell.errors import StationError
from station.cell.session_folder import interrupted_session
from station.cell.status import StationState
from station.session.context import CapturedView, SessionContext
from station.session.queue import PoseQueue
from station.session.recording import SessionRecording, to_the_end
from station.session.run import recover_parts, seal, sealed

_LOOK_BACK_S = 120.0


def find_interrupted(context: SessionContext) -> None:
    """Brings its poses back and stands in `stopped` until a person looked. Nothing moves."""
    found = interrupted_session(context.root)
    if found is None:
        return
    folder, state = found
    if state.source != context.cell.source:
        context.store.event(
            f"session {folder.name} of a {state.source} cell was cut and is not sealed; it cannot go on "
            f"here, this cell is {context.cell.source}: `recordings recover {folder}` saves it",
            "warning",
        )
        return
    context.queue = PoseQueue(state.plan, state.poses)
    context.recording = SessionRecording(
        context.root, context.cell, folder, state.parts, state.elapsed_s, state.check
    )
    reason = (
        f"the daemon ended during session {folder.name}; its {context.queue.done} poses are on the disk. "
        "Look at the arm, acknowledge, then resume or finish."
    )
    context.store.enter(StationState.STOPPED, reason)
    context.show_poses()
    session = context.store.status.session
    session = msgspec.structs.replace(session, elapsed_s=state.elapsed_s, check=state.check)
    context.store.update(session=session)
    context.store.event(reason, "warning")


async def look_back(context: SessionContext) -> None:
    """What the pictures from before a restart show, for the estimate and the poses that would help most.

    Read from the recording, which is made whole first; nothing when it is known already.
    """
    recording, queue = context.recording, context.queue
    if recording is None or recording.recorder is not None or context.seen or queue is None or not queue.done:
        return
    camera = context.cell.config.camera.model
    try:
        await recover_parts(context, recording)
        found = await context.workers.call(
            seen_before, recording.whole, context.cell.config.board, camera, timeout_s=_LOOK_BACK_S
        )
    except (RecordingError, WorkerError) as error:
        context.store.event(f"the estimate begins anew, without the pictures so far: {error}", "warning")
        return
    for index, flange, seen in found:
        context.seen[index] = CapturedView(index, np.asarray(flange), seen.indices, seen.pixels)


async def close_or_seal(context: SessionContext) -> None:
    """A person finishes: of an open recording the end is written, an interrupted one is made whole."""
    recording = context.require_recording()
    try:
        if recording.recorder is None:
            await close_interrupted(context)
        else:
            await seal(context)
    except (RecordingError, StationError) as error:
        recording.abandon()
        context.store.event(f"not sealed: {error}", "error")
        if context.store.state is not StationState.STOPPED:
            context.store.enter(StationState.FAULT, f"recording: {error}")


async def close_interrupted(context: SessionContext) -> None:
    """Nothing was added since the crash: what is whole becomes the recording. Raises RecordingError."""
    context.store.enter(StationState.SEALING)
    await to_the_end(_make_whole(context, context.require_recording()))


async def _make_whole(context: SessionContext, recording: SessionRecording) -> None:
    await recover_parts(context, recording)
    await recording.save_state(context.require_queue(), recording.whole)
    sealed(context, recording.whole)
