"""Whether an installed calibration still holds: what sets it, what clears it, and who is told."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibrate import load_installed, watch
from calibrate.errors import CalibrationFileError, InstallError, UsageError
from calibrate.files.calibration import read_calibration
from calibrate.files.folders import cameras
from calibrate.files.install import install, installed_calibration, note_check, rollback, set_validity
from calibrate.files.integrity import canonical_json
from calibrate.files.sealed_lines import seal
from calibrate.files.touch import Touch, agrees, touch_sigmas
from calibrate.files.validity import Validity, ValidityReason, ValidityState, validity_text
from calibrate.files.versions import installed_versions, note_in_file, note_installed, read_log
from tests.codes import raises
from tests.patience import PATIENCE_S

MakeFile = Callable[..., Path]
V, U, D, W = ValidityState.VALID, ValidityState.UNVERIFIED, ValidityState.IN_DOUBT, ValidityState.WITHDRAWN
MOVED = ValidityReason("drift-check", "Camera shift 3.00 mm.", {"shift_mm": 3.0})
KNOCKED = ValidityReason("withdrawn", "A pallet hit the camera.")


def check(root: Path, passed: bool, proves: bool = True, reason: ValidityReason = MOVED) -> Validity:
    return note_check(root, reason, passed, proves, datetime.now(UTC) + timedelta(seconds=2))


def touch(offset_mm: float) -> Touch:
    return Touch(0, (0.0, 0.0), (offset_mm, 0.0), (0.1, 0.1), "told by a person", "anna", "2026-01-01")


def test_what_is_installed_is_valid_until_a_check_contradicts_it_and_again_when_one_passes(
    root: Path,
) -> None:
    assert load_installed(root, require_valid=True).validity.state is V
    assert check(root, passed=False).state is D
    doubted = load_installed(root, require_valid=False)
    assert doubted.validity.reason == MOVED
    for require in (None, True):
        with raises("calibration-in-doubt", InstallError, version=1, reason="drift-check"):
            load_installed(root, require_valid=require)
    valid = note_check(root, MOVED, True, True, datetime.now(UTC) + timedelta(hours=1))
    assert valid.state is V and valid.since == valid.verified > doubted.validity.verified
    assert check(root, passed=True).since == valid.since


def test_a_pass_that_could_have_missed_the_shift_proves_nothing(root: Path) -> None:
    check(root, passed=False)
    since = load_installed(root, require_valid=False).validity.since
    assert check(root, passed=True, proves=False, reason=ValidityReason("touch-test")).state is U
    with raises("calibration-unverified", InstallError, since=since):
        load_installed(root, require_valid=True)
    assert load_installed(root).validity.state is U
    assert check(root, passed=True).state is V
    assert check(root, passed=False, proves=False).state is U  # the arm's own errors may have failed it


def test_old_views_tell_nothing_of_today(root: Path) -> None:
    note_check(root, MOVED, False, True, datetime(2020, 1, 1, tzinfo=UTC))
    assert load_installed(root).validity.state is V


def test_a_failed_check_counts_though_the_clock_was_ahead_before(make_file: MakeFile, tmp_path: Path) -> None:
    ahead = datetime.now(UTC) + timedelta(days=365)
    path = make_file()
    provenance = msgspec.structs.replace(
        read_calibration(path).provenance, recorded_wall_ns=int(ahead.timestamp() * 1e9)
    )
    install(make_file(provenance=provenance), tmp_path / "s")
    assert check(tmp_path / "s", passed=False).state is D


@pytest.mark.parametrize(
    ("line", "kept"),
    [
        ('"version":[1],"since":"","verified":""', False),
        ('"version":true,"since":"","verified":""', False),
        ('"version":1,"since":"","verified":null', False),
        ('"version":1,"since":"","verified":"","max_age_days":"3"', False),
        ('"version":1,"since":"","verified":"","max_age_days":NaN', False),
        ('"version":1,"since":"0001-01-01T00:00+23:59","verified":"0001-01-01T00:00+23:59"', True),
        ('"version":1,"since":"","verified":"","told_by":"a later version"', True),
    ],
)
def test_a_line_of_another_shape_is_damage_and_what_a_later_version_adds_to_one_is_ignored(
    root: Path, line: str, kept: bool
) -> None:
    with (root / "calibrations/validity.jsonl").open("ab") as file:
        file.write(
            seal(('{"state":"withdrawn","reason":{"code":"withdrawn"},' + line + "}").encode()) + b"\n"
        )
        file.write(b"[" * 100_000 + b"\n")
    held = load_installed(root, require_valid=False).validity
    assert (held.state, held.reason.code) == ((W, "withdrawn") if kept else (D, "log-damaged"))
    assert validity_text(installed_versions(root)[0].validity)


def test_what_a_person_withdrew_no_check_brings_back_and_no_rollback_finds(
    root: Path, make_file: MakeFile
) -> None:
    set_validity(root, W, KNOCKED)
    assert check(root, passed=True).state is W
    with raises("calibration-withdrawn", InstallError, reason="withdrawn") as refused:
        load_installed(root)
    assert "drift-check" not in refused.value.remedy and "calibrate install" in refused.value.remedy
    install(make_file(0.001), root)
    assert load_installed(root).validity.state is V
    with raises("nothing-older", InstallError):
        rollback(root)
    rollback(root, to=1)  # a person who names it means it
    assert load_installed(root).validity.state is U


def test_what_is_rolled_back_to_is_unverified_or_still_in_doubt(root: Path, make_file: MakeFile) -> None:
    check(root, passed=False)
    install(make_file(0.001), root)
    install(make_file(0.002), root)
    rollback(root)
    assert load_installed(root).validity.reason.code == "rolled-back"
    rollback(root)
    assert load_installed(root, require_valid=False).validity.state is D


def test_a_missed_corner_puts_it_in_doubt_and_a_met_one_clears_that(root: Path) -> None:
    tested = installed_calibration(root)
    assert note_installed(root, tested, [touch(0.1)]).validity.state is V
    note_installed(root, tested, [touch(0.1), touch(5.0)])
    found = load_installed(root, require_valid=False)
    assert (found.version, found.validity.state, found.validity.reason.code) == (3, D, "touch-test")
    note_installed(root, tested, [touch(0.2)])
    assert load_installed(root).validity.state is V


def test_a_corner_alarms_beyond_three_sigmas_of_both_together() -> None:
    """0.4 mm predicted and 0.3 mm by hand are 0.5 mm; of two numbers 1 % lies beyond 3.03 sigmas."""
    found = msgspec.structs.replace(touch(0.0), sigma_mm=(0.4, 0.4), offset_mm=(0.3, -0.4))
    assert touch_sigmas(found) == pytest.approx(1.0)
    near, far = (msgspec.structs.replace(found, offset_mm=(0.0, 0.5 * sigmas)) for sigmas in (3.02, 3.05))
    assert agrees(near) and not agrees(far)


def test_touches_stay_in_a_file_that_is_installed_and_make_a_version_of_what_is(
    own_file: Path, tmp_path: Path
) -> None:
    before, root, good = read_calibration(own_file), tmp_path / "s", touch(0.1)
    assert note_installed(root, before, [good]) is None and not root.exists()
    note_in_file(own_file, [good])
    note_in_file(own_file, [good])
    assert read_calibration(own_file) == msgspec.structs.replace(before, verification=[good, good])
    install(own_file, root)
    another = msgspec.structs.replace(before, created="2026-01-02T00:00:00+00:00")
    assert note_installed(root, another, [good]) is None
    note_installed(root, before, [good])
    assert installed_calibration(root).verification == [good] * 3
    assert [g.number for g in installed_versions(root)] == [1, 2]
    assert read_log(root)[-1].action == "verify"
    rollback(root, to=1)  # by its number: going back alone leads to another solve
    assert installed_calibration(root).verification == [good] * 2


@pytest.mark.parametrize(("source", "override"), [("imported", ""), ("real", "the hand slipped")])
def test_what_nobody_vouches_for_is_unverified(
    make_file: MakeFile, tmp_path: Path, source: str, override: str
) -> None:
    path = make_file(source=source, verification=[touch(5.0)] if override else [])
    cell = "imported" if source == "imported" else "real"
    if override:
        with raises("objection", InstallError, objections=1, gates=0):
            install(path, tmp_path / "s")
    install(path, tmp_path / "s", cell=cell, override=override)
    assert load_installed(tmp_path / "s").validity.state is U


def test_what_has_lost_its_record_is_unverified(root: Path) -> None:
    (root / "calibrations/validity.jsonl").unlink()
    found = load_installed(root).validity
    assert (found.state, found.reason.code) == (U, "no-record")
    assert check(root, passed=True).state is V


@pytest.mark.parametrize("kind", ["robot", "camera"])
def test_another_device_than_the_calibrated_one_is_a_doubt(root: Path, kind: str) -> None:
    serial = load_installed(root).plain[kind]["serial"]
    assert load_installed(root, **{f"{kind}_serial": serial}).validity.state is V
    with raises("calibration-in-doubt", InstallError, reason=f"{kind}-changed"):
        load_installed(root, **{f"{kind}_serial": "another"})


def test_the_cells_own_rule_puts_an_old_proof_in_doubt(make_file: MakeFile, tmp_path: Path) -> None:
    root = tmp_path / "s"
    with raises("not-positive"):
        install(make_file(), root, max_age_days=float("nan"))
    install(make_file(), root, max_age_days=30.0)
    now = datetime.now(UTC)
    proven = Validity(1, V, "", ValidityReason("installed"), verified=now.isoformat(), max_age_days=30.0)
    assert proven.at(now + timedelta(days=29)).state is V
    late = proven.at(now + timedelta(days=31))
    assert (late.state, late.reason.code, late.reason.values["limit_days"]) == (D, "too-old", 30.0)
    install(make_file(0.001), root)
    kept = load_installed(root, require_valid=False).validity
    assert (kept.state, kept.max_age_days) == (D, 30.0), "the rule is the cell's; the views are of 2023"
    install(make_file(0.002), root, max_age_days=3e6)  # by a program: the command line refuses it
    assert load_installed(root).validity.state is V
    install(make_file(0.002), root, max_age_days=0)
    assert load_installed(root).validity.max_age_days is None


def test_a_state_may_be_given_by_its_name_and_no_other_one(root: Path) -> None:
    proven = load_installed(root).validity.verified
    assert set_validity(root, D, MOVED).verified == proven, "a doubt proves nothing"
    assert set_validity(root, "valid", MOVED).state is V
    assert load_installed(root).validity.verified != proven
    with raises("choice", UsageError, given="validd"):
        set_validity(root, "validd", MOVED)


# --- several cameras ---
def test_each_camera_has_its_own(root: Path, make_file: MakeFile) -> None:
    install(make_file(0.001), root, camera="wrist")
    install(make_file(0.002), root, camera="wrist")
    assert cameras(root) == ["main", "wrist"]
    set_validity(root, D, MOVED, camera="wrist")
    assert load_installed(root).validity.state is V
    with raises("calibration-in-doubt", InstallError, camera="wrist"):
        load_installed(root, camera="wrist")
    rollback(root, camera="wrist")
    assert load_installed(root, camera="wrist").version == 1
    assert [len(installed_versions(root, name)) for name in cameras(root)] == [1, 2]
    for bad in ("../main", "Wrist", ""):
        with raises("camera-name", InstallError):
            load_installed(root, camera=bad)


# --- the light loader ---
numbers = st.floats(allow_nan=False, allow_infinity=False) | st.sampled_from(
    [1e-5, -1.5e-5, 1e16, 1e-6, 5e-324]
)
plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | numbers | st.text(),
    lambda inside: st.lists(inside) | st.dictionaries(st.text(), inside),
)


@settings(max_examples=40)
@given(plain)
def test_the_hash_is_over_the_same_bytes_as_ever(value: object) -> None:
    assert canonical_json(value).encode() == msgspec.json.encode(value, order="deterministic")


def test_it_loads_with_numpy_and_yaml_alone_and_says_the_same(root: Path) -> None:
    program = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("msgspec", "scipy", "cv2", "mcap", "google", "typer", "rich", "zstandard"):
            raise ImportError(name)
sys.meta_path.insert(0, Refuse())
from pathlib import Path
from calibrate import load_installed
found = load_installed(Path(sys.argv[1]))
print(*found.transform.matrix.ravel().tolist(), *found.intrinsics.matrix.ravel().tolist())
print(found.validity.state)
"""
    done = subprocess.run(
        [sys.executable, "-c", program, root], capture_output=True, text=True, check=True, timeout=60
    )
    full = installed_calibration(root)
    said = done.stdout.split()
    assert said.pop() == "valid"
    told = np.array(said, float)
    assert np.array_equal(told[:16], full.transform.matrix.ravel())
    assert np.array_equal(told[16:], np.array(full.intrinsics.matrix).ravel())
    light = load_installed(root)
    assert light.intrinsics.model == full.intrinsics.model
    assert np.array_equal(light.covariance, np.array(full.covariance))


def test_a_damaged_file_is_never_loaded(root: Path) -> None:
    path = load_installed(root).path
    path.write_bytes(path.read_bytes().replace(b"translation_m: [", b"translation_m: [1", 1))
    with raises("damaged-calibration", CalibrationFileError):
        load_installed(root)


def test_a_program_that_watches_hears_of_changes_only_and_for_as_long_as_it_said(root: Path) -> None:
    """`first`: also of what is there. Every kind of change: test_follow."""
    assert not list(watch(root, poll_s=0.001, stop_s=0.02))
    changes = watch(root, poll_s=0.01, stop_s=PATIENCE_S, first=True)
    assert next(changes).installed is not None
    (root / "calibrations/current").unlink()
    gone = next(changes)
    assert gone.installed is None and gone.problem is not None and gone.problem.code == "nothing-installed"
