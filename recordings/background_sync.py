"""fdatasync beside the writer: what comes meanwhile still reaches the operating system.

What is on the disk leaves the computer's memory again, but for the newest part: a stream of gigabytes would
fill it with pages that nobody reads. Streams then ended after minutes, daemon or robot silent for tenths of a
second (docs/decisions/0088).
"""

from __future__ import annotations

import os
import threading
import time

KEPT_IN_MEMORY_BYTES = 256 * 2**20
"""Of one file: a session of single pictures stays for the solve that follows."""


class BackgroundSync:
    """Of one open file, one sync at a time. A failed one is raised by the next call, once and for all."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._thread: threading.Thread | None = None
        self._error: OSError | None = None
        self.last_s = 0.0
        """How long the newest one took."""

    @property
    def busy(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def begin(self) -> None:
        """Waits for the one before. OSError when that failed."""
        self.wait()
        self._thread = threading.Thread(target=self._sync, name="recorder sync", daemon=True)
        self._thread.start()

    def wait(self) -> None:
        """Until none runs. OSError when one failed: what it should have kept may be lost."""
        if self._thread is not None:
            self._thread.join()
        if self._error is not None:
            raise self._error

    def _sync(self) -> None:
        start_s = time.monotonic()
        try:
            os.fdatasync(self._descriptor)
            surplus = os.fstat(self._descriptor).st_size - KEPT_IN_MEMORY_BYTES
            if surplus > 0:  # a length of 0 would mean all of it
                os.posix_fadvise(self._descriptor, 0, surplus, os.POSIX_FADV_DONTNEED)
        except OSError as error:
            self._error = error
        self.last_s = time.monotonic() - start_s
