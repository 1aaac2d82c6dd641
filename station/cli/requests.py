"""Commands that ask the daemon one thing: state, STOP, pause, finish, retake, skip, quit, doctor."""

from __future__ import annotations

import asyncio
import shlex
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import typer
from rich.text import Text

from station.cell.errors import StationError
from station.cell.socket_folder import default_socket
from station.cell.status import PoseState, PoseStatus, StationState, StationStatus
from station.cli.console import AsJson, Socket, out, print_json
from station.cli.daemon import daemon_process
from station.operate.motion import status_now
from station.protocol.client import ask
from station.protocol.stop_client import stop_and_tell
from station.protocol.verbs import Acknowledge, Check, Doctor, Finish, Pause, Quit, Retake, Skip, Verb

PoseNumber = Annotated[int, typer.Argument(min=1, help="Pose number, from 1.")]
_MARKS = {
    "ok": Text("ok", "green"),
    "warning": Text("WARN", "yellow"),
    "failed": Text("MISSING", "red"),
    "skipped": Text("-"),
}


def status_of(socket: Path | None) -> StationStatus:
    return asyncio.run(status_now(socket or default_socket()))


def status_command(socket: Socket = None, as_json: AsJson = False) -> None:
    """Show what the station is doing.

    Needs no control and works beside any screen. --json: every figure, the unit in its name.
    """
    status = status_of(socket)
    if as_json:
        print_json(status)
        return
    _print_state(status)
    robot, camera, trigger, session = status.robot, status.camera, status.trigger, status.session
    state = robot.condition.safety or ("moved by a person" if robot.by_hand else "not connected")
    words = [f"{robot.model} {state}", robot.not_accepted, robot.notice, session.name]
    if robot.control_path:
        words.append(f"control by {robot.control_path}")
    if session.poses:
        words.append(f"{session.captured} of {len(session.poses)} poses")
    if status.lease.holder:
        words.append(f"control: {status.lease.holder}")
    out.print(", ".join(filter(None, words)))
    if status.services_barred:
        until = "No service may approve motion until a person acknowledges (`station acknowledge`)"
        out.print(f"{until}: {status.services_barred}")
    words = ["camera not connected"]
    if camera.connected:
        words = [camera.model, f"{camera.counts.missing} frames dropped"]
    if trigger.identity:
        words.append(f"trigger {trigger.pulses} pulses, {camera.counts.paired} frames")
    out.print(", ".join(words))
    if session.recording:
        out.print(f"recording {session.recording}")


def _print_state(status: StationStatus) -> None:
    mark = "" if status.source == "real" else f" {status.source.upper()}"
    out.print(Text.assemble((status.state.value, "bold"), f"{mark}  {status.reason}"))


class StopJson(msgspec.Struct, frozen=True):
    """`station stop --json`"""

    outcome: Literal["rests", "moves", "unknown", "silent", "no-daemon", "denied", "untrusted"]
    """rests: confirmed, and the arm rests. With any other press the emergency stop."""
    text: str


def stop_command(socket: Socket = None, as_json: AsJson = False) -> None:
    """Stop the arm now (STOP).

    The emergency stop on the pendant is the safety device. Anyone may stop, at any time. Latched: next look
    at the cell, then `station acknowledge`.

    Exit codes: 0 the station confirmed it and the arm rests; 1 not confirmed: press the emergency stop.
    """
    raise typer.Exit(stop_and_tell(socket or default_socket(), as_json))


class StateJson(msgspec.Struct, frozen=True):
    """`station acknowledge --json`, `station pause --json`, `station finish --json`"""

    state: StationState
    """State after the request; a pose that is under way is taken first."""
    reason: str
    cause: str
    """Code of `reason`, for programs."""
    pending: str
    """What waits for the end of the pose under way; empty: nothing."""
    recording: str
    """Path of the recording that was finished last; empty: none."""


def _tell_state(status: StationStatus, as_json: bool) -> None:
    if as_json:
        pending, recording = status.pending, status.finished.recording
        print_json(StateJson(status.state, status.reason, status.cause, pending, recording))
    else:
        _print_state(status)


def acknowledge_command(socket: Socket = None, as_json: AsJson = False) -> None:
    """Leave `stopped` or `fault` after looking at the cell. Nothing moves.

    For a real arm it needs a person at a terminal: by ssh use `ssh -t HOST station acknowledge`. Until then
    no service may approve motion either, and a restart of the daemon changes nothing.

    Next: `station resume` continues the session, `station finish` finishes it.
    """
    _tell_state(_after(Acknowledge(), socket), as_json)


def pause_command(socket: Socket = None, as_json: AsJson = False) -> None:
    """Pause after the pose under way.

    Anyone may. Next: `station resume` or `finish`.
    """
    ask(socket or default_socket(), Pause())
    if as_json:
        _tell_state(status_of(socket), as_json)
    else:
        out.print("Pauses after this pose. Next: `station resume` or `finish`")


def finish_command(socket: Socket = None, as_json: AsJson = False) -> None:
    """Finish the recording with the poses captured so far.

    A pose under way is captured first. Next: `calibrate solve RECORDING`; `station status` names it.
    """
    status = _after(Finish(), socket)
    _tell_state(status, as_json)
    if status.finished.recording and not as_json:
        out.print(f"recording {status.finished.recording}")


