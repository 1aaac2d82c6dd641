"""A batch on a real Dask scheduler, on loopback, with workers in processes of their own."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from calibrate.batch.cluster import cluster_workers, dask_workers
from calibrate.batch.run import BatchResult, run_batch
from calibrate.batch.workers import BatchError
from calibrate.errors import UsageError
from tests.calibrate.batch.test_run import Counted, in_this_process, read_results
from tests.calibrate.batch.test_run import recordings as recordings
from tests.codes import raises
from tests.patience import PATIENCE_S, wait_until

needs_distributed = pytest.mark.skipif(
    shutil.which("dask", path=str(Path(sys.executable).parent)) is None,
    reason="the optional extra `cluster` (dask distributed) is not installed",
)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def dask_cluster(folder: Path, workers: int, tls: list[str] | None = None) -> Iterator[tuple[str, list[int]]]:
    """(address, pids of the scheduler and the workers); ended with everything it started."""
    dask = str(Path(sys.executable).parent / "dask")
    address = f"{'tls' if tls else 'tcp'}://127.0.0.1:{free_port()}"
    common = [*(tls or []), "--no-dashboard"]
    place = ["--host", address.rpartition(":")[0], "--port", address.rpartition(":")[2]]
    with ExitStack() as stack:
        log = stack.enter_context((folder / "dask.log").open("wb"))

        def start(*words: str) -> subprocess.Popen[bytes]:
            environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
            process = subprocess.Popen([dask, *words], stdout=log, stderr=log, cwd=folder, env=environment)
            stack.callback(process.wait, PATIENCE_S)
            stack.callback(process.kill)
            return process

        scheduler = start("scheduler", *place, *common).pid
        alone = ["--no-nanny", "--nthreads", "1", "--host", "127.0.0.1", "--local-directory", str(folder)]
        yield address, [scheduler, *(start("worker", address, *alone, *common).pid for _ in range(workers))]


@needs_distributed
@pytest.mark.process
@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl to make certificates with")
def test_over_tls_and_without_the_key_nobody_answers(recordings: list[Path], tmp_path: Path) -> None:
    cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    make = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -subj /CN=test"
    subprocess.run([*make.split(), "-keyout", key, "-out", cert], check=True, capture_output=True)
    tls = [f"--tls-ca-file={cert}", f"--tls-cert={cert}", f"--tls-key={key}"]
    files = {"ca-file": str(cert), "client.cert": str(cert), "client.key": str(key)}
    pytest.importorskip("distributed")  # brings the defaults of the configuration
    dask = pytest.importorskip("dask")
    with dask_cluster(tmp_path, 1, tls) as (address, _):
        with dask.config.set({f"distributed.comm.tls.{name}": file for name, file in files.items()}):
            solved = run_batch(recordings[:1], tmp_path / "tls", workers=cluster_workers(address))
        assert [result.error for result in solved] == [""]
        for nobody in (address, address.replace("tls", "tcp"), "somewhere", "http://a:1"):
            with raises("cluster-silent", BatchError):
                run_batch(recordings[1:2], tmp_path / "plain", workers=cluster_workers(nobody))


@needs_distributed
@pytest.mark.process
def test_no_killed_client_worker_or_scheduler_costs_what_was_finished(
    recordings: list[Path], tmp_path: Path
) -> None:
    """A batch that is killed leaves the cluster idle; whoever solves, the bits are those of one process."""
    distributed = pytest.importorskip("distributed")
    out, asked = tmp_path / "out", Counted()
    alone = run_batch(recordings, tmp_path / "alone", workers=in_this_process)
    with dask_cluster(tmp_path, workers=2) as (address, (scheduler, worker, _)):
        with distributed.Client(address) as client:
            assert run_batch(recordings[:1], tmp_path / "client", workers=dask_workers(client))[0].solved
            command = ["batch", *map(str, recordings), "-o", "killed", "--scheduler", address]
            other = subprocess.Popen([sys.executable, "-m", "calibrate.cli", *command], cwd=tmp_path)
            wait_until((tmp_path / "killed/results.jsonl").exists)
            other.kill()
            assert other.wait(PATIENCE_S) == -signal.SIGKILL
            wait_until(lambda: not any(client.processing().values()))
            assert client.status == "running"

        def solve(folder: Path, killed: int) -> list[BatchResult]:
            """One is killed at the first result."""

            def kill(done: int, total: int, result: BatchResult) -> None:
                if done == 1:
                    os.kill(killed, signal.SIGKILL)

            return run_batch(recordings, folder, progress=kill, workers=cluster_workers(address))

        spread = solve(tmp_path / "dask", worker)
        with raises("cluster-lost", BatchError):
            solve(out, scheduler)
    assert [result.error for result in spread] == [""] * 3
    assert [r.content_sha256 for r in spread] == [r.content_sha256 for r in alone]
    assert all((tmp_path / "dask" / result.calibration).is_file() for result in spread)
    kept = {result.recording for result in read_results(out) if result.solved}
    assert kept and all(result.solved for result in run_batch(recordings, out, workers=asked))
    assert not set(asked.asked) & kept


def test_without_the_extra_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with raises("package-missing", UsageError):
        cluster_workers("tcp://127.0.0.1:8786")


def test_nothing_left_to_solve_needs_no_cluster(recordings: list[Path], tmp_path: Path) -> None:
    run_batch(recordings[:1], tmp_path / "out", workers=in_this_process)
    nobody = cluster_workers("tcp://127.0.0.1:9") if shutil.which("dask") else in_this_process
    assert run_batch(recordings[:1], tmp_path / "out", workers=nobody)[0].solved
