"""One BLAS thread while the library computes, whatever the program that calls it has set.

The solver multiplies many small matrices. On several threads OpenBLAS waits for each of them in a busy loop:
a solve then costs ten times the CPU, and a hundred times beside other work. The command line and the services
set one thread before NumPy is loaded; a library cannot ask that of its user. Decision 0127.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import LibController, ThreadpoolController


class _Limit:
    """One thread for some libraries: how many callers need it now, and what was set before the first."""

    def __init__(self) -> None:
        self._callers = 0
        self._set_before: dict[str, tuple[LibController, int]] = {}
        """File of a library → the library and its number of threads before the first caller."""

    def begin(self, libraries: list[LibController]) -> None:
        self._callers += 1
        for library in libraries:  # also inside of another call, which may have loaded one
            threads = library.get_num_threads()
            if threads and threads != 1:
                self._set_before.setdefault(library.filepath, (library, threads))
                _set_threads(library, 1)

    def end(self) -> None:
        self._callers -= 1
        if self._callers:
            return
        for library, threads in self._set_before.values():
            _set_threads(library, threads)
        self._set_before.clear()


def _set_threads(library: LibController, threads: int) -> None:
    """Set the number of threads, from whichever thread.

    Since its version 3.8 threadpoolctl does so silently for the first thread alone that asks, until this one
    gives up.
    """
    give_up = getattr(library, "clear_controlling_thread", None)
    if give_up is not None:
        give_up(force=True)
    library.set_num_threads(threads)
    if give_up is not None:
        give_up(force=True)


class _LimitOfThread(threading.local):
    """OpenBLAS on OpenMP has a number of threads for each thread that calls it."""

    def __init__(self) -> None:
        self.limit = _Limit()


class _OneThread:
    """The limit of every BLAS that is loaded."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._of_process = _Limit()
        self._of_thread = _LimitOfThread()
        self._libraries: list[LibController] = []
        self._modules_at_lookup = 0

    def begin(self) -> None:
        with self._lock:
            self._look_up()
            by_thread = [library for library in self._libraries if _is_by_thread(library)]
            self._of_thread.limit.begin(by_thread)
            self._of_process.begin([library for library in self._libraries if library not in by_thread])

    def end(self) -> None:
        with self._lock:
            self._of_thread.limit.end()
            self._of_process.end()

    def _look_up(self) -> None:
        """Find the loaded libraries, but only where Python has imported something since the last time.

        A lookup takes a millisecond, and a BLAS is loaded by a module that needs it.
        """
        if self._modules_at_lookup != len(sys.modules):
            self._modules_at_lookup = len(sys.modules)
            self._libraries = ThreadpoolController().select(user_api="blas").lib_controllers


def _is_by_thread(library: LibController) -> bool:
    return getattr(library, "threading_layer", "") == "openmp"


_ONE_THREAD = _OneThread()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let every BLAS of this process use one thread, inside a `with` block or a decorated function.

    The number mostly holds for the whole process: other threads of the program have one, too, meanwhile.
    Where calls overlap, nested or from several threads, the last to end gives back what was set before the
    first began.
    """
    _ONE_THREAD.begin()
    try:
        yield
    finally:
        _ONE_THREAD.end()
