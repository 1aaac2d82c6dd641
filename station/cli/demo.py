"""`station demo`: the whole job on a simulated cell, through the daemon, compared with the truth."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import typer
from rich.table import Table
from rich.text import Text

from calibrate.files.calibration import Calibration, Sigma, read_calibration
from calibrate.files.formatting import arm_sentences
from calibrate.geometry import difference
from calibrate.results import HoldoutScore
from recordings.errors import ErrorReport
from recordings.files import state_root
from recordings.reader import open_recording
from recordings.schema.messages import Matrix4, Mount
from station.cell.errors import ConfigError, StationError
from station.cell.session_folder import CALIBRATION_FILE
from station.cell.status import MotionPreview, StationStatus
from station.cli.attended import SessionProgress
from station.cli.console import AsJson, Headless, err, out, print_json
from station.cli.daemon import own_daemon
from station.cli.session import PosesJson
from station.cli.simulated import Control, GigE, Mounting, Noise, Scene, Seed
from station.operate.motion import carry_out, wait_until_idle
from station.plan.choose import Aim
from station.protocol.client import Client
from station.protocol.verbs import MakePlan, Purpose
from station.simulation.netns import is_isolated, isolated_command
from station.simulation.truth import CellTruth

SOLVE_TIMEOUT_S = 300.0
_GATE_FAILED = 4


class ErrorJson(msgspec.Struct, frozen=True):
    translation_mm: float
    rotation_deg: float


class DemoArmJson(msgspec.Struct, frozen=True):
    offered: bool
    with_table_mm: float | None
    without_table_mm: float | None
    sentences: list[str]


class DemoJson(msgspec.Struct, frozen=True):
    """`station demo --json`"""

    seed: int
    scene: str
    mount: Mount
    noise: str
    truth_error: ErrorJson
    sigma: Sigma
    poses: PosesJson
    recording: str
    calibration: str
    report: str
    holdout: HoldoutScore | None
    gates_passed: bool
    approved_again: int
    """How often the cell approved the rest by itself, after news that came late."""
    arm: DemoArmJson


class DemoError(StationError):
    """A step of the demonstration failed; text and code are that step's own."""

    code = "demo"


def demo_command(
    seed: Seed = 0,
    output: Annotated[Path | None, typer.Option("--out", help="Folder for everything it makes")] = None,
    scene: Scene = "paper",
    mount: Mounting = "eye-in-hand",
    noise: Noise = "low",
    poses: Annotated[int, typer.Option(min=4, max=200, help="Poses to capture")] = 25,
    gige: GigE = False,
    headless: Headless = False,
    as_json: AsJson = False,
    time_scale: Annotated[float, typer.Option(hidden=True)] = 1.0,
    control: Control = None,
) -> None:
    """Run the whole job on a simulated cell and compare with the truth.

    Takes about a minute and ends with the paths of recording, calibration and report (open it in a browser).
    The same cell to play with: `station`.

    Exit codes: 0 done, 1 failed, 3 poses missing, 4 a gate failed.
    """
    if output is not None and output.exists() and not output.is_dir():
        raise ConfigError("not-a-folder", path=output)
    if gige and not is_isolated():
        # Discovery broadcasts on every network: the same command again, where there is only loopback.
        command = isolated_command([sys.executable, "-m", "station.cli", *sys.argv[1:]])
        os.execv(command[0], command)
    folder = output or state_root() / "demo" / time.strftime("%Y%m%d-%H%M%S")
    cell = {"seed": seed, "scene": scene, "mount": mount, "noise": noise}
    arguments = [part for name, value in cell.items() for part in (f"--{name}", str(value))]
    arguments += ["--time-scale", str(time_scale), *(["--gige"] if gige else [])]
    arguments += ["--control", control] if control else []
    progress, started_s = SessionProgress(err, quiet=headless or as_json), time.monotonic()
    result = _run(folder, arguments, poses, seed, progress, cell)
    if as_json:
        print_json(result)
    else:
        _show_demo(result, time.monotonic() - started_s)
    if not result.gates_passed:
        raise typer.Exit(4)
    if result.poses.captured < result.poses.planned:
        raise typer.Exit(3)


def _show_demo(result: DemoJson, duration_s: float) -> None:
    table = Table(title=f"SIMULATED cell, seed {result.seed}: {result.mount}, {result.scene} scene")
    for heading in ("", "translation", "rotation"):
        table.add_column(heading, justify="left" if not heading else "right")
    on_table = ", with the arm's table" if result.arm.offered else ""
    for name, value in (
        (f"error against the truth{on_table}", result.truth_error),
        (f"standard uncertainty{on_table}", result.sigma),
    ):
        table.add_row(name, f"{value.translation_mm:.3f} mm", f"{value.rotation_deg:.4f}°")
    out.print(table)
    verdict = "all gates passed" if result.gates_passed else ("a gate FAILED", "red")
    taken = f"{result.poses.captured} of {result.poses.planned} poses, "
    out.print(Text.assemble(taken, verdict, f", {duration_s:.0f} s in all"))
    if again := result.approved_again:
        out.print(f"approved again by itself {again} time{'s' * (again > 1)}: this computer was busy")
    for name in ("recording", "calibration", "report"):
        out.print(f"{name:<12} {getattr(result, name)}")
    for sentence in result.arm.sentences:
        out.print(sentence)


