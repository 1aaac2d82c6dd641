"""`station doctor`: what is missing is named with what to do."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from calibrate.files.calibration import write_calibration
from calibrate.files.install import install, set_validity
from calibrate.files.validity import ValidityReason, ValidityState
from recordings.schema.clock_fit import ClockFit
from recordings.schema.messages import TimeSource
from station.cell.status import FrameTiming
from station.devices.discovery import FoundCamera, UsbCamera
from station.protocol.verbs import Check
from station.session.checklist import checklist
from station.simulation.cells import make_cell
from tests.station.calibrated_cell import calibration_of
from tests.station.session_rig import Rig


async def robot_check(rig: Rig) -> Check:
    return (await checklist(rig.session.context, {}))[0]


async def test_a_robot_that_is_there_is_ok(rig: Rig) -> None:
    assert (await robot_check(rig)).state == "ok"


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
    monkeypatch.setattr("station.devices.ur.library_installed", lambda: installed)
    rig.arm.control_path = path
    object.__setattr__(rig.session.context.cell, "source", source)
    found = next(c for c in await checklist(rig.session.context, {}) if c.name == "control")
    assert found.state == state and bool(found.remedy) == (state in ("failed", "warning"))


async def test_without_news_the_driver_says_what_is_missing(rig: Rig) -> None:
    rig.arm.lost = True
    found = await robot_check(rig)
    assert (found.state, found.remedy) == ("failed", "switch it on")


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


@pytest.mark.parametrize(
    ("source", "clock", "bound_s", "impossible", "state"),
    [
        ("latched", True, 0.0005, 0, "ok"),
        ("ptp", True, 0.0005, 0, "ok"),
        ("latched", True, 0.0005, 3, "warning"),
        ("latched", True, 0.009, 0, "ok"),  # a busy computer, within the limit
        ("latched", True, 0.03, 0, "failed"),
        ("arrival", False, 0.0005, 0, "warning"),  # it has no clock: never ok
        ("arrival", False, 0.025, 0, "failed"),
    ],
)
async def test_clocks_are_ok_only_where_frames_have_a_time(
    rig: Rig, source: TimeSource, clock: bool, bound_s: float, impossible: int, state: str
) -> None:
    cell = rig.session.context.cell
    capture = msgspec.structs.replace(cell.config.capture, time_bound_s=0.02)
    object.__setattr__(cell, "config", msgspec.structs.replace(cell.config, capture=capture))
    fit = ClockFit(0.0, 0.0, 0.0, 0.0, 0.0001, 0.0, 60.0)
    rig.arm.clock = lambda: fit  # type: ignore[method-assign]
    rig.camera.timing = FrameTiming(source, bound_s, fit if clock else None, impossible)
    found = next(c for c in await checklist(rig.session.context, {}) if c.name == "clocks")
    assert found.state == state and bool(found.remedy) == (state != "ok")


@pytest.mark.parametrize(
    ("camera", "state"),
    [
        (None, "skipped"),
        (FoundCamera("V", "M", "S", "1", "10.0.0.5/24", "10.0.0.1/24"), "ok"),
        (FoundCamera("V", "M", "S", "1", "10.0.0.5/24", "192.168.1.9/24"), "warning"),
        (FoundCamera("V", "M", "S", "1", "10.0.0.5/32", "10.0.0.1/24"), "warning"),  # its mask is wrong
        (FoundCamera("V", "M", "S", "1", "10.0.0.5/24", "10.0.0.1/24", True, "10.0.0.9"), "warning"),
    ],
)
async def test_a_wrong_mask_and_a_camera_in_use_are_named(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, camera: FoundCamera | None, state: str
) -> None:
    cell = rig.session.context.cell
    wired = msgspec.structs.replace(cell.config.camera, driver="aravis", device="S")
    object.__setattr__(cell, "config", msgspec.structs.replace(cell.config, camera=wired))
    monkeypatch.setattr("station.session.checklist.discover", lambda: [] if camera is None else [camera])
    found = next(c for c in await checklist(rig.session.context, {}) if c.name == "network cameras")
    assert found.state == state and bool(found.remedy) == (state == "warning")


@pytest.mark.parametrize(
    ("camera", "state"),
    [
        (None, "skipped"),
        (UsbCamera("V", "M", "S", "1", "2-1", 5000.0, True), "ok"),
        (UsbCamera("V", "M", "S", "1", "2-1", 480.0, True), "warning"),  # a USB 2 cable or port
        (UsbCamera("V", "M", "S", "1", "2-1", 5000.0, False), "warning"),
    ],
)
async def test_usb_cameras_are_listed_with_what_keeps_one_from_being_used(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, camera: UsbCamera | None, state: str
) -> None:
    cell = rig.session.context.cell
    wired = msgspec.structs.replace(cell.config.camera, driver="aravis", device="S")
    object.__setattr__(cell, "config", msgspec.structs.replace(cell.config, camera=wired))
    monkeypatch.setattr("station.session.checklist.discover", list)
    monkeypatch.setattr("station.session.checklist.discover_usb", lambda: [] if camera is None else [camera])
    found = next(c for c in await checklist(rig.session.context, {}) if c.name == "usb cameras")
    assert found.state == state and bool(found.remedy) == (state == "warning")


@pytest.mark.parametrize(
    ("change", "state"),
    [("", "ok"), ("robot", "warning"), ("camera", "warning"), ("doubt", "warning"), ("damage", "failed")],
)
async def test_what_is_installed_is_of_this_robot_and_camera_and_holds(
    rig: Rig, tmp_path: Path, change: str, state: str
) -> None:
    async def check() -> Check:
        return next(c for c in await checklist(rig.session.context, {}) if c.name == "calibration")

    root, cell = rig.session.context.root, rig.session.context.cell
    assert (await check()).state == "skipped"
    robot, camera = (
        msgspec.structs.replace(
            device.identity, serial="another" if change == name else device.identity.serial
        )
        for name, device in (("robot", cell.robot), ("camera", cell.camera))
    )
    write_calibration(calibration_of(make_cell(), robot, camera), tmp_path / "cell.yaml")
    install(tmp_path / "cell.yaml", root, cell="simulated")
    if change == "doubt":
        set_validity(root, ValidityState.IN_DOUBT, ValidityReason("drift-check"))
    if change == "damage":
        (root / "calibrations/current").resolve().write_text("format: handeye-calibration/1")
    found = await check()
    assert found.state == state and bool(found.remedy) == (state != "ok")
