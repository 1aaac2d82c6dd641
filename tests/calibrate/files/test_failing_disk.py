"""A disk that refuses one request, and a power cut behind each, while the installed calibration is changed.

Programs find the old state or the new one, never neither, and nothing that was acknowledged is lost.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path

import pytest

from calibrate import load_installed
from calibrate.errors import CalibrationError
from calibrate.files import calibration, loader, validity_writer
from calibrate.files.install import (
    install,
    installed_calibration,
    note_check,
    rollback,
    set_validity,
    withdraw,
)
from calibrate.files.sealed_lines import sealed_content
from calibrate.files.touch import Touch
from calibrate.files.validity import ValidityReason, ValidityState
from calibrate.files.validity_log import FILE
from calibrate.files.versions import note_installed
from tests.durability import after_power_cut, watched_disk

Act = Callable[[Path], object]
Found = tuple[int, ValidityState, str]
MOVED = ValidityReason("drift-check", "Camera shift 3.00 mm.", {"shift_mm": 3.0})


@pytest.fixture
def place(make_file, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A state folder with two versions, the second in use; a file `new.yaml` to install beside it."""
    for module in (loader, calibration):  # a file that was parsed once is not parsed a hundred times
        monkeypatch.setattr(module, "verified_plain", lru_cache(module.verified_plain))
    root = tmp_path / "s"
    install(make_file(), root)
    install(make_file(0.001), root)
    shutil.copy(make_file(0.002), tmp_path / "new.yaml")
    return root


def found(root: Path) -> Found:
    """What programs find: never a damaged file, a lost link, or a log that leaves it in doubt by damage."""
    installed = load_installed(root, require_valid=False)
    assert installed.validity.reason.code != "log-damaged"
    return installed.version, installed.validity.state, installed.validity.reason.code


def of_before(root: Path) -> None:
    log = root / "calibrations/validity.jsonl"
    lines = [sealed_content(line) or line for line in log.read_bytes().splitlines()]
    log.write_bytes(b"".join(line + b"\n" for line in lines))


def long(root: Path) -> None:
    for k in range(2, 60):
        set_validity(root, ValidityState.VALID, ValidityReason("drift-check", f"check {k}"))


def torn(root: Path) -> None:
    with (root / "calibrations/validity.jsonl").open("ab") as log:
        log.write(b'{"version":2,"state":"withdrawn","sin')


def touched(root: Path) -> object:
    missed = Touch(0, (0.0, 0.0), (5.0, 0.0), (0.1, 0.1), "told by a person", "anna", "2026-01-01")
    return note_installed(root, installed_calibration(root), [missed])


ACTS: dict[str, Act] = {
    "install": lambda root: install(root.parent / "new.yaml", root),
    "rollback": lambda root: rollback(root, to=1),
    "withdraw": lambda root: withdraw(root, "A pallet hit the camera."),
    "note a check": lambda root: note_check(
        root, MOVED, False, True, datetime.now(UTC) + timedelta(seconds=2)
    ),
    "note a touch": touched,
}
LOGS: dict[str, Callable[[Path], None]] = {
    "as it is": lambda _: None,
    "of before": of_before,
    "long": long,
    "torn": torn,
}


@pytest.mark.parametrize("log", LOGS)
@pytest.mark.parametrize("act", ACTS)
def test_a_disk_that_refuses_any_one_request_leaves_the_old_or_the_new(
    place: Path, monkeypatch: pytest.MonkeyPatch, act: str, log: str
) -> None:
    LOGS[log](place)
    monkeypatch.setattr(validity_writer, "ROTATE_BYTES", 8000)
    kept = place.with_name("kept")
    shutil.copytree(place, kept, symlinks=True)
    old = found(place)
    ACTS[act](place)
    new = found(place)
    assert new != old
    for half in (False, True):
        refused = 0
        while True:
            shutil.rmtree(place)
            shutil.copytree(kept, place, symlinks=True)
            try:
                with watched_disk(monkeypatch, refused, half) as disk:
                    ACTS[act](place)
                acknowledged = True
            except CalibrationError:
                acknowledged = False
            if not disk.failed:
                break
            now = found(place)
            assert now == new if acknowledged else now in (old, new), disk.requests[refused]
            request = disk.requests[refused]
            if not acknowledged and request.path.name == FILE and request.kind in ("write", "sync"):
                assert now == old, "a line that nobody was told of is taken back"
            ACTS[act](place)
            refused += 1
        assert refused >= 2


@pytest.mark.parametrize("log", LOGS)
@pytest.mark.parametrize("act", ACTS)
def test_a_power_cut_at_any_moment_leaves_the_old_or_the_new(
    place: Path, monkeypatch: pytest.MonkeyPatch, act: str, log: str
) -> None:
    LOGS[log](place)
    monkeypatch.setattr(validity_writer, "ROTATE_BYTES", 8000)
    before, cut = place.with_name("before"), place.with_name("cut")
    shutil.copytree(place, before, symlinks=True)
    old = found(place)
    with watched_disk(monkeypatch) as disk:
        ACTS[act](place)
    new = found(place)
    requests = [request for request in disk.requests if request.path.is_relative_to(place)]
    for lost in (False, True):
        for count in range(len(requests) + 1):
            after_power_cut(before, place, requests[:count], cut, lost)
            now = found(cut)
            assert now == new if count == len(requests) else now in (old, new), requests[:count][-1:]
        assert now == new
        lines = (cut / "calibrations/validity.jsonl").read_bytes().splitlines()
        assert all("version" in json.loads(line) for line in lines)
