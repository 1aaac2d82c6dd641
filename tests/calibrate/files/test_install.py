"""Old or new, never neither; and only what belongs on this cell."""

from __future__ import annotations

import compileall
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import calibrate
import recordings
from calibrate.cli import main
from calibrate.errors import GateFailedError, InstallError, UsageError
from calibrate.files.calibration import read_calibration
from calibrate.files.install import (
    install,
    install_line,
    installed_calibration,
    rollback,
    undo_line,
    withdraw,
)
from calibrate.files.loader import load_installed
from calibrate.files.versions import installed_versions, read_log
from calibrate.job import SolvedRecording
from calibrate.results import Gate
from tests.codes import raises
from tests.command_line import call


def test_the_next_step_of_a_solve_is_one_that_works() -> None:
    assert install_line("real", Path("c.yaml")) == "calibrate install c.yaml"
    assert install_line("real", Path("my c.yaml")) == "calibrate install 'my c.yaml'"
    again = install_line("simulated", Path("c.yaml"), Path("/r"), "REASON")
    assert again == "calibrate install --cell simulated --root /r --override REASON c.yaml"
    assert install_line("playback", Path("c.yaml")) == (
        "calibrate install --cell simulated --root ROOT c.yaml"
    )


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
        with raises("nothing-older", InstallError) as refused:
            rollback(root, camera=camera)
        assert line not in refused.value.remedy, "it is withdrawn already"
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
    override = installed_calibration(tmp_path / "s").override
    assert override.reason == "line is down, checked with a pointer"
    assert "holdout_share" in override.overridden[0]


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

    monkeypatch.setattr(Path, "exists", refused)  # who runs the tests may be root
    with raises("state-folder", InstallError):
        look(tmp_path)


INSTALL = """
import sys
from pathlib import Path
from calibrate.files.install import install
install(Path(sys.argv[1]), Path(sys.argv[2]))
"""
_SYSCALLS = "openat,write,fsync,rename,renameat,renameat2,symlink,symlinkat,unlink,unlinkat,mkdir,close,flock"


@pytest.mark.process
@pytest.mark.timeout(300)  # strace stops every system call of a dozen starts of Python
@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed")
@pytest.mark.parametrize("points", [2, pytest.param(1000, marks=pytest.mark.soak)])
def test_a_kill_at_any_system_call_leaves_old_or_new(make_file, tmp_path: Path, points: int) -> None:
    """Fault 46: SIGKILL on entry to file system calls between the first and the last touch of the root."""
    old, new = make_file(), make_file(0.001)
    # A module that is compiled in one run and not in the next would shift the places of its system calls.
    for package in (calibrate, recordings):
        compileall.compile_dir(Path(package.__file__).parent, quiet=2)
    template = tmp_path / "template"
    install(old, template)
    results = {name: read_calibration(path) for name, path in (("old", old), ("new", new))}
    calls = _touching_calls(new, template, tmp_path)
    assert len(calls) >= 12
    chosen = {*np.linspace(0, len(calls) - 1, points).astype(int)}
    chosen |= {k for k, (name, _) in enumerate(calls) if name.startswith(("rename", "symlink", "unlink"))}
    calls = [calls[k] for k in sorted(chosen)]
    seen = []
    for name, place in calls:
        root = tmp_path / "kill"
        shutil.copytree(template, root, symlinks=True)
        killed = f"inject={name}:signal=KILL:when={place}"
        inject = ("-o", "/dev/null", "-e", f"trace={_SYSCALLS}", "-e", killed)
        assert _traced(new, root, *inject) != 0, f"{name} {place} was not reached"
        found = installed_calibration(root)
        assert found in results.values(), (name, place)
        seen.append("new" if found == results["new"] else "old")
        (current,) = (g.number for g in installed_versions(root) if g.current)
        assert read_log(root)[-1].generation == current, (name, place)
        assert all(not g.problem for g in installed_versions(root)), (name, place)
        install(new, root)  # what a person does next works
        assert installed_calibration(root) == results["new"]
        shutil.rmtree(root)
    assert seen == sorted(seen, reverse=True), "it went back"
    assert {"old", "new"} == set(seen)


def _traced(new: Path, root: Path, *options: str) -> int:
    command = ["strace", "-f", "-qq", *options, sys.executable, "-c", INSTALL, str(new), str(root)]
    return subprocess.run(command, capture_output=True, timeout=60, check=False).returncode


def _touching_calls(new: Path, template: Path, tmp_path: Path) -> list[tuple[str, int]]:
    """(system call, its how-manieth) for every call of an undisturbed run after it first touches the root."""
    root, trace = tmp_path / "traced", tmp_path / "trace"
    shutil.copytree(template, root, symlinks=True)
    assert _traced(new, root, "-o", str(trace), "-e", f"trace={_SYSCALLS}") == 0
    counts: dict[str, int] = {}
    found: list[tuple[str, int]] = []
    begun = False
    lines = trace.read_text().splitlines()
    last = max(k for k, line in enumerate(lines) if "/current" in line)
    for line in lines[: last + 4]:
        match = re.match(r"\d+ +(\w+)\(", line)
        if match is None:
            continue
        name = match[1]
        counts[name] = counts.get(name, 0) + 1
        begun = begun or f"{root}/calibrations/lock" in line
        if begun and (name != "close" or len(found) % 3 == 0):
            found.append((name, counts[name]))
    shutil.rmtree(root)
    return found


def test_a_much_less_certain_one_replaces_no_better_one_without_a_reason(
    make_file, solved_real: SolvedRecording, tmp_path: Path
) -> None:
    def vaguer(times: float) -> dict[str, Any]:
        return {"covariance": (np.array(solved_real.calibration.covariance) * times**2).tolist()}

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
