"""What lies in the folder of installed calibrations, what reaches the disk when, and what does not fit."""

from __future__ import annotations

import os
import signal
import tempfile
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calibrate.errors import CalibrationFileError, InstallError
from calibrate.files import versions as module
from calibrate.files.calibration import read_calibration
from calibrate.files.install import change_text, install, installed_calibration, rollback
from calibrate.files.versions import installed_versions, read_log
from calibrate.pipeline.job import SolvedRecording
from recordings.files import write_atomically
from tests.calibrate.sessions import shifted
from tests.codes import raises
from tests.durability import disk_order, full


def test_nothing_points_to_a_calibration_before_it_is_on_the_disk(
    make_file, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a power loss at any moment there is the old one or the new one, and its log."""
    root, path = tmp_path / "s", make_file()
    with disk_order(monkeypatch) as order:
        made = install(path, root).path.name
    temporary = order[0].removeprefix("sync ")
    assert order == [
        f"sync {temporary}",
        f"rename {temporary} {made}",
        "sync gen",
        "sync validity.jsonl",
        "sync calibrations",
        "rename current.new current",
        "sync calibrations",
    ]


def test_a_stopped_process_that_installs_is_named_and_not_waited_for(
    make_file, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_LOCK_TRIES", 2)
    (root := tmp_path / "s").mkdir()
    if not (holder := os.fork()):
        with module.locked(root / "calibrations"):
            os.kill(os.getpid(), signal.SIGSTOP)
        os._exit(0)
    try:
        os.waitpid(holder, os.WUNTRACED)
        with raises("install-busy", InstallError) as refused:
            install(make_file(), root)
        assert str(holder) in refused.value.values["holder"]
    finally:
        os.kill(holder, signal.SIGKILL)
        os.waitpid(holder, 0)
    assert install(make_file(), root).current


@pytest.mark.parametrize("what", ["generation", "current"])
def test_what_does_not_read_back_as_written_is_not_installed(
    make_file, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """A disk that says yes and keeps something else."""
    root, old, new = tmp_path / "s", make_file(), make_file(0.001)
    install(old, root)
    if what == "generation":
        write = module.write_atomically
        monkeypatch.setattr(module, "write_atomically", lambda path, content: write(path, content[:-40]))
        with pytest.raises(CalibrationFileError):
            install(new, root)
        assert installed_calibration(root) == read_calibration(old)
    else:
        read = module.read_bounded
        monkeypatch.setattr(
            module, "read_bounded", lambda path: read(path)[: -1 if path.name == "current" else None]
        )
        with raises("read-back", InstallError):
            install(new, root)
    assert len(read_log(root)) == (1 if what == "generation" else 2)


@pytest.mark.parametrize(
    ("fails", "switched"), [("0002-", False), ("validity.jsonl", False), ("calibrations", True)]
)
def test_a_full_disk_says_what_is_installed_now(
    make_file, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: str, switched: bool
) -> None:
    """Once the link is there, the switch has been made."""
    install(make_file(0.0), tmp_path / "root")

    def refused(path: Path, *content: bytes) -> None:
        if path.name.startswith(fails):
            full()
        if content:
            write_atomically(path, *content)

    if fails == "validity.jsonl":
        monkeypatch.setattr("calibrate.files.versions.append_to_log", full)
    monkeypatch.setattr("calibrate.files.versions.write_atomically", refused)
    monkeypatch.setattr("calibrate.files.versions.sync_folder", refused)
    with raises("install-io", InstallError, switched=switched):
        install(make_file(1e-4), tmp_path / "root")
    known = installed_versions(tmp_path / "root")
    assert [g.number for g in known if g.current] == [1 + switched]
    assert len(known) == 1 + switched, "what never was in use is no version"


def test_rollback_passes_over_a_damaged_version(make_file, tmp_path: Path) -> None:
    root = tmp_path / "s"
    for k in range(3):
        install(make_file(0.0001 * k), root)
        (root / "calibrations/gen/0009-notes.yaml").write_text("of another program, and no version")
    middle = installed_versions(root)[1]
    middle.path.write_bytes(middle.path.read_bytes()[:-40])
    with pytest.raises(CalibrationFileError):
        install(middle.path, root)
    assert rollback(root).number == 1
    with raises("damaged-version", InstallError, generation=2):
        rollback(root, to=2)
    assert [(g.number, g.current, bool(g.problem)) for g in installed_versions(root)] == [
        (1, True, False),
        (2, False, True),
        (3, False, False),
    ]


def test_rollback_goes_to_what_was_in_use(make_file, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not to a version that somebody went back from, nor to one whose switch a kill prevented."""
    root = tmp_path / "s"
    for k in range(2):
        install(make_file(0.001 * k), root)
    assert rollback(root).number == 1
    install(make_file(0.002), root)
    assert rollback(root).number == 1
    with monkeypatch.context() as patch:
        patch.setattr(module, "_switch", lambda *_: os.link("here", "nowhere"))
        patch.setattr(Path, "unlink", lambda *_, **__: None)
        with pytest.raises(InstallError):
            install(make_file(0.003), root)
    assert len(installed_versions(root)) == 4
    install(make_file(0.004), root)
    log = read_log(root)
    assert [entry.generation for entry in log] == [1, 2, 1, 3, 1, 5]
    assert [entry.action for entry in log[:3]] == ["install", "install", "rollback"]
    assert log[1].change.startswith("1.000 mm, 0.0000°")
    assert rollback(root).number == 1
    rollback(root, to=3)
    assert rollback(root).number == 1


def test_a_change_is_told_in_millimetres_and_degrees(solved_real: SolvedRecording) -> None:
    before = solved_real.calibration
    after = shifted(before, 0.0, 0.0003, -0.0004, np.radians(0.03), 0.0, np.radians(0.04))
    assert change_text(before, after).startswith("0.500 mm, 0.0500° (")
    assert change_text(None, after) == ""
    fixed = msgspec.structs.replace(after.result, parent_frame="base")
    assert change_text(before, msgspec.structs.replace(after, mount="eye-to-hand", result=fixed)) == ""


@pytest.mark.skipif(os.getuid() != 0, reason="only root can be two operators")
@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_two_operators_of_a_group_share_a_folder(make_file, umask: int) -> None:
    """A folder like /var/lib/station/calibrations: setgid, the group may write."""
    with tempfile.TemporaryDirectory() as place:  # pytest's own folders are for one user
        Path(place).chmod(0o755)
        shared = Path(place) / "s" / "calibrations"
        shared.mkdir(parents=True)
        os.chown(shared, 65531, 65530)
        shared.chmod(0o2775)
        for operator, shift_m in ((65531, 0.0), (65532, 0.001)):
            file = Path(place) / f"{operator}.yaml"
            file.write_bytes(make_file(shift_m).read_bytes())
            file.chmod(0o644)
            child = os.fork()
            if child == 0:
                os.umask(umask)
                os.setgroups([65530])
                os.setgid(operator)
                os.setuid(operator)
                try:
                    install(file, shared.parent)
                    os._exit(0)
                except BaseException as problem:
                    print(problem, flush=True)
                    os._exit(1)
            assert os.waitpid(child, 0)[1] == 0
        assert [version.current for version in installed_versions(shared.parent)] == [False, True]
