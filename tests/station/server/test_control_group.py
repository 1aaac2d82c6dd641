"""Which processes belong to a system service, by the lines of /proc/PID/cgroup of many computers."""

from __future__ import annotations

import os

import pytest

from station.server.control_group import service_in, system_service

UNIT = "calibrate@s-1.service"
PERSONS = {
    "login by ssh": "0::/user.slice/user-1000.slice/session-3.scope",
    "terminal of a desktop": "0::/user.slice/user-1000.slice/user@1000.service/app.slice/vte-spawn-1.scope",
    "person's own manager": "0::/user.slice/user-1000.slice/user@1000.service/app.slice/timer.service",
    "tmux started in a login": "0::/user.slice/user-1000.slice/user@1000.service/tmux-spawn-1.scope",
    "container without a user of its own": "0::/machine.slice/libpod-0123.scope/container",
    "docker": "0::/system.slice/docker-0123.scope",
    "login in a container": "0::/machine.slice/m.scope/payload/user.slice/user-0.slice/session-c1.scope",
    "seen from another namespace": "0::/../../user.slice/user-1000.slice/session-3.scope",
    "no systemd, WSL": "0::/",
    "console without PAM": "0::/system.slice/system-getty.slice/getty@tty1.service",
    "serial line without PAM": "0::/system.slice/system-serial\\x2dgetty.slice/serial-getty@ttyS0.service",
    "ssh without PAM": "0::/system.slice/ssh.service",
    "ssh by a socket": "0::/system.slice/system-ssh.slice/ssh@1-192.0.2.1:22-192.0.2.2:40000.service",
    "version 1": "12:cpu:/system.slice/a.service\n1:name=systemd:/user.slice/user-1.slice/session-3.scope",
    "nothing": "",
    "no lines of this kind": "foo",
}
SERVICES = {
    "version 2": f"0::/system.slice/system-calibrate.slice/{UNIT}",
    "version 1": f"4:memory:/\n1:name=systemd:/system.slice/{UNIT}\n",
    "both mounted": f"1:name=systemd:/\n0::/system.slice/{UNIT}",
    "slice of its own": f"0::/lab.slice/lab-night.slice/{UNIT}",
    "in the slice of users": f"0::/user.slice/{UNIT}",
    "groups below it, of a name that it chose": f"0::/system.slice/{UNIT}/user@1000.service/session-1.scope",
    "in a container": f"0::/machine.slice/machine-m.scope/payload/system.slice/{UNIT}",
    "seen from another namespace": f"0::/../{UNIT}",
}


@pytest.mark.parametrize("text", PERSONS.values(), ids=PERSONS)
def test_logins_and_what_nothing_is_known_of_are_no_service(text: str) -> None:
    assert service_in(text.splitlines()) == ""


@pytest.mark.parametrize("text", SERVICES.values(), ids=SERVICES)
def test_a_service_is_named(text: str) -> None:
    assert service_in(text.splitlines()) == UNIT


def test_a_process_that_is_gone_belongs_to_none() -> None:
    child = os.fork()
    if child == 0:
        os._exit(0)
    os.waitpid(child, 0)
    assert system_service(child) == ""
