"""The recorder of a running session: one thread owns the file, all others hand messages over and go on.

While the disk is busy messages wait in memory: robot states are dropped where 20,000 wait (40 s at 500 Hz),
an image is refused where `IMAGES_LIMIT` do. Data reach the operating system after every image and at least
every 0.1 s, the disk at every `sync` and at least every 0.5 s, or as fast as it can.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from recordings.errors import RecordingError
from recordings.schema.messages import (
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

QUEUE_LIMIT_MESSAGES = 20_000
IMAGES_LIMIT = 8
"""Of the largest kind 288 MiB; a session waits for its image before it takes the next."""
FLUSH_PERIOD_S = 0.1
SYNC_PERIOD_S = 0.5
T = TypeVar("T")


class _Item(NamedTuple):
    work: Callable[[], Any]
    done: Future[Any] | None = None
    """Resolved to what the work returns."""


class Recorder:
    """Thread-safe. The first write error is final: later calls raise it, futures fail with it."""

    def __init__(self, path: Path, info: SessionInfo, *, clock: Callable[[], float] = time.monotonic) -> None:
        """Creates the file and starts the thread. Raises RecordingError."""
        self._writer = RecordingWriter(path, info)
        self.part_path = self._writer.part_path
        self.error: RecordingError | None = None
        self._clock = clock
        self._queue: deque[_Item] = deque()
        """Oldest first; that one is being written, and leaves when it is."""
        self._room = threading.Semaphore(IMAGES_LIMIT)
        self._lock = threading.RLock()
        self._wake = threading.Condition(self._lock)
        self._finished: Future[Path] | None = None
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """The writer's thread works; false after finish, close or an error."""
        return self._thread.is_alive()

    def robot_state(self, state: RobotState) -> bool:
        """False when it was dropped, or came after the end or an error."""
        with self._lock:
            if self._ended or self.error is not None or len(self._queue) >= QUEUE_LIMIT_MESSAGES:
                return False
            # Nobody is woken 500 times a second: it waits for the next flush.
            self._queue.append(_Item(lambda: self._writer.robot_state(state)))
            return True

    def image(self, image: Image) -> None:
        """RecordingError where too many wait; wait for `sync`. The array must not be changed afterwards."""
        if self.error is None and not self._room.acquire(blocking=False):
            raise RecordingError("disk-too-slow", waiting=IMAGES_LIMIT)

        def write() -> None:
            self._writer.image(image)
            self._room.release()

        self._put(write)

    def view(self, view: View) -> None:
        self._put(lambda: self._writer.view(view))

    def event(self, event: CaptureEvent) -> None:
        self._put(lambda: self._writer.event(event))

    def corners(self, sequence: int, pixels: NDArray[np.float64]) -> None:
        """Detected corners (n, 2) of a recorded image, for viewers."""
        self._put(lambda: self._writer.marks(sequence, [Marks(pixels, DETECTED)]))

    def frame(
        self, parent: str, child: str, parent_from_child: Matrix4, stamps: Stamps | None = None
    ) -> None:
        """Record a frame that stays where it is, for viewers."""
        self._put(lambda: self._writer.frame(parent, child, parent_from_child, stamps))

    def attach(self, name: str, media_type: str, content: bytes) -> None:
        self._put(lambda: self._writer.attach(name, media_type, content))

    def sync(self) -> Future[None]:
        """Resolves when everything handed over before is on the disk; fails with RecordingError."""
        return self._promise(self._writer.sync)

    def finish(self) -> Future[Path]:
        """Finishes the file after all that was handed over before; the future is its path. Idempotent."""
        with self._lock:
            if self._finished is None:
                self._finished = self._promise(self._writer.finish)
            return self._finished

    def close(self) -> None:
        """Stops the thread after what is queued; the unfinished `.part` file stays. Idempotent."""
        with self._lock:
            self._closing = True
            self._wake.notify()
        self._thread.join()

    def _promise(self, work: Callable[[], T]) -> Future[T]:
        done: Future[T] = Future()
        done.set_running_or_notify_cancel()  # nobody who stops waiting can cancel the writing
        try:
            self._put(work, done)
        except RecordingError as error:
            done.set_exception(error)
        return done

    def _put(self, work: Callable[[], Any], done: Future[Any] | None = None) -> None:
        with self._lock:
            if self.error is not None:
                raise self.error
            if self._ended:
                raise RecordingError("closed", path=self._writer.path)
            self._queue.append(_Item(work, done))
            self._wake.notify()

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
        while self._wait():
            if self._queue:
                item = self._queue[0]
                result = item.work()
                self._queue.popleft()
                if item.done is not None:
                    item.done.set_result(result)
                    continue  # all is on the disk, or the file is finished
            now_s = self._clock()
            if now_s - synced_s >= SYNC_PERIOD_S:
                self._writer.sync()
                flushed_s = synced_s = self._clock()  # a slow disk must not sync for every message
            elif now_s - flushed_s >= FLUSH_PERIOD_S:
                self._writer.flush()
                flushed_s = now_s

    def _wait(self) -> bool:
        """Wait for a message, at most a flush period. False when there will be no more."""
        with self._lock:
            if not self._queue and not self._ended:
                self._wake.wait(FLUSH_PERIOD_S)
            return bool(self._queue) or not self._ended

    def _fail(self, error: RecordingError) -> None:
        with self._lock:
            self.error = error
            waiting = [item.done for item in self._queue if item.done is not None]
            self._queue.clear()
        for done in waiting:
            done.set_exception(error)
