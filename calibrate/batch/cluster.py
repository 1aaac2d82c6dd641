"""`calibrate batch` on a Dask cluster: the only module that knows `distributed` (optional extra `cluster`).

Workers need this package and the recordings under the same paths; what they find comes back over the wire
and is written here. The client connects out to the scheduler and listens on nothing itself.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibrate.batch import BatchResult
from calibrate.batch.run import BatchError, Solved, Solver, Task, solve_one
from calibrate.bounds import Limits
from calibrate.document import software_versions
from calibrate.pipeline import JobOptions

_CONNECT_S = 30


class ClusterError(BatchError):
    """The cluster cannot be used as asked."""

    code = "cluster-options"

    exit_code = 2


@dataclass(frozen=True)
class Cluster:
    """A Dask scheduler that a person named, and the files that prove who is who (all three, or none)."""

    address: str
    """tcp://HOST:PORT or tls://HOST:PORT"""
    tls_ca: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None

    def check(self) -> None:
        """Raises ClusterError where address and files do not belong together."""
        scheme, _, place = self.address.partition("://")
        if scheme not in ("tcp", "tls") or ":" not in place:
            raise ClusterError(
                f"--scheduler {self.address!r} is no address.",
                code="cluster-address",
                remedy="Write tcp://HOST:PORT or tls://HOST:PORT, as `dask scheduler` prints it.",
            )
        given = [path for path in (self.tls_ca, self.tls_cert, self.tls_key) if path is not None]
        if (scheme == "tls") != (len(given) == 3) or (scheme == "tcp" and given):
            raise ClusterError(
                f"--scheduler {self.address}: a tls:// address needs --tls-ca, --tls-cert and --tls-key; a "
                "tcp:// address takes none of them.",
                code="cluster-tls",
            )
        for path in given:
            if not path.is_file():
                raise ClusterError(f"{path} does not exist or is no file.", code="cluster-file")


def cluster_solver(cluster: Cluster) -> Solver:
    """Checks at once that `distributed` is installed and the address makes sense; connects when solving."""
    cluster.check()
    try:
        dask: Any = importlib.import_module("distributed")
    except ImportError:
        raise ClusterError(
            "--scheduler needs the package `distributed`.",
            code="package-missing",
            remedy="pip install 'calibration-station[cluster]', the same version as on the workers.",
        ) from None
    return lambda todo, options: _solve(dask, cluster, todo, options) if todo else iter(())


def _solve(dask: Any, cluster: Cluster, todo: Sequence[Task], options: JobOptions) -> Iterator[Solved]:
    with _connect(dask, cluster) as client:
        _require_same_software(client, cluster.address)
        futures = {
            client.submit(solve_one, recording, key, options, Limits(), pure=False): (recording, key)
            for recording, key in todo
        }
        for future in dask.as_completed(futures):
            recording, key = futures.pop(future)
            if future.cancelled() or client.status not in ("running", "connecting"):
                raise BatchError(
                    f"The connection to {cluster.address} is lost; finished results are kept.",
                    code="cluster-lost",
                    remedy="Run the same command again to go on.",
                )
            problem = future.exception()
            if problem is None:
                yield future.result()
            elif isinstance(problem, dask.KilledWorker):
                error = "its worker process was killed again and again"
                yield Solved(BatchResult(recording, key, False, error=error))
            else:
                yield Solved(BatchResult(recording, key, False, error=f"on the cluster: {problem}"))


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
        raise BatchError(
            f"{cluster.address}: no scheduler answers ({reason}).",
            code="cluster-silent",
            remedy="Start `dask scheduler` there, with TLS exactly if the address begins with tls.",
        ) from None
    try:
        client.wait_for_workers(1, timeout=_CONNECT_S)
    except TimeoutError:
        client.close()
        raise BatchError(
            f"{cluster.address}: the scheduler has no workers.",
            code="cluster-workers",
            remedy=f"Start some: dask worker {cluster.address}",
        ) from None
    return client


def _require_same_software(client: Any, address: str) -> None:
    """Other versions give other bits: refused before anything is solved."""
    here = software_versions()
    try:
        there: dict[str, dict[str, str]] = client.run(software_versions)
    except Exception as problem:  # whatever a worker without this package raises
        raise BatchError(
            f"{address}: a worker cannot run this package ({problem}).",
            code="cluster-software",
            remedy="Install calibration-station[cluster] on every worker, the same version as here.",
        ) from None
    for worker, versions in there.items():
        for name, version in versions.items():
            if version != here.get(name):
                raise BatchError(
                    f"{address}: worker {worker} has {name} {version}, here it is {here.get(name)}.",
                    code="cluster-software",
                    remedy="Install the same versions: results would differ.",
                )
