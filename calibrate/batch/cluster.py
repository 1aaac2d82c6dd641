"""A Dask cluster as workers: the only module that knows `distributed` (optional extra `cluster`).

They need this package and the files under the same paths or URLs; what they find comes back over the wire and
is written here. The client connects out to the scheduler and listens on nothing itself.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from calibrate.batch.workers import BatchError, BatchWorkers, Lost, R, T
from calibrate.document import software_versions
from calibrate.errors import UsageError
from recordings.files import read_file

_CONNECT_S = 30
_FILE_LIMIT_BYTES = 1024 * 1024


@dataclass(frozen=True)
class Cluster:
    """A Dask scheduler that a person named, and the files that prove who is who (all three, or none)."""

    address: str
    """tcp://HOST:PORT or tls://HOST:PORT"""
    tls_ca: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None

    @classmethod
    def from_file(cls, path: Path, *tls: Path | None) -> Cluster:
        """Read `dask scheduler --scheduler-file`'s JSON; `tls`: as the other fields. Raises UsageError."""
        try:
            address = msgspec.json.decode(read_file(path, _FILE_LIMIT_BYTES), type=_SchedulerFile).address
        except (OSError, msgspec.DecodeError, UnicodeDecodeError) as problem:
            raise UsageError("cluster-file", path=path, why=str(problem)) from None
        return cls(address, *tls)

    def check(self) -> None:
        """Raises UsageError where address and files do not belong together."""
        scheme, _, place = self.address.partition("://")
        if scheme not in ("tcp", "tls") or ":" not in place:
            raise UsageError("cluster-address", address=self.address)
        given = [path for path in (self.tls_ca, self.tls_cert, self.tls_key) if path is not None]
        if (scheme == "tls") != (len(given) == 3) or (scheme == "tcp" and given):
            raise UsageError("cluster-tls", address=self.address)
        for path in given:
            if not path.is_file():
                raise UsageError("cluster-file", path=path, why="it does not exist or is no file")


class _SchedulerFile(msgspec.Struct):
    address: str


def cluster_workers(cluster: Cluster) -> BatchWorkers:
    """Check at once that `distributed` is installed and the address makes sense; connect when there is work.

    Raises UsageError.
    """
    cluster.check()
    try:
        dask: Any = importlib.import_module("distributed")
    except ImportError:
        raise UsageError("package-missing") from None

    def run(work: Callable[[T], R], tasks: Sequence[T]) -> Generator[tuple[T, R | Lost]]:
        if tasks:
            with _connect(dask, cluster) as client:
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


def _connect(dask: Any, cluster: Cluster) -> Any:
    """A client with at least one worker behind the scheduler. Raises BatchError."""
    security = None
    if cluster.address.startswith("tls://"):
        security = dask.Security(
            tls_ca_file=str(cluster.tls_ca),
            tls_client_cert=str(cluster.tls_cert),
            tls_client_key=str(cluster.tls_key),
            require_encryption=True,
        )
    try:
        client = dask.Client(cluster.address, security=security, timeout=_CONNECT_S)
    except (OSError, ValueError) as problem:
        reason = problem.__cause__ or problem
        raise BatchError("cluster-silent", address=cluster.address, why=str(reason)) from None
    try:
        client.wait_for_workers(1, timeout=_CONNECT_S)
    except TimeoutError:
        client.close()
        raise BatchError("cluster-workers", address=cluster.address) from None
    return client


def _require_same_software(client: Any, address: str) -> None:
    """Other versions give other bits: refused before anything is solved."""
    here = software_versions()
    try:
        there: dict[str, dict[str, str]] = client.run(software_versions)
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
