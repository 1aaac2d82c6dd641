"""Validity and drift of many cells: one table, one page, the same whoever reads and wherever they lie."""

from __future__ import annotations

import json
import shutil
import sqlite3
import sys
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import fsspec
import numpy as np
import pytest

from calibrate.batch.fleet import CameraRecord, collect_fleet, fleet_table
from calibrate.batch.page import fleet_page
from calibrate.batch.run import run_batch
from calibrate.batch.storage import expand, local_copy
from calibrate.batch.workers import BatchError, pool
from calibrate.files.calibration import read_calibration
from calibrate.files.install import install, note_check, rollback
from calibrate.files.validity import ValidityReason
from calibrate.quality.checks import CheckEntry, append_check
from tests.calibrate.batch.test_run import Counted, in_this_process
from tests.calibrate.calling import raises_code, run

NOW = datetime.now(UTC) + timedelta(days=100)
COVARIANCE = tuple(tuple(row) for row in np.diag([1e-8] * 3 + [1e-8] * 3).tolist())


def note_drift(root: Path, day: float, shift_mm: float, version: int = 1, camera: str = "main") -> None:
    shift = (shift_mm * 1e-3, 0.0, 0.0, 0.0, 0.0, 0.0)
    entry = CheckEntry(day * 86400, version, f"day-{day}", shift_mm < 1, shift, COVARIANCE, 1.0, 13.0)
    append_check(entry, root, camera)


@pytest.fixture
def cells(make_file: Callable[..., Path], tmp_path: Path) -> list[Path]:
    """Quiet, moved, drifting, two cameras, never installed, damaged, rolled back."""
    folder, file = tmp_path / "cells", make_file()
    roots = [folder / name for name in ("quiet", "moved", "drifting", "two", "none", "damaged", "back")]
    for root in roots:
        root.mkdir(parents=True)
        if root.name != "none":
            install(file, root)
    install(file, roots[3], camera="left")
    install(make_file(1e-5), roots[6])
    rollback(roots[6], 1)
    for day in range(6):
        note_drift(roots[0], day, 0.01)
        note_drift(roots[1], day, 0.01 if day < 5 else 3.0)
        note_drift(roots[2], day, 0.15 * day)
    moved = ValidityReason("drift-check", "Camera shift 3.00 mm.", {"shift_mm": 3.0})
    later = datetime.now(UTC) + timedelta(seconds=2)
    note_check(roots[1], "drift-check", moved, passed=False, sensitive=True, when=later)
    (gen,) = (roots[5] / "calibrations/gen").iterdir()
    gen.chmod(0o600)
    gen.write_bytes(gen.read_bytes().replace(b"translation_m", b"translation_x"))
    return roots


def facts(records: list[CameraRecord]) -> list[tuple[str, str, str, bool]]:
    return [(Path(r.cell).name, r.camera, r.state, r.to_look_at) for r in records]


def test_every_camera_is_a_record_and_what_is_in_doubt_says_so(cells: list[Path]) -> None:
    records = collect_fleet(cells, NOW, in_this_process)
    assert facts(records) == [
        ("quiet", "main", "valid", False),
        ("moved", "main", "in-doubt", True),
        ("drifting", "main", "valid", True),
        ("two", "main", "valid", False),
        ("two", "left", "valid", False),
        ("none", "", "unreadable", True),
        ("damaged", "main", "unreadable", True),
        ("back", "main", "unverified", False),
    ]
    quiet, moved, drifting, *_, none, damaged, back = records
    assert back.version == 1
    assert moved.reason == "drift-check" and moved.since
    assert quiet.trend is None and moved.current_checks[-1].shift[0] == 3e-3
    assert drifting.trend is not None and drifting.trend.shift_mm == pytest.approx(0.75)
    assert (none.reason, damaged.reason) == ("nothing-installed", "damaged-calibration")


def test_the_table_answers_which_cell_since_when_and_how_much(cells: list[Path], tmp_path: Path) -> None:
    records = collect_fleet(cells, NOW, in_this_process)
    (tmp_path / "fleet.sqlite").write_bytes(fleet_table(records))
    with closing(sqlite3.connect(tmp_path / "fleet.sqlite")) as table:
        doubted = table.execute("SELECT cell, since FROM cameras WHERE state = 'in-doubt'").fetchall()
        assert doubted == [(str(cells[1]), records[1].since)]
        worst = (
            "SELECT cell, max(abs(x_m)), time, covariance FROM checks GROUP BY cell ORDER BY 2 DESC LIMIT 1"
        )
        cell, shift_m, time, covariance = table.execute(worst).fetchone()
        assert (cell, shift_m, time) == (str(cells[1]), 3e-3, "1970-01-06T00:00:00+00:00")
        assert np.array_equal(json.loads(covariance), COVARIANCE)
        counts = "SELECT checks, checks_failed FROM cameras WHERE cell = ?"
        assert table.execute(counts, (str(cells[1]),)).fetchone() == (6, 1)


