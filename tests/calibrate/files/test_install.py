"""Old or new, never neither; and only what belongs on this cell."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from calibrate.cli import main
from calibrate.errors import GateFailedError, InstallError, UsageError
from calibrate.files.calibration import read_calibration
from calibrate.files.install import (
    install,
    install_line,
    installed_calibration,
    objections_beside,
    reason_problem,
    rollback,
    undo_line,
    withdraw,
)
from calibrate.files.loader import load_installed
from calibrate.files.touch import Touch
from calibrate.files.versions import installed_versions, note_installed, read_log
from calibrate.pipeline.job import SolvedRecording
from calibrate.results import Gate
from tests.codes import raises
from tests.command_line import call


def test_the_next_step_of_a_solve_is_one_that_works() -> None:
    assert install_line("real", Path("c.yaml")) == "calibrate install c.yaml"
    assert install_line("real", Path("my c.yaml")) == "calibrate install 'my c.yaml'"
    again = install_line("playback", Path("c.yaml"), Path("/r"), "REASON")
    assert again == "calibrate install c.yaml --cell simulated --override REASON --root /r"
    assert "--root ROOT" in install_line("simulated", Path("c.yaml"))


def test_what_undoes_an_install_is_named_and_works(make_file, tmp_path: Path) -> None:
    """The first has none before it: it is withdrawn. Every later one is rolled back."""
    root = tmp_path / "a state"
    with raises("nothing-installed", InstallError):
        rollback(root)
    for camera in ("main", "wrist"):
        install(make_file(), root, camera=camera)
        with raises("nothing-older", InstallError) as refused:
            rollback(root, camera=camera)
        line = undo_line(root, camera)
        assert line in refused.value.remedy and "withdraw" in line
        assert call(main, *shlex.split(line)[1:]).returncode == 0
        with raises("calibration-withdrawn", InstallError):
            load_installed(root, camera=camera)
    install(make_file(0.001), root)
    install(make_file(0.002), root)
    assert call(main, *shlex.split(undo_line(root))[1:]).returncode == 0
    assert load_installed(root).version == 2
    with raises("no-such-version", InstallError, generation=9):
        rollback(root, to=9)
    for too_short in (withdraw, lambda root, reason: rollback(root, reason=reason)):
        with raises("reason-too-short", InstallError):
            too_short(root, "xxx")
    assert load_installed(root).version == 2


@pytest.mark.parametrize("source", ["simulated", "playback", "imported"])
def test_nothing_unreal_installs_on_a_real_cell_whatever_the_reason(
    make_file, tmp_path: Path, source: str
) -> None:
    path = make_file(source=source)
    with raises("other-cell", InstallError, source=source, cell="real"):
        install(path, tmp_path / "s", override="I insist")
    assert not (tmp_path / "s/calibrations/current").exists()


def test_kinds_of_cells_do_not_mix(make_file, tmp_path: Path) -> None:
    root = tmp_path / "s"
    install(make_file(), root)
    with raises("other-cell", InstallError, source="simulated", cell="real"):
        install(make_file(source="simulated"), root, cell="simulated")
    simulated = tmp_path / "simulated"
    install(make_file(source="simulated"), simulated, cell="simulated")
    with raises("choice", UsageError, given="reel"):
        install(make_file(), root, cell="reel")
    with raises("not-real", InstallError, source="simulated"):
        load_installed(simulated)
    assert load_installed(simulated, allow_simulated=True).source == "simulated"


def test_a_failed_gate_needs_a_persons_reason_which_goes_into_the_file(
    make_file, solved_real: SolvedRecording, tmp_path: Path
) -> None:
    bad = Gate("holdout_share", False, 0.1, 0.005, "predicted to 100 mm")
    path = make_file(quality=msgspec.structs.replace(solved_real.calibration.quality, gates=[bad]))
    with raises("gate-failed", GateFailedError, gates=1) as refused:
        install(path, tmp_path / "s")
    assert refused.value.exit_code == 4
    with pytest.raises(GateFailedError):
        install(path, tmp_path / "s", override="   ")
    with raises("reason-too-short", InstallError):
        install(path, tmp_path / "s", override="x")
    install(path, tmp_path / "s", override="line is down, checked with a pointer")
    installed = installed_calibration(tmp_path / "s")
    assert installed.override.reason == "line is down, checked with a pointer"
    assert "holdout_share" in installed.override.overridden[0]
    assert installed.verdict == "FAIL", "a reason mends no gate"


def test_another_robot_camera_or_mount_is_refused(
    make_file, solved_real: SolvedRecording, tmp_path: Path
) -> None:
    """Fault 47."""
    root = tmp_path / "s"
    install(make_file(), root)
    before = (root / "calibrations/current").read_bytes()
    made = solved_real.calibration
    others: list[dict[str, object]] = [
        {part: msgspec.structs.replace(getattr(made, part), **{key: "99"})}
        for part in ("robot", "camera")
        for key in ("serial", "model")
    ]
    for changes in (*others, {"mount": "eye-to-hand"}):
        with raises("objection", InstallError, objections=1):
            install(make_file(**changes), root)
    named = make_file(camera=msgspec.structs.replace(made.camera, name="wrist"))
    with raises("objection", InstallError, objections=1) as refused:
        install(named, root, camera="main")
    assert "--camera main" in refused.value.remedy, "as it was asked for"
    assert (root / "calibrations/current").read_bytes() == before


@pytest.mark.parametrize("versions", [1, 2])
def test_a_damaged_current_file_is_an_objection_and_the_one_before_is_compared(
    make_file, solved_real: SolvedRecording, tmp_path: Path, versions: int
) -> None:
    root = tmp_path / "s"
    for _ in range(versions):
        install(make_file(), root)
    current = (root / "calibrations/current").resolve()
    current.chmod(0o600)
    current.write_bytes(b"garbage")
    robot = msgspec.structs.replace(solved_real.calibration.robot, serial="2099999999")
    with raises("objection", InstallError, objections=versions):
        install(make_file(robot=robot), root)
    install(make_file(0.002), root, override="its file is garbage")
    assert installed_calibration(root).result.translation_m[0] == pytest.approx(
        solved_real.calibration.result.translation_m[0] + 0.002
    )


def test_an_unwritable_place_is_said(make_file, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with raises("state-folder", InstallError):
        install(make_file(), tmp_path / "file")


@pytest.mark.parametrize("look", [installed_versions, read_log, installed_calibration])
def test_a_place_that_may_not_be_looked_into_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, look: Callable[[Path], object]
) -> None:
    def refused(path: Path) -> bool:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "readlink", refused)  # who runs the tests may be root
    with raises("state-folder", InstallError):
        look(tmp_path)


MISSED = Touch(0, (0.0, 0.0), (9.0, 0.0), (0.1, 0.1), "told by a person", "anna", "2026-01-01T00:00:00+00:00")


def test_a_kill_at_any_touch_of_the_folder_leaves_old_or_new(make_file, tmp_path: Path) -> None:
    """Fault 46: SIGKILL before each call that opens, writes, renames, links or removes something there."""
    old, new = make_file(arm_table=None), make_file(0.001, arm_table=None)  # read two hundred times
    install(old, template := tmp_path / "template")
    results = {name: read_calibration(path) for name, path in (("old", old), ("new", new))}
    seen = []
    while True:
        root = Path(shutil.copytree(template, tmp_path / "kill", symlinks=True))
        if not _killed(len(seen), new, root):
            break
        found = installed_calibration(root)
        assert found in results.values(), len(seen)
        seen.append("new" if found == results["new"] else "old")
        versions = installed_versions(root)
        (current,) = (g.number for g in versions if g.current)
        assert read_log(root)[-1].generation == current, len(seen)
        assert all(not g.problem for g in versions), len(seen)
        install(new, root)  # what a person does next works
        assert installed_calibration(root) == results["new"]
        shutil.rmtree(root)
    assert len(seen) >= 12 and seen == sorted(seen, reverse=True), "it went back"
    assert {"old", "new"} == set(seen)


def _killed(place: int, new: Path, root: Path) -> bool:
    """Install in a process that is killed before it touches the folder or writes more than `place` times."""
    child = os.fork()
    if child:
        return os.waitpid(child, 0)[1] == signal.SIGKILL
    touched = count()

    def strike(touches: bool) -> None:
        if touches and next(touched) == place:
            os.kill(os.getpid(), signal.SIGKILL)

    def touch(event: str, given: tuple[object, ...]) -> None:
        strike(any(str(value).startswith(str(root)) for value in given))

    def call(frame: object, event: str, called: Any) -> None:
        strike(event == "c_call" and called.__name__ in ("write", "fsync"))

    try:
        sys.addaudithook(touch)
        sys.setprofile(call)
        install(new, root)
    finally:
        os._exit(0)


def test_a_much_less_certain_one_replaces_no_better_one_without_a_reason(
    make_file, solved_real: SolvedRecording, tmp_path: Path
) -> None:
    quality = solved_real.calibration.quality

    def vaguer(times: float) -> dict[str, Any]:
        point = msgspec.structs.replace(quality.point, error_mm=times * quality.point.error_mm)
        return {
            "covariance": (np.array(solved_real.calibration.covariance) * times**2).tolist(),
            "quality": msgspec.structs.replace(quality, point=point),
        }

    root = tmp_path / "s"
    install(make_file(**vaguer(2.0)), root)  # nothing to compare with
    install(make_file(), root)
    install(make_file(**vaguer(1.3)), root)
    with raises("gate-failed", GateFailedError, gates=1, objections=0):
        install(make_file(**vaguer(2.0)), root)
    assert len(installed_versions(root)) == 3
    made = install(make_file(**vaguer(2.0)), root, override="the old lens is broken")
    assert "no_worse" in made.calibration.override.overridden[0]
    assert rollback(root).number == 3


def test_an_x_known_less_well_is_no_worse_where_the_arm_makes_most_of_the_error(
    make_file, solved_real: SolvedRecording, tmp_path: Path
) -> None:
    """A point is placed as well as before. Beside a file that does not state that, X alone is compared."""
    quality = solved_real.calibration.quality
    covariance = np.array(solved_real.calibration.covariance)
    root = tmp_path / "s"
    point = msgspec.structs.replace(quality.point, error_mm=100 * quality.point.error_mm)
    by_arm = msgspec.structs.replace(quality, point=point)
    install(make_file(quality=by_arm), root)
    vaguer = (covariance * 2.0**2).tolist()
    install(make_file(quality=by_arm, covariance=vaguer), root)
    earlier = msgspec.structs.replace(quality, point=None)
    install(make_file(quality=earlier), root)
    with raises("gate-failed", GateFailedError, gates=1, objections=0):
        install(make_file(quality=by_arm, covariance=vaguer), root)


# --- reasons, and what is told before ---
@pytest.mark.parametrize(
    ("said", "accepted"),
    [
        *((said, False) for said in ("", "x", "ok", "...", "aaaaaaaaaa", "12345678", "test")),
        *((said, True) for said in ("line is down, checked with a pointer", "trial", "标定板移动了")),
    ],
)
def test_a_reason_is_words_in_any_script_and_no_keypress(said: str, accepted: bool) -> None:
    assert (reason_problem(said) == "") is accepted


def test_going_back_passes_the_checks_by_hand_of_the_same_solve(make_file, tmp_path: Path) -> None:
    """Who finds it off by hand and goes back must not get the same one without the finding."""
    first = make_file()
    install(first, tmp_path)
    note_installed(tmp_path, read_calibration(first), [MISSED])
    with raises("nothing-older", InstallError):
        rollback(tmp_path)
    install(second := make_file(0.001), tmp_path)
    note_installed(tmp_path, read_calibration(second), [MISSED])
    assert [g.number for g in installed_versions(tmp_path)] == [1, 2, 3, 4]
    assert rollback(tmp_path).number == 2


def test_what_speaks_against_it_beside_its_gates_is_known_before(make_file, tmp_path: Path) -> None:
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


def test_a_withdrawn_one_is_no_measure_for_the_next(make_file, tmp_path: Path) -> None:
    install(make_file(), tmp_path)
    now = installed_calibration(tmp_path)
    vague = tuple(tuple(9 * value for value in row) for row in now.covariance)
    vaguer = msgspec.structs.replace(now, covariance=vague)
    assert objections_beside(vaguer, tmp_path)
    withdraw(tmp_path, "the camera was changed")
    assert objections_beside(vaguer, tmp_path) == []
    assert install(make_file(0.001), tmp_path).change == ""
