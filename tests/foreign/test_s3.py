"""Recordings, cells and results in an S3 store: moto's server, and plain HTTP beside our driver (s3fs)."""

from __future__ import annotations

import json
import os
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from urllib.error import URLError
from urllib.request import Request, urlopen

import numpy as np
import pytest

import recordings
from calibrate.files.install import install
from calibrate.quality.checks import CheckEntry, append_check
from tests.foreign.judges import FOLDER, missing

SAMPLE = Path(recordings.__file__).parent / "samples" / "paper-640.mcap"
PYTHON = FOLDER / "python"


class Store:
    """The bucket `robots`, by plain HTTP: moto proves no signature."""

    def __init__(self, port: int) -> None:
        self.address = f"http://127.0.0.1:{port}"
        self.environment = {
            **os.environ,
            "PYTHONPATH": str(PYTHON),
            "AWS_ENDPOINT_URL": self.address,
            "AWS_ACCESS_KEY_ID": "test",
            "AWS_SECRET_ACCESS_KEY": "test",
            "AWS_DEFAULT_REGION": "us-east-1",
        }

    def call(self, method: str, key: str = "", content: bytes | None = None) -> bytes:
        headers = {"Content-Type": "application/octet-stream", "Authorization": "AWS test:unproven"}
        asked = Request(f"{self.address}/robots/{key}", content, headers, method=method)
        with urlopen(asked, timeout=30) as answer:
            return bytes(answer.read())

    def upload(self, folder: Path, prefix: str) -> None:
        """Links become what they point to, as with `aws s3 sync`."""
        for path in folder.rglob("*"):
            if path.is_file():
                self.call("PUT", f"{prefix}/{path.relative_to(folder)}", path.read_bytes())

    def calibrate(self, *words: object, cwd: Path) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "calibrate.cli", *map(str, words)]
        return subprocess.run(command, env=self.environment, cwd=cwd, capture_output=True, text=True)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    if not (PYTHON / "moto").is_dir() or not (PYTHON / "s3fs").is_dir():
        missing("moto, s3fs")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        found = Store(probe.getsockname()[1])
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", found.address.rpartition(":")[2]]
    log = tmp_path_factory.mktemp("moto") / "log"
    with log.open("wb") as out, subprocess.Popen(command, env=found.environment, stderr=out) as server:
        try:
            for _ in range(600):
                try:
                    found.call("PUT")
                    break
                except URLError:
                    assert server.poll() is None, log.read_text()
                    time.sleep(0.1)
            yield found
        finally:
            server.terminate()


def test_a_batch_from_and_to_the_store_has_the_bits_of_local_files(store: Store, tmp_path: Path) -> None:
    store.call("PUT", "sessions/a.mcap", SAMPLE.read_bytes())
    (tmp_path / "a.mcap").write_bytes(SAMPLE.read_bytes())
    command = ("batch", "s3://robots/sessions/*.mcap", "-o", "s3://robots/results", "--json")
    done = store.calibrate(*command, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    there = json.loads(done.stdout)
    here = json.loads(store.calibrate("batch", "a.mcap", "--json", cwd=tmp_path).stdout)
    assert there["content_sha256"] == here["content_sha256"]
    written = store.call("GET", f"results/{there['calibration']}")
    assert written.startswith(b"format: handeye-calibration/1")
    assert b"a.mcap" in store.call("GET", "results/results.csv")
    assert store.call("GET", "results/trends.html").startswith(b"<!doctype html>")
    again = store.calibrate(*command, cwd=tmp_path)
    assert json.loads(again.stdout) == there
    assert store.call("GET", f"results/{there['calibration']}") == written, "it was solved again"


def test_a_fleet_in_the_store_is_that_of_its_folders(store: Store, tmp_path: Path) -> None:
    assert store.calibrate("solve", SAMPLE, "-o", "cell.yaml", cwd=tmp_path).returncode == 0
    cells = tmp_path / "cells"
    for name, camera in (("one", "main"), ("two", "main"), ("two", "left")):
        install(tmp_path / "cell.yaml", cells / name, cell="simulated", camera=camera)
    rows = np.eye(6).tolist()
    for day in range(6):
        entry = CheckEntry(86400.0 * day, 1, "r", True, (1e-4 * day, 0, 0, 0, 0, 0), rows, 1.0, 13.0)
        append_check(entry, cells / "two", "left")
    store.upload(cells, "cells")
    tables = []
    for place, output in (("s3://robots/cells/*", "s3://robots/fleet"), (cells, "fleet")):
        places = [place] if place != cells else sorted(cells.iterdir())
        done = store.calibrate("fleet", *places, "-o", output, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    (tmp_path / "there.sqlite").write_bytes(store.call("GET", "fleet/fleet.sqlite"))
    for file in (tmp_path / "there.sqlite", tmp_path / "fleet/fleet.sqlite"):
        with closing(sqlite3.connect(file)) as table:
            tables.append(
                [
                    [(*row[0].split("/")[-1:], *row[1:]) for row in table.execute(f"SELECT * FROM {name}")]
                    for name in ("cameras", "checks")
                ]
            )
    assert tables[0] == tables[1]
    assert [len(rows) for rows in tables[0]] == [3, 6]
    assert store.call("GET", "fleet/fleet.html").startswith(b"<!doctype html>")


def test_a_bucket_that_is_not_there_is_said(store: Store, tmp_path: Path) -> None:
    done = store.calibrate("batch", "s3://nobody/a.mcap", "--json", cwd=tmp_path)
    assert done.returncode == 1
    assert json.loads(done.stdout)["error"]["code"] == "storage"
