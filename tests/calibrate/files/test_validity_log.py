"""A damaged, torn, old or long log of installations never makes a calibration usable again."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from calibrate import load_installed
from calibrate.errors import CalibrationFileError, InstallError, UsageError
from calibrate.files import loader, validity_writer
from calibrate.files.calibration import read_calibration
from calibrate.files.install import install, note_check, rollback, set_validity, withdraw
from calibrate.files.loader import watch
from calibrate.files.sealed_lines import is_torn, seal, sealed_content
from calibrate.files.validity import Validity, ValidityReason, ValidityState
from calibrate.files.versions import installed_versions, read_log
from tests.codes import raises

V, U, D, W = ValidityState.VALID, ValidityState.UNVERIFIED, ValidityState.IN_DOUBT, ValidityState.WITHDRAWN
MOVED = ValidityReason("drift-check", "Camera shift 3.00 mm.", {"shift_mm": 3.0})


def log_of(root: Path) -> Path:
    return root / "calibrations" / "validity.jsonl"


def state(root: Path) -> tuple[ValidityState, str]:
    held = load_installed(root, require_valid=False).validity
    return held.state, held.reason.code


def usable(root: Path) -> bool:
    try:
        load_installed(root)
    except InstallError:
        return False
    return True


def flipped(content: bytes) -> Iterator[bytes]:
    """The content with each of its bits flipped."""
    for place in range(len(content)):
        for bit in range(8):
            yield content[:place] + bytes([content[place] ^ 1 << bit]) + content[place + 1 :]


@pytest.fixture
def quick_load(monkeypatch: pytest.MonkeyPatch) -> None:
    """`load_installed` as it is, but a calibration file that it has parsed is not parsed again."""
    monkeypatch.setattr(loader, "verified_plain", lru_cache(loader.verified_plain))


def unsealed(root: Path) -> None:
    """Make the log one of before, without checksums."""
    lines = [sealed_content(line) or line for line in log_of(root).read_bytes().splitlines()]
    log_of(root).write_bytes(b"".join(line + b"\n" for line in lines))


# --- damage ---
@pytest.mark.usefixtures("quick_load")
@pytest.mark.parametrize("lines", ["all", "the last alone"])
def test_no_flipped_bit_makes_a_withdrawn_version_load(root: Path, lines: str) -> None:
    """Line feeds too: a flip joins two lines, or splits one."""
    withdraw(root, "A pallet hit the camera. JJJ ***")  # letters that a flip makes line feeds
    log = log_of(root)
    if lines == "the last alone":
        log.write_bytes(log.read_bytes().splitlines(keepends=True)[-1])
    content = log.read_bytes()
    tried, loaded = 0, 0
    for damaged in flipped(content):
        log.write_bytes(damaged)
        tried += 1
        loaded += usable(root)
    assert tried == 8 * len(content)
    assert loaded == 0


@pytest.mark.usefixtures("quick_load")
def test_no_flipped_bit_makes_a_doubted_version_of_several_load(root: Path, make_file) -> None:
    for k in range(2):
        install(make_file(0.001 * (k + 1)), root)
    note_check(root, MOVED, False, True, datetime.now(UTC) + timedelta(seconds=2))
    log, loaded = log_of(root), 0
    for damaged in islice(flipped(log.read_bytes()), None, None, 7):  # each bit of many places, in turn
        log.write_bytes(damaged)
        loaded += usable(root)
    assert loaded == 0


def test_behind_a_damaged_line_a_version_is_in_doubt_and_no_check_ends_it(root: Path) -> None:
    withdraw(root, "A pallet hit the camera.")
    log = log_of(root)
    log.write_bytes(log.read_bytes().replace(b"withdrawn", b"withdrawm", 1))
    with raises("calibration-in-doubt", InstallError, reason="log-damaged") as refused:
        load_installed(root)
    assert "--override" in refused.value.remedy
    written = log.read_bytes()
    later = datetime.now(UTC) + timedelta(hours=1)
    for passed in (True, False):
        assert note_check(root, MOVED, passed, True, later).reason.code == "log-damaged"
    for given_state in (V, D, U):
        assert set_validity(root, given_state, MOVED).reason.code == "log-damaged"
    assert log.read_bytes() == written
    assert set_validity(root, W, MOVED).state is W


def test_a_person_who_says_so_ends_a_doubt_by_damage_and_is_named(root: Path) -> None:
    withdraw(root, "A pallet hit the camera.")
    log = log_of(root)
    log.write_bytes(log.read_bytes().replace(b"withdrawn", b"withdrawm", 1))
    with raises("override-without-version", UsageError):
        rollback(root, override="Nobody withdrew it.")
    rollback(root, to=1)
    assert state(root) == (D, "log-damaged"), "naming it alone does not say that it holds"
    rollback(root, to=1, override="Nobody withdrew it, says Anna.")
    held = load_installed(root).validity
    assert (held.state, held.reason.code) == (U, "override")
    assert held.who
    assert read_log(root)[-1].reason == "Nobody withdrew it, says Anna."
    assert note_check(root, MOVED, True, True, datetime.now(UTC) + timedelta(hours=1)).state is V


def test_a_new_installation_is_not_in_doubt_by_older_damage_but_the_versions_before_it_are(
    root: Path, make_file
) -> None:
    log = log_of(root)
    log.write_bytes(log.read_bytes()[:40] + b"#" + log.read_bytes()[41:])
    install(make_file(0.001), root)
    assert state(root) == (V, "installed")
    assert [version.validity.state for version in installed_versions(root)] == [D, V]
    rollback(root, to=1)
    assert state(root) == (D, "log-damaged")


def test_a_program_that_watches_is_told_of_the_damage(root: Path) -> None:
    log = log_of(root)
    log.write_bytes(log.read_bytes().replace(b"valid", b"valie", 1))
    (change,) = watch(root, poll_s=0.001, stop_s=0.01, first=True)
    assert change.event == "in-doubt" or change.event == "installed"
    assert change.installed is not None
    assert change.installed.validity.reason.code == "log-damaged"


# --- ends ---
@pytest.mark.usefixtures("quick_load")
def test_a_torn_line_was_never_acknowledged_and_a_whole_one_without_its_line_feed_counts(root: Path) -> None:
    log = log_of(root)
    before = log.read_bytes()
    withdraw(root, 'A "pallet" \\ hit {the} camera ä.')
    line = log.read_bytes()[len(before) :]
    for length in range(len(line) - 1):
        log.write_bytes(before + line[:length])
        assert state(root) == (V, "installed"), line[:length]
    log.write_bytes(before + line[:-1])
    assert state(root) == (W, "withdrawn")


def test_what_is_written_behind_a_torn_line_takes_its_place(root: Path) -> None:
    log = log_of(root)
    before = log.read_bytes()
    for torn in (b'{"version":1,"state":"withd', b"{"):
        log.write_bytes(before + torn)
        set_validity(root, D, MOVED)
        assert state(root) == (D, "drift-check")
        assert torn not in log.read_bytes().removeprefix(before) or torn == b"{"
        assert log.read_bytes().count(b"\n") == before.count(b"\n") + 1
    log.write_bytes(log.read_bytes()[:-1])
    withdraw(root, "A pallet hit the camera.")
    assert state(root) == (W, "withdrawn")
    assert len(log.read_bytes().splitlines()) == before.count(b"\n") + 2


@given(st.text(min_size=1), st.floats(allow_nan=False), st.data())
def test_a_line_is_torn_wherever_it_ends_and_only_there(text: str, value: float, data: st.DataObject) -> None:
    line = seal(json.dumps({"text": text, "values": [{"x": value}]}, ensure_ascii=False).encode())
    assert sealed_content(line) is not None
    assert not is_torn(line)
    end = data.draw(st.integers(1, len(line) - 1))
    assert is_torn(line[:end])
    behind = data.draw(st.binary(min_size=1))
    assert not is_torn(line + behind)
    assert sealed_content(line + behind) is None


# --- logs of before ---
def test_a_log_of_before_counts_as_written_and_is_sealed_by_the_next_line(root: Path, make_file) -> None:
    withdraw(root, "A pallet hit the camera.")
    unsealed(root)
    log_of(root).chmod(0o664)
    assert state(root) == (W, "withdrawn")
    install(make_file(0.001), root)
    assert [version.validity.state for version in installed_versions(root)] == [W, V]
    lines = log_of(root).read_bytes().splitlines()
    assert len(lines) == 3
    assert all(sealed_content(line) is not None for line in lines)
    assert log_of(root).stat().st_mode & 0o777 == 0o664
    assert [entry.generation for entry in read_log(root)] == [1, 2]


def test_a_line_without_a_checksum_among_sealed_ones_is_damage(root: Path) -> None:
    plain = {"version": 1, "state": "valid", "since": "", "reason": {"code": "drift-check"}}
    withdraw(root, "A pallet hit the camera.")
    with log_of(root).open("a") as log:
        log.write(json.dumps(plain) + "\n")
    assert state(root) == (W, "withdrawn"), "what was withdrawn is not made milder by damage"
    set_validity(root, V, MOVED)
    with log_of(root).open("a") as log:
        log.write(json.dumps(plain) + "\n")
    assert state(root) == (D, "log-damaged")


def test_what_a_later_version_adds_to_a_sealed_line_is_ignored(root: Path) -> None:
    plain = {
        "version": 1,
        "state": "withdrawn",
        "since": "",
        "reason": {"code": "x", "how": 1},
        "told": "more",
    }
    with log_of(root).open("ab") as log:
        log.write(seal(json.dumps(plain).encode()) + b"\n")
    assert state(root) == (W, "x")


# --- length ---
def small_log(monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(validity_writer, "ROTATE_BYTES", 8000)
    return 8000


def test_a_long_log_keeps_the_last_line_of_every_version(
    root: Path, make_file, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit_bytes = small_log(monkeypatch)
    withdraw(root, "A pallet hit the camera.")
    install(make_file(0.001), root, max_age_days=9000)
    set_validity(root, D, MOVED)
    install(make_file(0.002), root)
    for k in range(300):
        set_validity(root, (D, V)[k % 2], ValidityReason("drift-check", f"check {k}"))
        assert log_of(root).stat().st_size < 1.5 * limit_bytes
    states = [version.validity.state for version in installed_versions(root)]
    assert states == [W, D, V]
    assert load_installed(root).validity.reason.text == "check 299"
    assert load_installed(root).validity.max_age_days == 9000
    rollback(root, to=2)
    assert state(root) == (D, "drift-check")


def test_a_doubt_by_damage_outlives_a_long_log(
    root: Path, make_file, monkeypatch: pytest.MonkeyPatch
) -> None:
    small_log(monkeypatch)
    log_of(root).write_bytes(b"damaged\n" + log_of(root).read_bytes() + b"damaged\n")
    install(make_file(0.001), root)
    for k in range(100):
        set_validity(root, D, ValidityReason("drift-check", f"check {k}"))
    assert b"damaged\n" not in log_of(root).read_bytes()
    held = [(version.validity.state, version.validity.reason.code) for version in installed_versions(root)]
    assert held == [(D, "log-damaged"), (D, "drift-check")]


def test_a_huge_log_of_before_refuses_no_program(root: Path) -> None:
    withdraw(root, "A pallet hit the camera. " * 10_000)
    unsealed(root)
    line = log_of(root).read_bytes().splitlines(keepends=True)[-1]
    with log_of(root).open("ab") as log:
        while log.tell() < 66 * 2**20:
            log.write(line)
    assert state(root) == (W, "withdrawn")
    set_validity(root, D, MOVED)
    assert log_of(root).stat().st_size < 2**20
    assert state(root) == (D, "drift-check")


def test_a_line_without_end_is_damage(root: Path) -> None:
    with log_of(root).open("ab") as log:
        log.write(b'{"version":1,"state":"' + b"x" * (3 * 2**20))
    assert state(root) == (D, "log-damaged")


def test_a_reason_that_no_line_can_hold_changes_nothing(root: Path) -> None:
    with raises("install-io", InstallError):
        withdraw(root, "A pallet hit the camera. " * 50_000)
    assert state(root) == (V, "installed")


# --- age ---
@pytest.mark.parametrize("verified", ["2999-01-01T00:00:00+00:00", "", "soon", "9999-12-31T23:59:59-14:00"])
def test_a_proof_of_the_future_or_of_no_known_time_is_too_old_where_a_limit_is_set(verified: str) -> None:
    held = Validity(1, V, "", ValidityReason("installed"), verified=verified, max_age_days=30.0)
    late = held.at(datetime.now(UTC))
    assert (late.state, late.reason.code, late.reason.values["age_days"]) == (D, "too-old", None)
    assert late == held.at(datetime.now(UTC) + timedelta(hours=1)), "who watches is told once"
    unlimited = Validity(1, V, "", ValidityReason("installed"), verified=verified)
    assert unlimited.at(datetime.now(UTC)).state is V


def test_nothing_is_written_about_a_clock_that_is_behind(root: Path, make_file) -> None:
    ahead = datetime.now(UTC) + timedelta(days=400)
    note_check(root, MOVED, True, True, ahead)
    install(make_file(0.001), root, max_age_days=1e5)
    note_check(root, MOVED, True, True, ahead)
    written = log_of(root).read_bytes()
    with raises("calibration-in-doubt", InstallError, reason="too-old"):
        load_installed(root)
    assert log_of(root).read_bytes() == written
    rollback(root, to=2)
    line: dict[str, Any] = json.loads(log_of(root).read_bytes().splitlines()[-1])
    assert line["state"] == "valid", "a doubt for one call is not kept"


# --- files ---
def test_another_version_copied_over_one_is_refused(root: Path, make_file) -> None:
    first = load_installed(root).path
    second = install(make_file(0.001), root).path
    second.write_bytes(first.read_bytes())
    for read in (lambda: load_installed(root), lambda: read_calibration(second)):
        with raises("damaged-calibration", CalibrationFileError):
            read()
    assert [bool(version.problem) for version in installed_versions(root)] == [False, True]


def test_a_file_that_an_earlier_software_named_by_its_hash_line_still_loads(root: Path) -> None:
    path = load_installed(root).path
    digits = read_line_digits(path)
    older = path.with_name(f"0001-{digits}.yaml")
    path.rename(older)
    current = root / "calibrations" / "current"
    current.unlink()
    current.symlink_to(Path("gen") / older.name)
    assert load_installed(root).path == older


def read_line_digits(path: Path) -> str:
    line = next(line for line in path.read_text().splitlines() if line.startswith("sha256:"))
    return line.partition(":")[2].strip().strip("'")[:8]
