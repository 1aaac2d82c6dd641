"""A caller of a worker process learns of its end, and is cancelled only when somebody cancels the caller."""

from __future__ import annotations

import asyncio
import os
import time
from concurrent.futures import Future
from copy import copy

import msgspec
import numpy as np
import pytest

from recordings.schema.messages import Image, Stamps
from station.analysis import pool
from station.analysis.pool import Workers
from station.cell.status import EstimateStatus
from tests.codes import raises
from tests.patience import PATIENCE_S, until


def nothing() -> None:
    """Start without any preparation."""


def estimate_of_numpy() -> EstimateStatus:
    """What a function of the analysis made of NumPy's numbers."""
    views = np.array([[1, 2], [0, 3]])
    return EstimateStatus(np.int64(4), np.float64(0.5), enough=np.bool_(True), image_views=views)


async def test_what_reaches_a_message_leaves_the_worker_as_plain_values() -> None:
    workers = Workers(nothing)
    try:
        estimate = await workers.call(estimate_of_numpy)
    finally:
        workers.close()
    assert estimate == EstimateStatus(4, 0.5, enough=True, image_views=((1, 2), (0, 3)))
    msgspec.json.encode(estimate)
    assert [type(each) for each in (estimate.views, estimate.predicted_error_mm)] == [int, float]


class PoolThatNeverBegins:
    """Stands for an executor whose own thread has not yet handed the work to its process."""

    _processes = None

    def __init__(self, *_arguments: object, **_options: object) -> None:
        self._submitted: list[Future[object]] = []

    def submit(self, _work: object) -> Future[object]:
        future: Future[object] = Future()
        self._submitted.append(future)
        return future

    def shutdown(self, wait: bool, cancel_futures: bool) -> None:
        assert cancel_futures and not wait
        for future in self._submitted:
            future.cancel()


async def test_a_call_that_has_not_begun_when_the_pool_closes_ends_with_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The executor cancels what it has not begun; the task that waits for it was not cancelled by anybody."""
    monkeypatch.setattr(pool, "ProcessPoolExecutor", PoolThatNeverBegins)
    workers = Workers(nothing)
    waiting = asyncio.create_task(workers.call(os.getpid))
    await asyncio.sleep(0)
    workers.close()
    with raises("worker-died"):
        await waiting


async def test_a_caller_who_is_cancelled_stays_cancelled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "ProcessPoolExecutor", PoolThatNeverBegins)
    workers = Workers(nothing)
    waiting = asyncio.create_task(workers.call(os.getpid))
    await asyncio.sleep(0)
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    workers.close()


@pytest.mark.process
async def test_a_call_under_way_ends_with_an_error_when_the_pool_closes() -> None:
    workers = Workers(nothing)
    await workers.start()
    waiting = asyncio.create_task(workers.call(time.sleep, 600.0))
    await until(lambda: workers.waiting)
    workers.close()
    with raises("worker-died"):
        await waiting
    with raises("station-ending"):
        await workers.call(os.getpid)


@pytest.mark.process
async def test_a_call_that_is_late_is_given_up_and_the_next_one_gets_a_new_process() -> None:
    workers = Workers(nothing)
    try:
        first = await workers.call(os.getpid)
        with raises("worker-late"):
            await workers.call(time.sleep, 600.0, timeout_s=0.01)
        assert await workers.call(os.getpid) != first
    finally:
        workers.close()


async def test_an_image_comes_out_of_the_worker_as_it_was_made() -> None:
    """Those of the simulated camera, which are no messages."""
    image = Image(np.zeros((2, 3), np.uint8), Stamps(), 0, 0)
    workers = Workers(nothing)
    try:
        came = await workers.call(copy, image, timeout_s=PATIENCE_S)
    finally:
        workers.close()
    assert came.pixels.shape == (2, 3) and came.pixels.dtype == np.uint8
