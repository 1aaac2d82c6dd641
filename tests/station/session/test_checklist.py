"""`station doctor`: what is missing is named with what to do."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from calibrate.files.calibration import write_calibration
from calibrate.files.install import install, set_validity
from calibrate.files.validity import WITHDRAWN_REMEDY, ValidityReason, ValidityState
from recordings.schema.messages import TimeSource
from station.cell.clock_fit import ClockFit
from station.cell.status import FrameTiming
from station.devices.discovery import FoundCamera, UsbCamera
from station.protocol.verbs import Check
from station.session.checklist import checklist
from station.simulation.cells import make_cell
from tests.station.calibrated_cell import calibration_of
from tests.station.session_rig import Rig


async def check(rig: Rig, name: str) -> Check:
    return next(check for check in await checklist(rig.session.context, {}) if check.name == name)


@pytest.mark.parametrize(
    ("path", "source", "installed", "state"),
    [
        ("ur_rtde", "real", True, "warning"),  # its stops are not accepted
        ("ur_rtde", "real", False, "failed"),
        ("script", "real", False, "warning"),
        ("ur_rtde", "simulated", True, "ok"),
        ("script", "simulated", False, "ok"),
        ("", "playback", False, "skipped"),
    ],
)
async def test_what_drives_the_arm_is_said(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, path: str, source: str, installed: bool, state: str
) -> None:
    monkeypatch.setattr("station.devices.ur.robot.library_installed", lambda: installed)
    rig.arm.control_path = path
    object.__setattr__(rig.session.context.cell, "source", source)
    found = await check(rig, "control")
    assert found.state == state and bool(found.remedy) == (state in ("failed", "warning"))


async def test_without_news_the_driver_says_what_is_missing(rig: Rig) -> None:
    assert (await check(rig, "robot")).state == (await check(rig, "camera")).state == "ok"
    rig.arm.lost = True
    found = await check(rig, "robot")
    assert found.state == "failed" and found.remedy


@pytest.mark.parametrize(
    ("source", "bound_s", "impossible", "state"),
    [
        ("latched", 0.0005, 0, "ok"),
        ("latched", 0.0005, 3, "warning"),
        ("latched", 0.009, 0, "ok"),  # a busy computer, within the limit
        ("latched", 0.03, 0, "failed"),
        ("arrival", 0.0005, 0, "warning"),  # it has no clock: never ok
        ("arrival", 0.025, 0, "failed"),
    ],
)
async def test_clocks_are_ok_only_where_frames_have_a_time(
    rig: Rig, source: TimeSource, bound_s: float, impossible: int, state: str
) -> None:
    rig.configure(capture={"time_bound_s": 0.02})
    rig.arm.clock = lambda: ClockFit(0.0, 0.0, 0.0001)
    rig.camera.timing = FrameTiming(source, bound_s, impossible)
    found = await check(rig, "clocks")
    assert found.state == state and bool(found.remedy) == (state != "ok")


FOUND = FoundCamera("M", "S", "1", "10.0.0.5/24", "10.0.0.1/24")
PLUGGED = UsbCamera("M", "S", "1", "2-1", 5000.0, True)


@pytest.mark.parametrize(
    ("camera", "state"),
    [
        (None, "skipped"),
        (FOUND, "ok"),
        (msgspec.structs.replace(FOUND, seen_from="192.168.1.9/24"), "warning"),
        (msgspec.structs.replace(FOUND, address="10.0.0.5/32"), "warning"),  # its mask is wrong
        (msgspec.structs.replace(FOUND, controlled=True, controlled_from="10.0.0.9"), "warning"),
        (PLUGGED, "ok"),
        (msgspec.structs.replace(PLUGGED, speed_mbit_s=480.0), "warning"),  # a USB 2 cable or port
        (msgspec.structs.replace(PLUGGED, permitted=False), "warning"),
    ],
)
async def test_a_camera_that_is_there_is_listed_with_what_keeps_it_from_being_used(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, camera: FoundCamera | UsbCamera | None, state: str
) -> None:
    rig.configure(camera={"driver": "aravis", "device": "S"})
    for name, kind in (("discover", FoundCamera), ("discover_usb", UsbCamera)):
        there = [camera] if isinstance(camera, kind) else []
        monkeypatch.setattr(f"station.session.checklist.{name}", lambda there=there: there)
    found = await check(rig, "usb cameras" if isinstance(camera, UsbCamera) else "network cameras")
    assert found.state == state and bool(found.remedy) == (state == "warning")


@pytest.mark.parametrize(
    ("change", "state"),
    [
        ("", "ok"),
        ("robot", "warning"),
        ("camera", "warning"),
        ("in-doubt", "warning"),
        ("withdrawn", "warning"),
        ("damage", "failed"),
    ],
)
async def test_what_is_installed_is_of_this_robot_and_camera_and_holds(
    rig: Rig, tmp_path: Path, change: str, state: str
) -> None:
    root, cell = rig.session.context.root, rig.session.context.cell
    assert (await check(rig, "calibration")).state == "skipped"
    robot, camera = (
        msgspec.structs.replace(
            device.identity, serial="another" if change == name else device.identity.serial
        )
        for name, device in (("robot", cell.arm), ("camera", cell.camera))
    )
    write_calibration(calibration_of(make_cell(), robot, camera), tmp_path / "cell.yaml")
    install(tmp_path / "cell.yaml", root, cell="simulated")
    if change in ("in-doubt", "withdrawn"):
        set_validity(root, ValidityState(change), ValidityReason("drift-check"))
    if change == "damage":
        (root / "calibrations/current").resolve().write_text("format: handeye-calibration/1")
    found = await check(rig, "calibration")
    assert (found.remedy == WITHDRAWN_REMEDY) == (change == "withdrawn"), "no check restores it"
    assert found.state == state and bool(found.remedy) == (state != "ok")
