"""Nothing outside the simulation can unlock, power or reset a robot: it is not even written down."""

from __future__ import annotations

import ast
import re
import socket
from functools import cache
from pathlib import Path

import pytest

from station.devices.ur.dashboard import ALLOWED, PORT, Dashboard
from station.devices.ur.script import SCRIPT_PORT
from station.simulation.launch import start_controller
from tests.conftest import not_allowed
from tests.patience import wait_until

ROOT = Path(__file__).parents[2]
READS_ALONE = "tell_ur.py"
"""Example that only receives: the half of the library that moves nothing, with some calls of equal names."""
DASHBOARD_COMMANDS = {
    "unlock protective stop", "close safety popup", "restart safety", "power on", "power off",
    "brake release", "unlock_protective_stop", "power_on", "power_off", "brake_release",
}  # fmt: skip
LIBRARY_CALLS = {
    "unlockProtectiveStop", "closeSafetyPopup", "restartSafety", "powerOn", "powerOff", "brakeRelease",
    "teachMode", "freedriveMode", "triggerProtectiveStop", "reuploadScript", "reconnect", "setTcp",
    "setPayload", "setSpeedSlider", "sendCustomScript", "sendCustomScriptFunction", "jogStart", "speedJ",
    "speedL", "servoJ", "DashboardClient", "RTDEIOInterface",
}  # fmt: skip
PLAIN = re.compile(
    r"""["'](unlock protective stop|restart safety|power on|power off|brake release)(\\n)?["']"""
)


def sources(pattern: str) -> list[Path]:
    """List what is shipped or started by people; not the simulation, which must know what it must refuse."""
    folders = ["recordings", "calibrate", "station", "systemd", "benchmarks", "docs"]
    found = [p for folder in folders for p in (ROOT / folder).rglob(pattern) if p.is_file()]
    return [p for p in found if ROOT / "station" / "simulation" not in p.parents]


@cache
def trees() -> dict[Path, ast.Module]:
    return {path: ast.parse(path.read_text()) for path in sources("*.py")}


def offences(source: ast.Module) -> list[str]:
    found = []
    for node in ast.walk(source):
        if isinstance(node, ast.Attribute) and node.attr in LIBRARY_CALLS:
            found.append(f"line {node.lineno}: .{node.attr}")
        elif isinstance(node, ast.Name | ast.alias):
            name = node.id if isinstance(node, ast.Name) else node.name
            if name.rpartition(".")[2] in LIBRARY_CALLS:
                found.append(f"{name}")
        elif isinstance(node, ast.Constant) and isinstance(node.value, str | bytes):
            text = node.value.decode("latin-1") if isinstance(node.value, bytes) else node.value
            if text.strip().lower() in DASHBOARD_COMMANDS or text in LIBRARY_CALLS:
                found.append(f"line {node.lineno}: {text!r}")
    return found


def test_no_source_names_a_forbidden_command() -> None:
    assert len(trees()) > 50
    assert {str(p): o for p, tree in trees().items() if (o := offences(tree))} == {}


def test_no_other_file_quotes_one() -> None:
    others = [
        p for kind in ("*.md", "*.yaml", "*.service", "*.sh", "*.tcss", "*.html") for p in sources(kind)
    ]
    assert [p for p in others if PLAIN.search(p.read_text())] == []


@pytest.mark.parametrize(
    "offence",
    [
        "d.powerOn()",
        "send(b'brake release\\n')",
        "ask('unlock protective stop')",
        "from x import DashboardClient",
    ],
)
def test_the_search_finds_what_it_looks_for(offence: str) -> None:
    assert offences(ast.parse(offence))


def test_six_calls_of_the_vendors_library_are_used_and_no_other() -> None:
    control = pytest.importorskip("rtde_control").RTDEControlInterface
    every = {name for name in dir(control) if not name.startswith("_")}
    ours = [tree for path, tree in trees().items() if path.name != READS_ALONE]
    nodes = (node for tree in ours for node in ast.walk(tree))
    used = {node.attr for node in nodes if isinstance(node, ast.Attribute)} & every
    assert used == {"moveJ", "stopJ", "stopScript", "setWatchdog", "kickWatchdog", "getTCPOffset"}


def test_the_vendors_library_has_one_door_and_an_example_that_only_reads() -> None:
    doors = set()
    for path, tree in trees().items():
        for node in ast.walk(tree):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            doors |= {
                (path.name, library)
                for library in (name.split(".")[0] for name in names)
                if library in ("rtde_control", "rtde_receive", "rtde_io")
            }
    assert doors == {("control.py", "rtde_control"), (READS_ALONE, "rtde_receive")}


_JOINTS = "[0, -1.5708, 1.5708, -1.5708, -1.5708, 0.01]"
ORDERS = ["power on", "unlock protective stop", "play", "popup hello"]
LINES = [
    f"movej({_JOINTS}, a=1.5, v=1.06)",
    f"movej({_JOINTS}, a=1.6, v=0.5)",
    f"movep(get_forward_kin({_JOINTS}))",
    f"servoj({_JOINTS})",
    "speedj([0, 0, 0, 0, 0, 0.1], 1, 0.01)",
    "speedl([0, 0, 0.01, 0, 0, 0], 1, 0.01)",
    "freedrive_mode()",
    "force_mode(p[0, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0], [0, 0, -5, 0, 0, 0], 2, [1, 1, 1, 1, 1, 1])",
]


@pytest.mark.process
def test_whatever_else_is_sent_or_moves_an_arm_is_seen() -> None:
    """Also a line of a program that has the right name."""
    with start_controller("UR10e") as running, running.admin() as admin:
        seen = len(not_allowed(running.host))
        assert not seen
        for said in (*LINES, *ORDERS):
            with socket.create_connection((running.host, PORT if said in ORDERS else SCRIPT_PORT), 2) as link:
                if said in ORDERS:
                    link.recv(200)
                    link.sendall(said.encode() + b"\n")
                    link.recv(200)
                else:
                    link.sendall(f"def station_control():\n  {said}\nend\n".encode())
                wait_until(lambda seen=seen: len(not_allowed(running.host)) > seen, said)
            seen = len(not_allowed(running.host))
        assert not [e for e in admin.ask("log")["entries"] if e["verb"] == "syntax error"]


@pytest.mark.parametrize("command", [*sorted(DASHBOARD_COMMANDS), "play", "load x", "shutdown"])
def test_the_dashboard_client_refuses(command: str) -> None:
    assert command not in ALLOWED
    with pytest.raises(ValueError):
        Dashboard.send(object.__new__(Dashboard), command)
