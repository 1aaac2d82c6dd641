"""Preflight check: what a capture needs, with remedies for what is missing. Read-only."""

from __future__ import annotations

import asyncio
import shutil

from calibrate.boards.model import describe_board
from calibrate.errors import CalibrationError
from calibrate.files.loader import load_installed
from calibrate.files.validity import ValidityState, validity_text
from recordings.plain_text import bytes_text
from station.cell.arm_acceptance import accept_line
from station.cell.errors import CameraError, RobotError, TriggerError
from station.cell.process import GRANT_REAL_TIME, in_real_time
from station.cell.session_folder import require_writable
from station.cell.status import StationState
from station.devices.base import Mover
from station.devices.discovery import USB3_MBIT_S, FoundCamera, UsbCamera, discover, discover_usb
from station.protocol.verbs import Check
from station.session.context import SessionContext
from station.session.threads import ASKED

NOT_ACCEPTED_REMEDY = (
    "run `station accept`, and for the speed that this cell allows `{}`; until then: low speed slider, a "
    "hand on the emergency stop"
)


async def checklist(context: SessionContext, troubles: dict[str, str]) -> list[Check]:
    """Make all checks, in the order in which a person would go through them. `troubles`: device → error."""
    return [
        *await _robot_checks(context, troubles),
        await _camera_check(context, troubles),
        *await _wire_checks(context),
        _trigger_check(context, troubles),
        _computer_check(context),
        Check("board", "ok", describe_board(context.cell.config.board)),
        await ASKED.run(_calibration_check, context),
        await ASKED.run(_disk_check, context),
        _clock_check(context),
    ]


async def _robot_checks(context: SessionContext, troubles: dict[str, str]) -> list[Check]:
    arm, host = context.cell.arm, context.cell.config.robot.host
    try:
        state = arm.state()
    except RobotError as error:
        told = context.cell.mover is None  # its error says it all
        remedy = "" if told else "check that it is on, its network cable, and robot.host"
        return [Check("robot", "failed", troubles.get("robot", str(error)), remedy)]
    identity, condition = arm.identity, arm.condition(state)
    if (mover := context.cell.mover) is None:
        return [
            Check("robot", "ok", f"{identity.model} {identity.serial}".rstrip() + ": its pose is posted"),
            Check("control", "skipped", "a person moves this arm: STOP is on its own pendant"),
        ]
    checks = [
        Check("robot", "ok", f"{identity.model} {identity.serial} at {host}, {condition.mode}"),
        Check("safety", "failed" if condition.held else "ok", condition.safety, condition.held),
    ]
    if mover.remote is False:
        checks.append(Check("remote control", "failed", "local", "switch the pendant to Remote (top right)"))
    else:
        words = "remote" if mover.remote else "this controller has no remote switch"
        checks.append(Check("remote control", "ok", words))
    checks.append(await ASKED.run(_control_check, context, mover))
    return checks


def _control_check(context: SessionContext, mover: Mover) -> Check:
    path, (trouble, remedy) = mover.control_path, mover.control_trouble
    if trouble:
        return Check("control", "failed", trouble, remedy)
    if trouble := context.cell.acceptance_trouble(context.root):
        remedy = NOT_ACCEPTED_REMEDY.format(accept_line(context.cell.speed_limit_m_s))
        return Check("control", "warning", f"{path}, {trouble}", remedy)
    return Check("control", "ok", path) if path else Check("control", "skipped", "no arm moves")


def _computer_check(context: SessionContext) -> Check:
    """Other programs hold up the heartbeat of an arm in motion, unless this program goes before them."""
    if context.cell.mover is None:
        return Check("computer", "skipped", "no arm is moved from here")
    if in_real_time():
        return Check("computer", "ok", "real-time scheduling: other programs do not hold up the arm")
    text = "no real-time scheduling: another program can hold up the heartbeat, and the arm stops"
    if context.cell.source != "real":
        return Check("computer", "skipped", text)
    return Check(
        "computer", "warning", text, f"run it as the service station, or grant it: {GRANT_REAL_TIME}"
    )


async def _camera_check(context: SessionContext, troubles: dict[str, str]) -> Check:
    if "camera" in troubles:
        return Check("camera", "failed", troubles["camera"], "check cable, power and camera.device")
    if context.store.state not in (StationState.IDLE, StationState.DISCONNECTED, StationState.PAUSED):
        return Check("camera", "skipped", "in use")
    camera = context.cell.camera
    try:
        async with asyncio.timeout(6.0):
            await camera.glimpse()
    except (CameraError, TriggerError, TimeoutError) as error:
        return Check("camera", "failed", str(error) or "no answer", "check cable and power of the camera")
    return Check("camera", "ok", f"{camera.identity.model} {camera.identity.serial}")


