"""What hands found is kept in the file, survives installing, and is said."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from calibrate.errors import InstallError
from calibrate.files.calibration import read_calibration
from calibrate.files.install import install, installed_calibration, rollback
from calibrate.files.touch import Touch, agrees, touch_sigmas
from calibrate.files.versions import installed_versions, note_in_file, note_installed, read_log
from tests.codes import raises

GOOD = Touch(
    0, (0.0, 0.0), (0.3, -0.2), (0.15, 0.15), "told by a person", "anna", "2026-11-21T12:00:00+00:00"
)
BAD = msgspec.structs.replace(GOOD, corner=41, corner_mm=(150.0, 125.0), offset_mm=(2.1, -0.4))


def test_a_corner_alarms_beyond_three_sigmas_of_both_together() -> None:
    """0.4 mm predicted and 0.3 mm by hand are 0.5 mm; of two numbers 1 % lies beyond 3.03 sigmas."""
    touch = msgspec.structs.replace(GOOD, sigma_mm=(0.4, 0.4), offset_mm=(0.3, -0.4))
    assert touch_sigmas(touch) == pytest.approx(1.0)
    near, far = (msgspec.structs.replace(touch, offset_mm=(0.0, 0.5 * sigmas)) for sigmas in (3.02, 3.05))
    assert agrees(near) and not agrees(far)


def test_entries_go_into_a_file_and_stay_when_it_is_installed(own_file: Path, tmp_path: Path) -> None:
    before = read_calibration(own_file)
    note_in_file(own_file, [GOOD])
    note_in_file(own_file, [GOOD])
    after = read_calibration(own_file)
    assert after.verification == [GOOD, GOOD]
    assert msgspec.structs.replace(after, verification=[]) == before
    install(own_file, tmp_path / "s")
    assert installed_calibration(tmp_path / "s").verification == [GOOD, GOOD]


def test_entries_for_the_installed_one_make_a_new_generation(own_file: Path, tmp_path: Path) -> None:
    root = tmp_path / "s"
    with raises("nothing-installed", InstallError):
        note_installed(root, [GOOD])
    install(own_file, root)
    note_installed(root, [GOOD])
    assert installed_calibration(root).verification == [GOOD]
    assert [g.number for g in installed_versions(root)] == [1, 2]
    assert read_log(root)[-1].action == "verify"
    rollback(root, to=1)  # by its number: going back alone leads to another solve
    assert installed_calibration(root).verification == []


def test_hands_that_disagree_keep_it_from_being_installed(own_file: Path, tmp_path: Path) -> None:
    note_in_file(own_file, [GOOD, BAD])
    with raises("objection", InstallError, objections=1, gates=0):
        install(own_file, tmp_path / "s")
    made = install(own_file, tmp_path / "s", override="the board was bent there")
    assert made.calibration is not None and made.calibration.override is not None
