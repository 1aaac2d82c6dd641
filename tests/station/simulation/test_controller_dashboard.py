"""The dashboard's words, and a bare line on a script port."""

from __future__ import annotations

import socket

import pytest

from station.simulation.controller.dashboard import GREETING, LOCAL_REFUSAL

pytestmark = pytest.mark.process


def dashboard(host: str, *commands: str) -> list[str]:
    """Greeting and one reply per command."""
    with socket.create_connection((host, 29999), 3) as link, link.makefile("rw", newline="\n") as lines:
        replies = [lines.readline().strip()]
        for command in commands:
            lines.write(command + "\n")
            lines.flush()
            replies.append(lines.readline().strip())
    return replies


def test_replies_of_the_dashboard(controller) -> None:
    questions = {
        "PolyscopeVersion": "URSoftware 3.15.8.106339 (Mar 31 2020)",
        "get serial number": "20263000001",
        "get robot model": "UR10",
        "programState": "STOPPED <unnamed>",
        "stop": "Stopped",
        "power on": "could not understand: power on: not supported by this simulator",
        (no := "unlock protective stop"): f"could not understand: {no}: not supported by this simulator",
        "is in remote control": "could not understand: is in remote control",
    }
    assert dashboard(controller("UR10").host, *questions) == [GREETING, *questions.values()]


def test_e_series_in_local_control_refuses_stop_and_remote_control_frees_the_next_connection_only(
    controller,
) -> None:
    running = controller("UR10e", options=("--local",))
    replies = dashboard(running.host, "is in remote control", "PolyscopeVersion", "stop")
    assert replies[1] == "false" and "5.11.1.108318" in replies[2] and replies[3] == LOCAL_REFUSAL
    with (
        socket.create_connection((running.host, 29999), 3) as link,
        link.makefile("rw", newline="\n") as lines,
        running.admin() as admin,
    ):
        lines.readline()
        admin.ask("remote", on=True)
        lines.write("stop\n")
        lines.flush()
        assert lines.readline().strip() == LOCAL_REFUSAL
    assert dashboard(running.host, "stop")[1] == "Stopped"