async def _wire_checks(context: SessionContext) -> list[Check]:
    """Check GenICam cameras connected to this computer, and whether they can be used."""
    if context.cell.config.camera.driver != "aravis":
        return []
    network, usb = await asyncio.gather(ASKED.run(discover), ASKED.run(discover_usb))
    return [
        _listed("network cameras", "no GigE camera answers", [_on_network(context, c) for c in network]),
        _listed("usb cameras", "no USB3 Vision camera", [_on_usb(c) for c in usb]),
    ]


def _listed(name: str, none: str, cameras: list[tuple[str, str]]) -> Check:
    """Make a check of the cameras found, given as (description, remedy or "")."""
    problem = "; ".join(problem for _, problem in cameras if problem)
    text = "; ".join(line for line, _ in cameras)
    return Check(name, "warning" if problem else "ok" if text else "skipped", text or none, problem)


def _on_network(context: SessionContext, camera: FoundCamera) -> tuple[str, str]:
    name, address = f"{camera.model} {camera.serial}", camera.address.partition("/")[0]
    line = f"{name} at {camera.address}, firmware {camera.firmware or 'not told'}"
    if not camera.reachable:
        line += f", not in this computer's network ({camera.seen_from})"
        return line, f"give {name} and this computer addresses and masks of one network"
    if camera.controlled and camera.serial != context.cell.camera.identity.serial:
        line += f", in use by {camera.controlled_from or 'another program'}"
        if context.cell.config.camera.device in ("", camera.serial, address, camera.model):
            return line, f"end the program that has {name}"
    return line, ""


def _on_usb(camera: UsbCamera) -> tuple[str, str]:
    name = f"{camera.model} {camera.serial}"
    line = f"{name} at USB port {camera.port}, {camera.speed_mbit_s:g} Mbit/s, release {camera.firmware}"
    if not camera.permitted:
        return f"{line}, not permitted", f"install systemd/60-station.rules and plug {name} in again"
    if camera.speed_mbit_s < USB3_MBIT_S:
        return line, f"plug {name} into a USB 3 port, with a USB 3 cable"
    return line, ""


def _trigger_check(context: SessionContext, troubles: dict[str, str]) -> Check:
    if context.cell.trigger is None:
        return Check("trigger", "skipped", "none configured: the camera is triggered by software")
    if "trigger" in troubles:
        return Check("trigger", "failed", troubles["trigger"], "check the box's USB cable and trigger.port")
    return Check("trigger", "ok", "answers")


def _calibration_check(context: SessionContext) -> Check:
    """Check that the installed calibration is valid and of this robot and camera."""
    cell = context.cell
    try:
        found = load_installed(
            context.root,
            allow_simulated=True,
            camera=cell.config.camera.name,
            require_valid=False,
            robot_serial=cell.arm.identity.serial,
            camera_serial=cell.camera.identity.serial,
        )
    except CalibrationError as error:
        if error.code == "nothing-installed":
            return Check("calibration", "skipped", "nothing is installed")
        return Check("calibration", "failed", error.text, error.remedy)
    text = f"version {found.version}: {validity_text(found.validity)}"
    if found.validity.state is ValidityState.VALID:
        return Check("calibration", "ok", text)
    return Check("calibration", "warning", text, found.validity.remedy)


def _disk_check(context: SessionContext) -> Check:
    reserve = context.cell.config.capture.free_space_bytes
    try:
        free = shutil.disk_usage(context.root).free
        require_writable(context.root)
    except OSError as error:
        return Check("disk", "failed", f"{context.root}: {error.strerror}", "give --root a writable folder")
    text = f"{bytes_text(free)} free at {context.root}"
    if free < reserve:
        return Check("disk", "failed", text, f"free {bytes_text(reserve - free)}")
    return Check("disk", "ok", text)


def _clock_check(context: SessionContext) -> Check:
    """Check the clocks: `ok` when both are known and their bounds together within the limit for poses."""
    clock, frames = context.cell.arm.clock(), context.cell.camera.timing
    if clock is None or frames is None:
        known = "controller" if clock is not None else "camera" if frames is not None else "neither"
        return Check("clocks", "warning", f"known: {known}", "wait a few seconds and check again")
    bound_s, limit_s = clock.bound_s + frames.bound_s, context.cell.config.capture.time_bound_s
    text = f"controller ±{1000 * clock.bound_s:.2f} ms, frames ±{1000 * frames.bound_s:.2f} ms"
    if frames.impossible:
        text += f", {frames.impossible} impossible stamps"
        remedy = "the camera does not stamp the start of exposure: check its timestamp settings"
        return Check("clocks", "warning", text, remedy)
    if bound_s > limit_s:
        if frames.source != "latched":
            remedy = (
                "this camera's clock cannot be read, so poses would be refused: use a hardware trigger, or "
                f"raise capture.time_bound_s above {bound_s:.3f} (harmless while the arm stands)"
            )
            return Check("clocks", "failed", text, remedy)
        return Check("clocks", "failed", text, "reduce the load of this computer or its network")
    if frames.source == "arrival":
        remedy = "the camera tells no time of its own: harmless while the arm stands"
        return Check("clocks", "warning", text, remedy)
    return Check("clocks", "ok", text)
