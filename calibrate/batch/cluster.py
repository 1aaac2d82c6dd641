"""A Dask cluster as workers: the only module that knows `distributed` (optional extra `cluster`).

They need this package and the files under the same paths; what they find comes back over the wire and
is written here. The client connects out to the scheduler and listens on nothing itself.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Generator, Sequence
from typing import Any

from calibrate.batch.workers import BatchError, BatchWorkers, Lost, R, T
from calibrate.errors import UsageError
from calibrate.pipeline.document import solver_software

_CONNECT_S = 30


def cluster_workers(address: str) -> BatchWorkers:
    """Make workers of the cluster behind the scheduler at tcp://HOST:PORT or tls://HOST:PORT.

    Certificates are those of Dask's own configuration. Connects when there is work. Raises UsageError.
    """
    try:
        dask: Any = importlib.import_module("distributed")
    except ImportError:
        raise UsageError("package-missing") from None

    def run(work: Callable[[T], R], tasks: Sequence[T]) -> Generator[tuple[T, R | Lost]]:
        if tasks:
            with _connect(dask, address) as client:
                yield from dask_workers(client)(work, tasks)

    return run


def dask_workers(client: Any) -> BatchWorkers:
    """Make workers of a `distributed.Client` that is connected; it stays open.

    When the batch ends early, or its process is killed, the scheduler forgets what has not begun.
    """
    dask: Any = importlib.import_module("distributed")

    def run(work: Callable[[T], R], tasks: Sequence[T]) -> Generator[tuple[T, R | Lost]]:
        address = client.scheduler.address
        _require_same_software(client, address)
        futures = dict(zip(client.map(work, tasks, pure=False), tasks, strict=True))
        for future in dask.as_completed(futures):
            task = futures.pop(future)
            if future.cancelled() or client.status not in ("running", "connecting"):
                raise BatchError("cluster-lost", address=address)
            problem = future.exception()
            if problem is None:
                yield task, future.result()
            elif isinstance(problem, dask.KilledWorker):
                yield task, Lost("its worker process was killed again and again")
            else:
                yield task, Lost(f"on the cluster: {problem}")

    return run


def _connect(dask: Any, address: str) -> Any:
    """A client with at least one worker behind the scheduler. Raises BatchError."""
    try:
        client = dask.Client(address, timeout=_CONNECT_S)
    except (OSError, ValueError, TypeError) as problem:  # TypeError: tls:// without certificates
        raise BatchError("cluster-silent", address=address, why=str(problem.__cause__ or problem)) from None
    try:
        client.wait_for_workers(1, timeout=_CONNECT_S)
    except TimeoutError:
        client.close()
        raise BatchError("cluster-workers", address=address) from None
    return client


def _require_same_software(client: Any, address: str) -> None:
    """Other versions give other bits: refused before anything is solved."""
    here = solver_software()
    try:
        there: dict[str, dict[str, str]] = client.run(solver_software)
    except Exception as problem:  # whatever a worker without this package raises
        raise BatchError(
            "cluster-software", address=address, why=f"a worker cannot run this package ({problem})"
        ) from None
    for worker, versions in there.items():
        for name, version in versions.items():
            if version != here.get(name):
                raise BatchError(
                    "cluster-software",
                    address=address,
                    why=f"worker {worker} has {name} {version}, here it is {here.get(name)}",
                )
