"""A small machine of its own: systemd as the first process of a container that borrows this one's /usr.

Needs root, `systemd-nspawn` (Debian: systemd-container) and a cgroup2 mount; no image is downloaded. The
network is this machine's, so that a test's simulated controller is reached on its loopback address.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from tests.patience import PATIENCE_S, wait_until

REPOSITORY = Path(__file__).parents[2]
PREFIX = Path("/opt/station")
CHECKOUT, VENV = Path("/opt/checkout"), Path("/opt/venv")
FOLDERS = ("usr", "etc", "var/lib", "var/tmp", "run", "tmp", "dev", "proc", "sys", "opt/checkout", "opt/venv")
_OWN_ETC = ("passwd", "group", "nsswitch.conf", "ld.so.conf", "ld.so.conf.d", "ld.so.cache", "alternatives")


class CannotBootError(Exception):
    """Why no systemd runs here."""


def _cgroup2() -> Path:
    for line in Path("/proc/self/mounts").read_text().splitlines():
        _, place, kind, *_ = line.split()
        if kind == "cgroup2" and os.access(place, os.W_OK):
            return Path(place)
    raise CannotBootError("no writable cgroup2 mount")


class Machine:
    """Boots at once; `end` switches it off. Raises CannotBootError."""

    def __init__(self, folder: Path) -> None:
        if os.geteuid() != 0 or not shutil.which("systemd-nspawn"):
            raise CannotBootError("starting units for real needs root and systemd-nspawn")
        if not sys.base_prefix.startswith("/usr"):
            raise CannotBootError(f"the interpreter lies in {sys.base_prefix}, which the container lacks")
        self.root, self._log = folder / "root", folder / "boot.log"
        self._group = _cgroup2() / f"station-test-{os.getpid()}"
        self._furnish()
        self._boot()

    def _furnish(self) -> None:
        """Empty folders, this machine's users, and the station as `make install` would leave it."""
        for name in FOLDERS:
            (self.root / name).mkdir(parents=True)
        for path in (self.root, *self.root.parents):  # the station's user has to pass through its /
            if path.stat().st_uid == os.getuid() and path.is_relative_to(self._log.parent):
                path.chmod(0o755)
        for name in ("bin", "sbin", "lib", "lib64"):
            (self.root / name).symlink_to(f"usr/{name}")
        for name in _OWN_ETC:
            subprocess.run(["cp", "-a", f"/etc/{name}", str(self.root / "etc")], check=True)
        (self.root / "etc/os-release").write_text("ID=test\n")
        (self.root / "etc/machine-id").touch()
        make = ["make", "-C", str(REPOSITORY), "install-files", f"DESTDIR={self.root}", f"PREFIX={PREFIX}"]
        subprocess.run(make, check=True, capture_output=True)
        self.furnish_programs()

    def furnish_programs(self) -> None:
        """Stand-ins for the installed programs, which run this checkout."""
        programs = self.root / PREFIX.relative_to("/") / "bin"
        programs.mkdir(parents=True, exist_ok=True)
        for name in ("station", "calibrate"):
            words = f'#!/bin/sh\nPYTHONPATH={CHECKOUT} exec {VENV}/bin/python -m {name}.cli "$@"\n'
            (programs / name).write_text(words)
            (programs / name).chmod(0o755)

    def _boot(self) -> None:
        self._group.mkdir()
        enter = f'echo $$ > {self._group}/cgroup.procs && exec "$@"'
        command = ["systemd-nspawn", "--quiet", "--directory", str(self.root), "--machine", self._group.name]
        command += ["--register=no", "--keep-unit", "--console=pipe", "--bind-ro=/usr"]
        command += [f"--bind-ro={REPOSITORY}:{CHECKOUT}", f"--bind-ro={sys.prefix}:{VENV}"]
        command += ["--boot"]
        with self._log.open("wb") as words:
            self._nspawn = subprocess.Popen(
                ["sh", "-c", enter, "sh", *command, "--", "--unit=basic.target"],
                stdin=subprocess.DEVNULL,
                stdout=words,
                stderr=words,
                env=os.environ | {"SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1"},
            )
        try:
            self.until(lambda: self._leader() is not None and self._up())
        except AssertionError:
            said = self._log.read_text()[-500:]
            self.end()
            raise CannotBootError(f"systemd did not come up in a container: {said}") from None

    def _leader(self) -> int | None:
        """systemd's process id as this machine sees it: nspawn's child."""
        pid = self._nspawn.pid
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        return int(children[0]) if children else None

    def _up(self) -> bool:
        return self.run("systemctl", "is-active", "basic.target", check=False).strip() == "active"

    def until(self, condition: Callable[[], object]) -> None:
        def holds() -> object:
            assert self._nspawn.poll() is None, "the machine ended"
            with contextlib.suppress(OSError):
                return condition()
            return False

        wait_until(holds)

    def run(self, *command: str, check: bool = True) -> str:
        """Run a command in the container; give what it prints."""
        enter = ["nsenter", "--target", str(self._leader()), "--all"]
        done = subprocess.run([*enter, *command], capture_output=True, text=True, timeout=PATIENCE_S)
        assert done.returncode == 0 or not check, f"{command}: {done.stdout}{done.stderr}\n{self.journal()}"
        return done.stdout

    @contextlib.contextmanager
    def running(self, *command: str) -> Iterator[IO[str]]:
        """Run a command in the container until its input ends; give what it prints."""
        enter = ["nsenter", "--target", str(self._leader()), "--all"]
        pipe = subprocess.PIPE
        with subprocess.Popen([*enter, *command], stdin=pipe, stdout=pipe, text=True) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            yield process.stdout
            process.stdin.close()
            process.wait(PATIENCE_S)

    def journal(self) -> str:
        return self.run("journalctl", "--no-pager", "--lines=60", check=False)

    def show(self, unit: str, name: str) -> str:
        """A property of a unit."""
        return self.run("systemctl", "show", unit, "--property", name, "--value").strip()

    def path(self, inside: str | Path) -> Path:
        """A file of the container as it is reached from here, its /run included."""
        return Path(f"/proc/{self._leader()}/root") / Path(inside).relative_to("/")

    def drop_in(self, unit: str, *lines: str) -> None:
        """Lines for a unit's [Service], in place of those of the test before."""
        place = self.root / "etc/systemd/system" / f"{unit}.d" / "test.conf"
        place.parent.mkdir(exist_ok=True)
        place.write_text("\n".join(["[Service]", *lines, ""]))
        self.run("systemctl", "daemon-reload")

    def end(self) -> None:
        if self._nspawn.poll() is None:
            self._nspawn.terminate()  # nspawn asks its systemd to switch off
            try:
                self._nspawn.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._nspawn.kill()
                self._nspawn.wait()
        for place in (self._group, *self._group.parents[1].glob(f"*/{self._group.name}")):
            # On an older layout nspawn makes the group in systemd's own hierarchy too.
            for group in sorted(place.rglob("*/"), reverse=True):
                group.rmdir()
            if place.is_dir():
                place.rmdir()
