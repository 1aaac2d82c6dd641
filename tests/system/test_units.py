"""The units are valid, closed, and land where `make install` says, in a scratch root."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
UNITS = {"station.service": 2.0, "calibrate@.service": 1.0}
needs_systemd = pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="no systemd-analyze here")


def make(target: str, root: Path) -> None:
    words = [f"DESTDIR={root}", f"SHELL_PYTHON={sys.executable}"]
    subprocess.run(["make", "-C", str(ROOT), target, *words], check=True, capture_output=True, text=True)


@pytest.fixture
def scratch(tmp_path: Path) -> Path:
    """A root with the files installed and stand-ins for the programs."""
    make("install-files", tmp_path)
    for name in ("station", "calibrate"):
        program = tmp_path / "usr/local/bin" / name
        program.parent.mkdir(parents=True, exist_ok=True)
        program.write_text("#!/bin/sh\n")
        program.chmod(0o755)
    return tmp_path


@needs_systemd
@pytest.mark.parametrize("unit", UNITS)
def test_exposure_stays_below_the_limit(scratch: Path, unit: str) -> None:
    path = scratch / "etc/systemd/system" / unit
    done = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", str(path)], capture_output=True, text=True
    )
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", done.stdout)
    assert found, done.stdout + done.stderr
    assert float(found[1]) <= UNITS[unit]


@needs_systemd
@pytest.mark.parametrize("unit", UNITS)
def test_unit_is_valid(scratch: Path, unit: str, tmp_path: Path) -> None:
    text = (scratch / "etc/systemd/system" / unit).read_text()
    assert "@PREFIX@" not in text
    (page,) = re.findall(r"^Documentation=file:(.+)$", text, re.MULTILINE)
    assert (scratch / page.lstrip("/")).is_file()
    # verify looks for the program on this machine: the stand-in takes its place.
    standing_in = text.replace("/usr/local/bin", str(scratch / "usr/local/bin"))
    path = tmp_path / "verify" / unit
    path.parent.mkdir()
    path.write_text(standing_in)
    done = subprocess.run(["systemd-analyze", "verify", str(path)], capture_output=True, text=True)
    complaints = [line for line in done.stderr.splitlines() if Path(unit).stem.rstrip("@") in line]
    assert done.returncode == 0, done.stderr
    assert not complaints


@needs_systemd
def test_users_are_creatable(scratch: Path) -> None:
    done = subprocess.run(
        ["systemd-sysusers", f"--root={scratch}", "--dry-run", str(scratch / "etc/sysusers.d/station.conf")],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def may_stage() -> bool:
    """Tell whether this user may give a program other accounts than this machine's."""
    if not shutil.which("unshare") or not shutil.which("systemd-tmpfiles"):
        return False
    tried = subprocess.run(["unshare", "--mount", "mount", "--bind", "/etc", "/etc"], capture_output=True)
    return tried.returncode == 0


@pytest.mark.skipif(not may_stage(), reason="needs root, unshare and systemd-tmpfiles")
def test_an_installation_over_an_older_one_gives_the_solver_the_sessions_that_are_there() -> None:
    """In a staged root that holds what the older one left: sessions, all of them the daemon's."""
    root = Path(tempfile.mkdtemp(prefix="st-"))
    root.chmod(0o755)  # as /, through which the solver passes
    try:
        make("install-files", root)
        (root / "etc/sysusers.d/station.conf").write_text("g station-operator -\nu station -\n")
        subprocess.run(["systemd-sysusers", f"--root={root}"], check=True)
        accounts = _accounts(root, "passwd")
        session = root / "var/lib/station/sessions/s-1"
        session.mkdir(parents=True)
        recording = session / "session.mcap"
        for file in (recording, session / "calibration.yaml"):
            file.write_text("of before")
            file.chmod(0o640)
        for path in (session.parents[1], session.parent, session, *session.iterdir()):
            os.chown(path, accounts["station"], _accounts(root, "group")["station-operator"])
        session.chmod(0o2770)
        make("install-files", root)
        subprocess.run(["systemd-sysusers", f"--root={root}"], check=True)
        # It looks names up where it runs: there the staged root's accounts take the place of this machine's.
        lent = "".join(f"mount --bind {root}/etc/{name} /etc/{name}; " for name in ("passwd", "group"))
        tmpfiles = f"{lent} exec systemd-tmpfiles --root={root} --create"
        subprocess.run(["unshare", "--mount", "sh", "-ec", tmpfiles], check=True)
        solver = _accounts(root, "passwd")["station-solver"]
        group = _accounts(root, "group")["station-solver"]

        def as_solver(command: str) -> str:
            done = subprocess.run(
                ["sh", "-c", command],
                user=solver, group=group, extra_groups=[], cwd=session, capture_output=True, text=True,
            )  # fmt: skip
            return done.stdout if done.returncode == 0 else "refused"

        assert as_solver("cat session.mcap") == "of before"
        assert as_solver("echo new > new; mv new calibration.yaml; cat calibration.yaml") == "new\n"
        assert as_solver("echo x >> session.mcap") == "refused"
        assert as_solver("mkdir ../s-2") == "refused"
        assert as_solver("mkdir ../../calibrations/x") == "refused"
        result = (session / "calibration.yaml").stat()
        assert result.st_gid == _accounts(root, "group")["station-operator"], "operators read it"
    finally:
        shutil.rmtree(root)