class PoseJson(msgspec.Struct, frozen=True):
    """`station retake --json`, `station skip --json`"""

    pose: int
    """Number of the pose, from 1."""
    state: PoseState
    kept: bool
    """To be captured again: the present image counts until it is replaced."""
    reason: str


def retake_command(pose: PoseNumber, socket: Socket = None, as_json: AsJson = False) -> None:
    """Mark a pose to be captured again by the next run."""
    _tell_pose(_after(Retake(pose - 1), socket), pose, "Next: `station resume`", as_json)


def skip_command(pose: PoseNumber, socket: Socket = None, as_json: AsJson = False) -> None:
    """Leave a pose out, in later runs of the plan too.

    `station retake` brings it back. A pose that has a view keeps it: only its retake is left out.
    """
    _tell_pose(_after(Skip(pose - 1), socket), pose, f"`station retake {pose}` plans it", as_json)


def _after(request: Verb[Any], socket: Path | None) -> StationStatus:
    """Send a request; the status after it."""
    ask(socket or default_socket(), request)
    return status_of(socket)


def _tell_pose(status: StationStatus, number: int, then: str, as_json: bool) -> None:
    poses = (pose for pose in status.session.poses if pose.index == number - 1)
    # In capture by hand a skipped view is gone.
    pose = next(poses, PoseStatus(number - 1, "", state="skipped"))
    if as_json:
        print_json(PoseJson(number, pose.state, pose.kept, pose.reason))
    else:
        out.print(f"pose {number}: {pose.reason}. {then}")


QUIT_S = 8.0
"""Longest wait for the daemon's process to end, which takes 5 s where a disk or a driver hangs."""


class QuitJson(msgspec.Struct, frozen=True):
    """`station quit --json`"""

    pid: int
    """The process that ended."""
    took_s: float


def quit_command(socket: Socket = None, as_json: AsJson = False) -> None:
    """End the station that you started by hand, such as by `station`.

    Refused while a session is not finished, the arm moves, STOP or a fault is not acknowledged, or another
    client has control: it says what to do first. A service ends by `systemctl stop station`.

    Exit codes: 0 it has ended; 1 refused, or it has not ended within 8 s.
    """
    path = socket or default_socket()
    began_s = time.monotonic()
    with daemon_process(path) as daemon:
        ask(path, Quit())
        if not daemon.ended(QUIT_S - (time.monotonic() - began_s)):
            raise StationError("quit-too-late", pid=daemon.pid, waited_s=QUIT_S)
    took_s = time.monotonic() - began_s
    if as_json:
        print_json(QuitJson(daemon.pid, round(took_s, 2)))
    else:
        out.print(f"The station has ended, after {took_s:.1f} s. `station` starts it again.")


class DoctorJson(msgspec.Struct, frozen=True):
    """`station doctor --json`"""

    ok: bool
    checks: list[Check]


def doctor_command(
    socket: Socket = None,
    as_json: AsJson = False,
    config: Annotated[Path | None, typer.Option(help="Only check this configuration; no daemon.")] = None,
    example: Annotated[bool, typer.Option("--example", help="Print a configuration to start from.")] = False,
) -> None:
    """Check what a capture needs; say how to mend what is missing.

    Nothing moves. Without options it asks the daemon. For a new cell: print an example, write the cell into
    it, check it, then `station serve --config station.yaml`.

    Exit codes: 0 all is there, 1 something is missing, 2 the configuration is wrong.
    """
    if example:
        print((Path(__file__).parents[1] / "example.yaml").read_text(), end="")
        return
    checks = _checks_of(config) if config is not None else ask(socket or default_socket(), Doctor())
    good = all(check.state != "failed" for check in checks)
    if as_json:
        print_json(DoctorJson(good, checks))
    else:
        from rich.table import Table

        table = Table(box=None, show_header=False, pad_edge=False)
        for check in checks:
            remedy = f"\n→ {check.remedy}" if check.remedy and check.state != "ok" else ""
            table.add_row(_MARKS[check.state], check.name, f"{check.text}{remedy}")
        out.print(table)
        if config is not None:
            words = f"next: station serve --config {shlex.quote(str(config))}, then station doctor beside it"
            out.print(words)
    if not good:
        raise typer.Exit(1)


def _checks_of(config: Path) -> list[Check]:
    """Check a file: what it is of, and what a planned capture lacks."""
    from station.cell.config_file import load_config, missing_for_capture
    from station.devices.ur import control_path, control_trouble

    found, _ = load_config(config)
    path, by_hand = control_path(found.robot), found.robot.driver == "posted"
    driven = "moved by a person" if by_hand else f"at {found.robot.host}, control by {path}"
    checks = [Check("configuration", "ok", f"{found.robot.model} {driven}, {found.mount}")]
    checks += [Check(lack.where, "failed", lack.text, lack.remedy) for lack in missing_for_capture(found)]
    trouble, remedy = ("", "") if by_hand else control_trouble(path)
    return [*checks, Check("control", "warning", trouble, remedy)] if trouble else checks
