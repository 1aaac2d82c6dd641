"""Fixtures every room shares. Real recordings by other people are used where they lie beside the checkout."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

# Before numpy is loaded, as in the programs: the threads of two workers wait for each other most of the time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings

from station.cell.config import ControlPath
from station.devices.ur import library_installed
from station.devices.ur.moves import JOINT_ACCELERATION_LIMIT_RAD_S2, JOINT_SPEED_LIMIT_RAD_S
from station.simulation.launch import AdminClient, SimulatedController, start_controller
from station.simulation.netns import bring_lo_up
from tests.patience import PATIENCE_S

DATASETS = Path(os.environ.get("STATION_DATASETS", Path(__file__).parents[2] / "shared" / "datasets"))

# Hundreds of programs are started: without its byte code each of them compiles the source first.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # behind a shell's `&` programs would ignore it, too
    signal.signal(signal.SIGINT, signal.default_int_handler)
gc.set_threshold(10_000, 20, 20)  # the usual ones go through all that was imported every few tests
for _size in ("COLUMNS", "LINES"):  # a shell may export them: what is printed would break elsewhere
    os.environ.pop(_size, None)

# How long an example takes is no property: a computer may have much else to do.
settings.register_profile(
    "patient", deadline=None, max_examples=50, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("patient")

MAY_BE_SENT = {
    "dashboard: stop", "dashboard: PolyscopeVersion", "dashboard: get serial number",
    "dashboard: get robot model", "dashboard: is in remote control", "dashboard: programState",
    "upload: rtde_control", "upload: station_control",
    "script: movej", "script: stopj", "script: rtde_set_watchdog",
    "script: force_mode_set_gain_scaling", "script: force_mode_set_damping",
}  # fmt: skip
"""Everything a station ever says to a controller; a change here is a change of the safety rules. (The last
two are what ur_rtde's own script does when it starts.)"""

AT_REST_RAD_S = 1e-3
CONTROL_WORDS = {
    "upload": ("upload: rtde_control", "upload: station_control"),
    "move": ("script: movej",),
    "stop": ("script: stopj",),
}
"""How the controller's log names the same thing on the two control paths."""
no_library = pytest.mark.skipif(not library_installed(), reason="ur_rtde is not installed")
CONTROL_PATHS = [pytest.param("ur_rtde", marks=no_library), "script"]


@pytest.fixture(params=CONTROL_PATHS)
def control_path(request: pytest.FixtureRequest) -> ControlPath:
    """Both ways of driving an arm, each in a test of its own."""
    return request.param


def asked(admin: AdminClient, what: str) -> int:
    """Count what a controller was told: a key of its log's counts, or of CONTROL_WORDS."""
    counts = admin.ask("log")["counts"]
    return sum(int(counts.get(word, 0)) for word in CONTROL_WORDS.get(what, (what,)))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--skipped-to", type=Path, help="write the names of the skipped tests into this file")
    parser.addoption("--only-of", type=Path, help="run only the tests that this file names")


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    place: Path | None = config.getoption("--skipped-to")
    if place is not None:
        skipped = terminalreporter.stats.get("skipped", [])
        place.write_text("".join(f"{report.nodeid}\n" for report in skipped))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    place: Path | None = config.getoption("--only-of")
    if place is not None:
        named = set(place.read_text().splitlines())  # a module that was skipped as a whole by its path
        items[:] = [item for item in items if {item.nodeid, item.nodeid.partition("::")[0]} & named]


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any, error: object) -> None:
    """A test process that died says by which signal; xdist itself says only that it is gone."""
    if error is not None:
        process = node.gateway._io.popen
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(PATIENCE_S)
        print(f"\n[{node.gateway.id}] ended with {process.returncode} (negative: killed by that signal)")


@pytest.fixture
def datasets() -> Path:
    """Folder of real recordings; the test is skipped, with the reason, where it is absent."""
    if not os.access(DATASETS, os.R_OK | os.X_OK):
        pytest.skip(f"no real recordings to be read at {DATASETS} (set STATION_DATASETS)")
    return DATASETS


def rests_short_of_its_goal(admin: AdminClient) -> None:
    """By the controller's own account: it was stopped, it did not arrive. How soon: see the benchmarks."""
    goal = [entry["goal"] for entry in admin.ask("log")["entries"] if entry["verb"] == "movej"][-1]
    state = admin.ask("state")
    assert max(map(abs, state["joint_speeds_rad_s"])) < AT_REST_RAD_S
    assert max(abs(a - b) for a, b in zip(state["joints_rad"], goal, strict=True)) > 0.01


def not_allowed(host: str) -> list[object]:
    """What a controller was ever asked that is not on the list, and its moves beyond the caps."""
    with AdminClient(host) as admin:
        log = admin.ask("log")
    foreign = {c for c in log["counts"] if not c.startswith("controller: ")} - MAY_BE_SENT
    limits = {"v": JOINT_SPEED_LIMIT_RAD_S, "a": JOINT_ACCELERATION_LIMIT_RAD_S2}
    moves = [entry for entry in log["entries"] if entry["verb"] == "movej"]
    too_fast = [m for m in moves if any(m[name] > limit + 1e-9 for name, limit in limits.items())]
    return [*sorted(foreign), *too_fast]


def check_allow_list(host: str) -> None:
    assert not not_allowed(host)


@pytest.fixture
def controller() -> Iterator[Callable[..., SimulatedController]]:
    """Starts simulated controllers: `controller("UR10e", time_scale=…)`. All end with the test, and what
    each was asked is held against the list of what a station may say."""
    running: list[SimulatedController] = []

    def start(model: str = "UR10", **options: Any) -> SimulatedController:
        running.append(start_controller(model, **options))
        return running[-1]

    yield start
    try:
        for child in running:
            if child.process.poll() is None:  # a test that ends one itself has looked before
                check_allow_list(child.host)
    finally:
        for child in running:
            child.stop()


@pytest.fixture(scope="module")
def lonely_network() -> Iterator[None]:
    """Only `lo`, for the module that asks and whatever it starts. Skipped where that is not permitted."""
    pytest.importorskip("gi", reason="GenICam cameras need Debian's python3-gi and gir1.2-aravis-0.8")
    libc, new_network = ctypes.CDLL(None, use_errno=True), 0x40000000
    with Path("/proc/thread-self/ns/net").open("rb") as before:
        if libc.unshare(new_network) != 0:
            pytest.skip(f"no network namespace of its own: {os.strerror(ctypes.get_errno())}")
        try:
            bring_lo_up()
            yield
        finally:
            libc.setns(before.fileno(), new_network)
