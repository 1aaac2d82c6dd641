"""The recorder of a running session: one thread owns the file, all others hand messages over and go on.

Images and robot states are dropped, and counted, when the disk cannot keep up; views, events and
attachments never are. Data reach the operating system after every image and at least every 0.1 s, the
disk at every `sync` and at least every 0.5 s; the regular ones run beside the writing, which goes on.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recordings.errors import RecordingError, UnfinishedRecordingError, recover_line
from recordings.schema.messages import (
    CameraModel,
    CaptureEvent,
    Image,
    Matrix4,
    RobotState,
    SessionInfo,
    Stamps,
    View,
)
from recordings.schema.viewing import DETECTED, Marks
from recordings.writer import RecordingWriter

QUEUE_LIMIT_BYTES = 256 * 1024 * 1024
"""At 150 fps of 1280×1024 bytes 1.3 s, which a disk may hesitate for."""
QUEUE_LIMIT_MESSAGES = 20_000
FLUSH_PERIOD_S = 0.1
SYNC_PERIOD_S = 0.5
_STATE_BYTES = 400
_SMALL_BYTES = 1000


class _Item(NamedTuple):
    write: Callable[[], object]
    size_bytes: int
    done: Future[None] | None = None
    """Resolved after a sync that follows the write."""


class Recorder:
    """Thread-safe. The first write error is final: later calls raise it, futures fail with it.

    `dropped`: images and states lost to a full queue.
    """

    def __init__(
        self,
        path: Path,
        info: SessionInfo,
        *,
        queue_limit_bytes: int = QUEUE_LIMIT_BYTES,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Creates the file and starts the thread. Raises RecordingError."""
        self._writer = RecordingWriter(path, info)
        self.part_path = self._writer.part_path
        self.dropped = 0
        self.error: RecordingError | None = None
        self._queue_limit_bytes = queue_limit_bytes
        self._clock = clock
        self._queue: deque[_Item] = deque()
        self._queued_bytes = 0
        self._dropped_images: set[int] = set()
        self._lock = threading.RLock()
        self._wake = threading.Condition(self._lock)
        self._awaited: Future[None] | None = None
        """Future of the item that is being written."""
        self._finished: Future[Path] | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """The writer's thread works; false after finish, close or an error."""
        return self._thread.is_alive()

    def robot_state(self, state: RobotState) -> bool:
        """False when it was dropped, or came after the end."""
        return self._offer(lambda: self._writer.robot_state(state), _STATE_BYTES)

    def image(self, image: Image) -> bool:
        """False when it was dropped: take it again. The array must not be changed afterwards."""
        kept = self._offer(lambda: self._writer.image(image), image.pixels.nbytes)
        if not kept:
            self._dropped_images.add(image.sequence)
        return kept

    def view(self, view: View) -> None:
        """Raises RecordingError when its image was dropped or an earlier write failed."""
        if self.error is None and view.picture_sequence in self._dropped_images:
            raise RecordingError("image-dropped", pose=view.index + 1)
        self._put(_Item(lambda: self._writer.view(view), _SMALL_BYTES))

    def event(self, event: CaptureEvent) -> None:
        self._put(_Item(lambda: self._writer.event(event), _SMALL_BYTES))

    def camera_model(self, model: CameraModel) -> None:
        self._put(_Item(lambda: self._writer.camera_model(model), _SMALL_BYTES))

    def corners(self, sequence: int, pixels: NDArray[np.float64]) -> None:
        """Detected corners (n, 2) of a recorded image, for viewers."""
        marks = [Marks(pixels, DETECTED)]
        if sequence not in self._dropped_images:
            self._put(_Item(lambda: self._writer.marks(sequence, marks), _SMALL_BYTES))

    def frame(
        self, parent: str, child: str, parent_from_child: Matrix4, stamps: Stamps | None = None
    ) -> None:
        """Record a frame that stays where it is, for viewers."""
        self._put(_Item(lambda: self._writer.frame(parent, child, parent_from_child, stamps), _SMALL_BYTES))

    def attach(self, name: str, media_type: str, content: bytes) -> None:
        self._put(_Item(lambda: self._writer.attach(name, media_type, content), len(content)))

    def sync(self) -> Future[None]:
        """Resolves when everything handed over before is on the disk; fails with RecordingError."""
        done: Future[None] = Future()
        done.set_running_or_notify_cancel()  # nobody who stops waiting can cancel the writing
        try:
            self._put(_Item(lambda: None, 0, done))
        except RecordingError as error:
            done.set_exception(error)
        return done

    def finish(self) -> Future[Path]:
        """Finishes the file after all that was handed over before; the future is its path. Idempotent."""
        with self._lock:
            if self._finished is None:
                self._finished = Future()
                self._finished.set_running_or_notify_cancel()
                if self.error is not None:
                    self._finished.set_exception(self.error)
                elif self._closing:
                    path, rescue = self.part_path, recover_line(self.part_path)
                    self._finished.set_exception(
                        UnfinishedRecordingError(path=path, reason="the recorder was closed", rescue=rescue)
                    )
                self._wake.notify()
            return self._finished

    def close(self) -> None:
        """Stops the thread after what is queued; the unfinished `.part` file stays. Idempotent."""
        with self._lock:
            self._closing = True
            self._wake.notify()
        self._thread.join()

    def _offer(self, write: Callable[[], object], size_bytes: int) -> bool:
        with self._lock:
            if self._ended:
                return False
            full = (
                self._queued_bytes + size_bytes > self._queue_limit_bytes
                or len(self._queue) >= QUEUE_LIMIT_MESSAGES
            )
            if full or self.error is not None:
                self.dropped += 1
                return False
            self._append(_Item(write, size_bytes))
            if size_bytes > _STATE_BYTES:  # states wait for the next flush: no 500 wake-ups a second
                self._wake.notify()
            return True

    def _put(self, item: _Item) -> None:
        with self._lock:
            if self.error is not None:
                raise self.error
            if self._ended:
                raise RecordingError("closed", path=self._writer.path)
            self._append(item)
            self._wake.notify()

    def _append(self, item: _Item) -> None:
        self._queue.append(item)
        self._queued_bytes += item.size_bytes

    @property
    def _ended(self) -> bool:
        return self._finished is not None or self._closing

    def _run(self) -> None:
        try:
            self._work()
        except RecordingError as error:
            self._fail(error)
        except Exception as error:
            self._fail(RecordingError("recorder", path=self.part_path, reason=repr(error)))
        finally:
            self._writer.close()

    def _work(self) -> None:
        flushed_s = synced_s = self._clock()
        while (items := self._next()) is not None:
            if items:
                self._write(items)
            now_s = self._clock()
            if now_s - synced_s >= SYNC_PERIOD_S:
                self._writer.begin_sync()
                flushed_s = synced_s = now_s
            elif now_s - flushed_s >= FLUSH_PERIOD_S:
                self._writer.flush()
                flushed_s = now_s
        if self._finished is not None and not self._finished.done():
            self._finished.set_result(self._writer.finish())

    def _next(self) -> list[_Item] | None:
        """Take the oldest items: states up to and including the first other item.

        Another item may be large, or a caller may wait for it, so it is written before more are taken. Empty
        when none came for a flush period; None when there will be no more.
        """
        items: list[_Item] = []
        with self._lock:
            if not self._queue and not self._ended:
                self._wake.wait(FLUSH_PERIOD_S)
            if not self._queue and self._ended:
                return None
            while self._queue:
                item = self._queue.popleft()
                self._queued_bytes -= item.size_bytes
                items.append(item)
                if item.size_bytes != _STATE_BYTES:
                    break
        return items

    def _write(self, items: list[_Item]) -> None:
        self._awaited = items[-1].done
        for item in items:
            item.write()
        if self._awaited is not None:
            self._writer.sync()
            self._awaited.set_result(None)
        self._awaited = None

    def _fail(self, error: RecordingError) -> None:
        with self._lock:
            self.error = error
            futures = [self._awaited, *(item.done for item in self._queue)]
            self._queue.clear()
            self._queued_bytes = 0
            if self._finished is not None and not self._finished.done():
                self._finished.set_exception(error)
        for future in futures:
            if future is not None:
                future.set_exception(error)
