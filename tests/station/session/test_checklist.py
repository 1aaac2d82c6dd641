"""`station doctor`: what is missing is named with what to do."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import pytest

from station.devices.ur_dashboard import Dashboard, DashboardError
from station.protocol.verbs import Check
from station.session.checklist import checklist
from station.simulation.launch import SimulatedController
from tests.station.session_rig import Rig


async def robot_check(rig: Rig, host: str) -> Check:
    cell = rig.session.context.cell
    config = msgspec.structs.replace(cell.config, robot=msgspec.structs.replace(cell.config.robot, host=host))
    object.__setattr__(cell, "config", config)
    return (await checklist(rig.session.context, {}))[0]


async def test_a_robot_that_is_there_is_ok(rig: Rig) -> None:
    assert (await robot_check(rig, "127.0.0.1")).state == "ok"


@pytest.mark.parametrize(
    ("path", "source", "installed", "state"),
    [
        ("ur_rtde", "real", True, "ok"),
        ("ur_rtde", "real", False, "failed"),
        ("script", "real", False, "warning"),  # not yet accepted
        ("script", "simulated", False, "ok"),
        ("", "playback", False, "skipped"),
    ],
)
async def test_what_drives_the_arm_is_said(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, path: str, source: str, installed: bool, state: str
) -> None:
    monkeypatch.setattr("station.devices.ur.library_installed", lambda: installed)
    rig.arm.control_path = path
    object.__setattr__(rig.session.context.cell, "source", source)
    found = next(c for c in await checklist(rig.session.context, {}) if c.name == "control")
    assert found.state == state and bool(found.remedy) == (state in ("failed", "warning"))


@pytest.mark.parametrize(
    ("host", "remedy"),
    [
        ("", "give robot.host in the configuration"),
        (
            "127.77.1.9",
            "is the robot on, its network cable plugged in, and robot.host (127.77.1.9) its address?",
        ),
    ],
)
async def test_where_nothing_answers_the_remedy_is_one_sentence(rig: Rig, host: str, remedy: str) -> None:
    rig.arm.stale = True
    found = await robot_check(rig, host)
    assert (found.state, found.remedy) == ("failed", remedy)


async def test_the_size_of_the_camera_is_that_of_its_pictures_not_of_the_preview(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def settings() -> dict[str, object]:
        return {"region": [0, 0, 1280, 1024]}

    monkeypatch.setattr(rig.camera, "preview", rig.camera.glimpse)
    said = {check.name: check.text for check in await checklist(rig.session.context, {})}
    assert said["camera"].endswith("80×64")  # a camera that tells no more
    monkeypatch.setattr(rig.camera, "settings", settings)
    said = {check.name: check.text for check in await checklist(rig.session.context, {})}
    assert said["camera"].endswith("1280×1024")


async def test_what_the_network_says_is_said_in_words() -> None:
    with pytest.raises(DashboardError) as refused:
        await Dashboard.open("127.77.1.9")
    said = str(refused.value)
    assert said.startswith("dashboard of 127.77.1.9 (port 29999): Connection refused")
    assert "Dashboard Server" in said and "Settings → Security → Services" in said


@pytest.mark.process
async def test_a_robot_that_only_lacks_its_stream_is_told_by_name(
    rig: Rig, controller: Callable[..., SimulatedController]
) -> None:
    rig.arm.stale = True
    running = controller("UR10e")
    assert f"UR10e 20263000001 answers at {running.host}" in (await robot_check(rig, running.host)).remedy