def _accounts(root: Path, file: str) -> dict[str, int]:
    """Name → number, of /etc/passwd or /etc/group of a staged root."""
    lines = (root / "etc" / file).read_text().splitlines()
    return {name: int(number) for name, _, number, *_ in (line.split(":") for line in lines)}


def test_the_solver_is_in_no_group_that_may_ask_the_daemon(scratch: Path) -> None:
    text = (scratch / "etc/systemd/system/calibrate@.service").read_text().splitlines()
    assert "User=station-solver" in text
    assert "Group=station-solver" in text
    users = (scratch / "etc/sysusers.d/station.conf").read_text().splitlines()
    assert not [line for line in users if line.startswith("m station-solver")]


def test_uninstall_removes_all_but_what_is_the_owners(scratch: Path) -> None:
    own = scratch / "etc/station/station.env"
    own.write_text("STATION_CONFIG=/etc/station/mine.yaml\n")
    make("install-files", scratch)
    assert "mine.yaml" in own.read_text()
    make("uninstall", scratch)
    assert [p for p in scratch.rglob("*") if p.is_file()] == [own]


def test_a_crash_loop_ends_and_a_hang_is_noticed(scratch: Path) -> None:
    text = (scratch / "etc/systemd/system/station.service").read_text().splitlines()
    wanted = "StartLimitIntervalSec=60 StartLimitBurst=5 Restart=on-failure WatchdogSec=10 Type=notify"
    for line in wanted.split():
        assert line in text


def test_a_session_is_solved_in_its_own_folder(scratch: Path) -> None:
    """Names of sessions have dashes, which systemd would unescape to slashes in %I."""
    text = (scratch / "etc/systemd/system/calibrate@.service").read_text()
    command = next(line for line in text.splitlines() if line.startswith("ExecStart="))
    assert "%I" not in command
    assert "--output /var/lib/station/sessions/%i/calibration.yaml" in command


def test_an_example_of_a_configuration_is_laid_down_and_is_no_cell_yet(tmp_path: Path) -> None:
    make("install-files", tmp_path)
    folder = tmp_path / "etc/station"
    assert (folder / "station.example.yaml").read_bytes() == (ROOT / "station/example.yaml").read_bytes()
    assert not (folder / "station.yaml").exists(), "a program would serve it"


def test_manual_pages_and_completions_are_laid_down_and_taken_away(tmp_path: Path) -> None:
    make("install-files", tmp_path)
    make("install-shell", tmp_path)
    share = tmp_path / "usr/local/share"
    for name in ("station", "calibrate", "recordings"):
        assert f".TH {name.upper()} 1" in (share / f"man/man1/{name}.1").read_text()
        zsh = (share / f"zsh/site-functions/_{name}").read_text()
        assert zsh.startswith(f"#compdef {name}\n") and zsh.endswith(f"\n_{name}_completion\n")
        fish = (share / f"fish/vendor_completions.d/{name}.fish").read_text()
        assert fish.startswith(f"complete --command {name} ")
    make("uninstall", tmp_path)
    left = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert left == {"etc/station/station.env"}


@pytest.mark.skipif(not shutil.which("bash"), reason="no bash here")
def test_bash_completes_commands_and_options(tmp_path: Path) -> None:
    make("install-shell", tmp_path)
    script = tmp_path / "usr/local/share/bash-completion/completions/station"

    def completed(*words: str) -> list[str]:
        line = f"source {script}; COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; "
        line += '_station_completion station; printf "%s\\n" "${COMPREPLY[@]}"'
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        done = subprocess.run(
            ["bash", "-c", line], capture_output=True, text=True, env=os.environ | {"PATH": path}
        )
        return done.stdout.split()

    assert completed("station", "qu") == ["quit"]
    assert "--json" in completed("station", "quit", "--")
