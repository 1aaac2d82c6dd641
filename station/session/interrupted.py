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
from station.session.bench import Bench, SeenView
from station.session.queue import PoseQueue
from station.session.recording import SessionRecording, to_the_end
from station.session.run import recover_parts, seal, sealed

_LOOK_BACK_S = 120.0


def find_interrupted(bench: Bench) -> None:
    """Brings its poses back and stands in `stopped` until a person looked. Nothing moves."""
    found = interrupted_session(bench.root)
    if found is None:
        return
    folder, state = found
    if state.source != bench.cell.source:
        bench.store.event(
            f"session {folder.name} of a {state.source} cell was cut and is not sealed; it cannot go on "
            f"here, this cell is {bench.cell.source}: `recordings recover {folder}` saves it",
            "warning",
        )
        return
    bench.queue = PoseQueue(state.plan, state.poses)
    bench.recording = SessionRecording(
        bench.root, bench.cell, folder, state.parts, state.elapsed_s, state.check
    )
    reason = (
        f"the daemon ended during session {folder.name}; its {bench.queue.done} poses are on the disk. "
        "Look at the arm, acknowledge, then resume or finish."
    )
    bench.store.enter(StationState.STOPPED, reason)
    bench.show_poses()
    session = bench.store.status.session
    session = msgspec.structs.replace(session, elapsed_s=state.elapsed_s, check=state.check)
    bench.store.update(session=session)
    bench.store.event(reason, "warning")


async def look_back(bench: Bench) -> None:
    """What the pictures from before a restart show, for the estimate and the poses that would help most.

    Read from the recording, which is made whole first; nothing when it is known already.
    """
    recording, queue = bench.recording, bench.queue
    if recording is None or recording.recorder is not None or bench.seen or queue is None or not queue.done:
        return
    camera = bench.cell.config.camera.model
    try:
        await recover_parts(bench, recording)
        found = await bench.workers.call(
            seen_before, recording.whole, bench.cell.config.board, camera, timeout_s=_LOOK_BACK_S
        )
    except (RecordingError, WorkerError) as error:
        bench.store.event(f"the estimate begins anew, without the pictures so far: {error}", "warning")
        return
    for index, flange, seen in found:
        bench.seen[index] = SeenView(index, np.asarray(flange), seen.indices, seen.pixels)


async def close_or_seal(bench: Bench) -> None:
    """A person finishes: of an open recording the end is written, an interrupted one is made whole."""
    recording = bench.require_recording()
    try:
        if recording.recorder is None:
            await close_interrupted(bench)
        else:
            await seal(bench)
    except (RecordingError, StationError) as error:
        recording.abandon()
        bench.store.event(f"not sealed: {error}", "error")
        if bench.store.state is not StationState.STOPPED:
            bench.store.enter(StationState.FAULT, f"recording: {error}")


async def close_interrupted(bench: Bench) -> None:
    """Nothing was added since the crash: what is whole becomes the recording. Raises RecordingError."""
    bench.store.enter(StationState.SEALING)
    await to_the_end(_make_whole(bench, bench.require_recording()))


async def _make_whole(bench: Bench, recording: SessionRecording) -> None:
    await recover_parts(bench, recording)
    await recording.save_state(bench.require_queue(), recording.whole)
    sealed(bench, recording.whole)