@pytest.mark.process
def test_processes_read_the_same_bytes(cells: list[Path]) -> None:
    here, there = collect_fleet(cells, NOW, in_this_process), collect_fleet(cells, NOW, pool(2))
    assert fleet_table(here) == fleet_table(there)
    assert fleet_page(here, NOW) == fleet_page(there, NOW)


def test_the_page_shows_doubt_first_and_asks_the_network_for_nothing(cells: list[Path]) -> None:
    records = collect_fleet(cells, NOW, in_this_process)
    page = fleet_page(records, NOW)
    assert page.count("<svg") == 2, "the moved and the drifting one are drawn"
    first = page[page.index("<h2>") : page.index("<h2>", page.index("<h2>") + 1)]
    assert first.index("moved") < first.index("drifting")
    assert "quiet" not in first
    for word in ('src="http', 'href="http', "@import", "<script"):
        assert word not in page
    assert "verdict good" in fleet_page(records[:1], NOW)


def upload(folder: Path, url: str) -> None:
    """Copy a folder like a tool for object stores: links become what they point to."""
    fs, base = fsspec.core.url_to_fs(url)
    for path in folder.rglob("*"):
        if path.is_file():
            fs.pipe_file(f"{base}/{path.relative_to(folder)}", path.read_bytes())


def test_cells_behind_a_url_are_those_of_the_folders(cells: list[Path], tmp_path: Path) -> None:
    upload(cells[0].parent, "memory://fleet/cells")
    urls = [f"memory://fleet/cells/{root.name}" for root in cells]
    assert len(expand("memory://fleet/cells/*")) == len(cells) - 1, "an object store has no empty folder"
    here, there = (collect_fleet(places, NOW, in_this_process) for places in (cells, urls))
    assert facts(there) == facts(here)
    assert [(r.version, r.since, r.checks) for r in there] == [(r.version, r.since, r.checks) for r in here]


def test_recordings_and_results_behind_urls(session_file: Path, tmp_path: Path) -> None:
    """The same bits as from a folder; what is finished is not solved again, what is replaced is."""
    for name in ("a", "b"):
        upload_file(session_file, f"memory://fleet/sessions/{name}.mcap")
    shutil.copy(session_file, tmp_path / "a.mcap")
    counted = Counted()
    urls = expand("memory://fleet/sessions/*.mcap")
    found = run_batch(urls, "memory://fleet/out", workers=counted)
    (local,) = run_batch([tmp_path / "a.mcap"], tmp_path / "out", workers=in_this_process)
    assert found[0].content_sha256 == local.content_sha256
    with local_copy(f"memory://fleet/out/{found[0].calibration}") as file:
        assert read_calibration(file).result == read_calibration(tmp_path / "out" / local.calibration).result
    assert len(counted.asked) == 2
    upload_file(session_file, "memory://fleet/sessions/b.mcap", b"")
    again = run_batch([*urls, "memory://fleet/none.mcap"], "memory://fleet/out", workers=counted)
    assert [result.solved for result in again] == [True, True, False]
    assert len(counted.asked) == 4, "b.mcap is newer, none.mcap is new"


def upload_file(path: Path, url: str, more: bytes = b"") -> None:
    fs, target = fsspec.core.url_to_fs(url)
    fs.pipe_file(target, path.read_bytes() + more)


def test_what_no_driver_can_reach_is_said(tmp_path: Path) -> None:
    with raises_code(BatchError, "storage-empty"):
        expand("memory://nobody/*")
    with raises_code(BatchError, "storage"):
        run_batch(["nosuch://bucket/a.mcap"], tmp_path, workers=in_this_process)
    (record,) = collect_fleet(["nosuch://bucket"], NOW, in_this_process)
    assert (record.state, record.reason) == ("unreadable", "storage")


def test_a_missing_driver_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with raises_code(BatchError, "package-missing"):
        expand("s3://robots/*")


def test_the_command_writes_both_and_ends_with_loss_where_a_cell_is_lost(
    cells: list[Path], tmp_path: Path
) -> None:
    done = run("fleet", *cells[:2], "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["states"] == {"valid": 1, "in-doubt": 1}
    assert [(Path(each["cell"]).name, each["reason"]) for each in told["to_look_at"]] == [
        ("moved", "drift-check")
    ]
    assert all((tmp_path / "fleet" / name).stat().st_size for name in ("fleet.sqlite", "fleet.html"))
    assert run("fleet", cells[4], "-o", "other", cwd=tmp_path).returncode == 3
