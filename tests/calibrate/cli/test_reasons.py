"""A person's reason is words; going back leads to another solve; what speaks against one is told before."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from calibrate.errors import InstallError
from calibrate.files.install import (
    install,
    installed_calibration,
    objections_beside,
    reason_problem,
    rollback,
)
from calibrate.files.touch import Touch
from calibrate.files.versions import installed_versions, note_installed
from tests.codes import raises

MakeFile = Callable[..., Path]
HAND = Touch(0, (0.0, 0.0), (9.0, 0.0), (0.1, 0.1), "told by a person", "anna", "2026-01-01T00:00:00+00:00")


@pytest.mark.parametrize(
    ("said", "accepted"),
    [
        *((said, False) for said in ("", "x", "ok", "...", "aaaaaaaaaa", "12345678", "test")),
        *((said, True) for said in ("line is down, checked with a pointer", "trial", "标定板移动了")),
    ],
)
def test_a_reason_is_words_in_any_script_and_no_keypress(said: str, accepted: bool) -> None:
    assert (reason_problem(said) == "") is accepted


def test_going_back_passes_the_checks_by_hand_of_the_same_solve(make_file: MakeFile, tmp_path: Path) -> None:
    """Who finds it off by hand and goes back must not get the same one without the finding."""
    first = make_file()
    install(first, tmp_path)
    note_installed(tmp_path, [HAND])
    with raises("nothing-older", InstallError):
        rollback(tmp_path)
    install(make_file(0.001), tmp_path)
    note_installed(tmp_path, [HAND])
    assert [g.number for g in installed_versions(tmp_path)] == [1, 2, 3, 4]
    assert rollback(tmp_path).number == 2


def test_what_speaks_against_it_beside_its_gates_is_known_before(make_file: MakeFile, tmp_path: Path) -> None:
    install(make_file(), tmp_path)
    now = installed_calibration(tmp_path)
    assert objections_beside(now, tmp_path) == []
    assert objections_beside(now, tmp_path / "empty") == []
    quality = msgspec.structs.replace(
        now.quality, working_distance_m=0.9 * (now.quality.working_distance_m or 1)
    )
    elsewhere = msgspec.structs.replace(now, quality=quality)
    assert objections_beside(elsewhere, tmp_path) == [], "as right as the installed one, for nearer points"
    vague = tuple(tuple(9 * value for value in row) for row in now.covariance)
    vaguer = msgspec.structs.replace(elsewhere, covariance=vague)
    (worse,) = objections_beside(vaguer, tmp_path)
    assert "Regression" in worse
    newer = msgspec.structs.replace(now.provenance, software={"calibration-station": "9.0"})
    (stated_anew,) = objections_beside(msgspec.structs.replace(vaguer, provenance=newer), tmp_path)
    assert stated_anew.startswith(worse) and stated_anew != worse, "another version's error is no measure"
    robot = msgspec.structs.replace(now.robot, serial="2099999999")
    (other,) = objections_beside(msgspec.structs.replace(now, robot=robot), tmp_path)
    assert "2099999999" in other
