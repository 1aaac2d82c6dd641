"""A program's BLAS threads while the library works for it, and afterwards."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import scipy.linalg  # noqa: F401 - loads a BLAS of its own
import threadpoolctl

import calibrate
from calibrate.errors import CalibrationError
from calibrate.handeye import SolveOptions, ViewSet, compare_all, solve_views
from calibrate.handeye.blas_threads import one_blas_thread
from recordings.geometry import Array
from tests.calibrate.cells import exact_motions, make_cell
from tests.patience import PATIENCE_S

SET_BEFORE = 2


def threads() -> set[int]:
    """Threads of every BLAS that is loaded, looked up anew."""
    libraries = threadpoolctl.threadpool_info()
    return {library["num_threads"] for library in libraries if library["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def a_program_with_two_threads() -> Iterator[None]:
    with threadpoolctl.threadpool_limits(SET_BEFORE, user_api="blas"):
        if threads() != {SET_BEFORE}:
            pytest.skip("this BLAS does not take two threads")
        yield


def test_one_thread_inside_and_what_was_set_afterwards() -> None:
    with one_blas_thread():
        assert threads() == {1}
    assert threads() == {SET_BEFORE}


def test_nested_the_outermost_gives_back() -> None:
    with one_blas_thread():
        with one_blas_thread():
            assert threads() == {1}
        assert threads() == {1}
    assert threads() == {SET_BEFORE}


def test_of_two_threads_the_last_to_end_gives_back() -> None:
    inside = threading.Barrier(2)
    first_has_ended = threading.Event()
    seen_by_the_last: list[set[int]] = []

    def first() -> None:
        with one_blas_thread():
            inside.wait(PATIENCE_S)
        first_has_ended.set()

    def last() -> None:
        with one_blas_thread():
            inside.wait(PATIENCE_S)
            assert first_has_ended.wait(PATIENCE_S)
            seen_by_the_last.append(threads())

    with ThreadPoolExecutor(2) as pool:
        for ended in [pool.submit(first), pool.submit(last)]:
            ended.result(PATIENCE_S)
    assert seen_by_the_last == [{1}]
    assert threads() == {SET_BEFORE}


def test_given_back_after_an_error() -> None:
    with pytest.raises(RuntimeError), one_blas_thread():
        raise RuntimeError
    assert threads() == {SET_BEFORE}


def test_what_was_set_in_between_is_what_is_given_back() -> None:
    with one_blas_thread():
        pass
    with threadpoolctl.threadpool_limits(1, user_api="blas"):
        with one_blas_thread():
            assert threads() == {1}
        assert threads() == {1}
    assert threads() == {SET_BEFORE}


class Watcher(logging.Handler):
    """Looks at the threads whenever the solver says how far it is."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[set[int]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.seen.append(threads())


@pytest.fixture
def watcher() -> Iterator[Watcher]:
    stages, watcher = logging.getLogger("calibrate.stages"), Watcher()
    before = stages.level
    stages.addHandler(watcher)
    stages.setLevel(logging.INFO)
    yield watcher
    stages.removeHandler(watcher)
    stages.setLevel(before)


class Corners:
    """Corners of a board as a program's own array, which notes with how many threads it is read."""

    def __init__(self, pixels: Array, seen: list[set[int]]) -> None:
        self._pixels = pixels
        self._seen = seen

    def __array__(self, dtype: object = None, copy: object = None) -> Array:
        self._seen.append(threads())
        return self._pixels


def test_a_public_solve_uses_one_thread(watcher: Watcher) -> None:
    cell = make_cell(np.random.default_rng(1), views=12)
    solve_views(cell.views, SolveOptions(folds=False, holdout=False))
    assert watcher.seen
    assert all(each == {1} for each in watcher.seen)
    assert threads() == {SET_BEFORE}


def test_pictures_are_solved_with_one_thread_from_the_first_to_the_last(watcher: Watcher) -> None:
    views = make_cell(np.random.default_rng(1), views=12).views
    reading: list[set[int]] = []
    corners = [Corners(view.corners.pixels, reading) for view in views]
    calibrate.solve(
        corners,
        views.base_from_flange,
        "7x6 25",
        "eye-in-hand",
        views.camera,
        options=SolveOptions(folds=False, holdout=False),
    )
    assert reading
    assert watcher.seen
    assert all(each == {1} for each in [*reading, *watcher.seen])
    assert threads() == {SET_BEFORE}


def test_the_published_methods_are_run_with_one_thread(watcher: Watcher) -> None:
    cell = make_cell(np.random.default_rng(1), views=10)
    compare_all(cell.views, SolveOptions(folds=False, holdout=False))
    assert watcher.seen
    assert all(each == {1} for each in watcher.seen)
    assert threads() == {SET_BEFORE}


def test_given_back_after_a_solve_that_is_refused(watcher: Watcher) -> None:
    H, C = exact_motions(np.random.default_rng(1), 2, np.eye(4))
    with pytest.raises(CalibrationError):
        solve_views(ViewSet.from_poses("eye-in-hand", H, C))
    assert threads() == {SET_BEFORE}