def _run(
    folder: Path, arguments: list[str], poses: int, seed: int, progress: SessionProgress, cell: dict[str, Any]
) -> DemoJson:
    """Return what `--json` prints. `arguments`: of `station serve`; `cell`: the same. Raises StationError."""
    progress.say(f"starting a simulated cell: {' '.join(arguments)}")
    # A worn arm is worth poses that tell its table from the rest.
    aim: Aim = "arm" if "high" in arguments else "camera"
    with simulated_daemon(folder, arguments) as socket:
        outcome = asyncio.run(_captured(socket, MakePlan(poses, seed, aim=aim), progress))
    if not outcome.session.recording:
        raise unfinished(outcome)
    recording, session = Path(outcome.session.recording), Path(outcome.session.folder)
    calibration, report = session / CALIBRATION_FILE, session / "report.html"
    progress.say("solving the recording, in a process of its own")
    solved = _solve(recording, calibration, report)
    arm = solved.arm_table
    # The camera's true pose is that on the true arm: the X of the corrected one is to be compared with it.
    own, sigma = solved.result, solved.sigma
    if arm is not None and arm.result is not None:
        own, sigma = arm.result, Sigma.of(arm.covariance)
    return DemoJson(
        **cell,
        truth_error=ErrorJson(*truth_error(recording, own.matrix)),
        sigma=sigma,
        poses=PosesJson(len(outcome.session.poses), outcome.session.captured),
        recording=str(recording),
        calibration=str(calibration),
        report=str(report),
        holdout=solved.quality.holdout,
        gates_passed=all(gate.passed for gate in solved.quality.gates),
        approved_again=outcome.session.approved_again,
        arm=DemoArmJson(
            offered=arm is not None and arm.offered,
            with_table_mm=None if arm is None else arm.with_table_mm,
            without_table_mm=None if arm is None else arm.without_table_mm,
            sentences=[*arm_sentences(solved)],
        ),
    )


async def _captured(socket: Path, plan: MakePlan, progress: SessionProgress) -> StationStatus:
    async with Client(socket, "the demo") as client:
        await wait_until_idle(client)
        progress.say(f"planning {plan.poses} poses")
        await client.call(plan, timeout_s=120.0)
        with progress:
            return await carry_out(
                client, Purpose.RUN, approve_simulated, progress, finish_with_loss=True, headless=True
            )


async def approve_simulated(_: MotionPreview) -> bool:
    """Approve a motion of a cell that `simulated_daemon` started: nothing real moves."""
    return True


def simulated_daemon(root: Path, arguments: Sequence[str]) -> AbstractContextManager[Path]:
    """`station serve --simulate` as a child of this process; its socket."""
    root.mkdir(parents=True, exist_ok=True)
    return own_daemon(["--simulate", "--root", str(root), *arguments], root / "daemon.log")


def unfinished(outcome: StationStatus) -> DemoError:
    """Why there is no recording, and where the poses are that were saved."""
    session, why = outcome.session, outcome.reason or outcome.state.value
    saved = f", saved in {session.folder}" if session.captured else ""
    return DemoError(
        "demo-unfinished", captured=session.captured, poses=len(session.poses), saved=saved, why=str(why)
    )


def _solve(recording: Path, calibration: Path, report: Path) -> Calibration:
    """`calibrate solve` in a process of its own, as an operator's laptop would run it."""
    command = [sys.executable, "-m", "calibrate.cli", "solve", str(recording), "--json"]
    command += ["--output", str(calibration), "--report", str(report)]
    try:
        done = subprocess.run(command, capture_output=True, timeout=SOLVE_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        raise DemoError("demo-solve-hangs", limit_s=SOLVE_TIMEOUT_S) from None
    if done.returncode not in (0, _GATE_FAILED):
        try:
            problem = msgspec.json.decode(done.stdout, type=ErrorReport).error
        except msgspec.DecodeError:
            said = done.stderr.decode(errors="replace").strip()
            raise DemoError("demo-solve-failed", exit_code=done.returncode, said=said) from None
        raise DemoError.from_data(problem)
    return read_calibration(calibration)


def truth_error(recording: Path, found: Matrix4) -> tuple[float, float]:
    """Distance (mm) and angle (deg) of the found X from the truth that rides in a simulated recording."""
    attachment = open_recording(recording).attachments().get("truth.json")
    if attachment is None:
        raise DemoError("not-simulated", path=recording)
    truth = msgspec.json.decode(attachment, type=CellTruth)
    delta = difference(np.array(found), np.array(truth.camera_mount))
    translation_mm = 1000 * float(np.linalg.norm(delta[:3]))
    rotation_deg = float(np.degrees(np.linalg.norm(delta[3:])))
    return round(translation_mm, 4), round(rotation_deg, 5)
