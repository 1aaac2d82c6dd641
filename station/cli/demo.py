"""`station demo`: the whole job on a simulated cell, through the daemon, compared with the truth."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer
from rich.text import Text

from calibrate.files.calibration import Calibration, Sigma, read_calibration
from calibrate.files.formatting import arm_sentences, use_text
from recordings.files import state_root
from recordings.geometry import difference
from recordings.reader import open_recording
from recordings.schema.messages import Matrix4, Mount
from station.cell.errors import ConfigError, StationError
from station.cell.session_folder import CALIBRATION_FILE, REPORT_FILE, solve_arguments
from station.cell.status import StationStatus
from station.cli.console import AsJson, Headless, OpenReport, err, open_report, out, print_json
from station.cli.daemon import own_daemon
from station.cli.session import PosesJson, attended
from station.cli.simulated import GigE, Mounting, Noise, Scene, Seed
from station.protocol.verbs import MakePlan, Purpose
from station.simulation.netns import is_isolated, isolated_command
from station.simulation.truth import CellTruth

PLAN_S = 120.0
_GATE_FAILED = 4


class ErrorJson(msgspec.Struct, frozen=True):
    translation_mm: float
    rotation_deg: float


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
    gates_passed: bool
    approved_again: int
    """How often the command approved the rest again, after robot states that came late."""


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
    opened: OpenReport = False,
    time_scale: Annotated[float, typer.Option(hidden=True)] = 1.0,
) -> None:
    """Run the whole job on a simulated cell: no hardware needed.

    Takes about a minute and ends with the paths of recording, calibration and report. `--open` shows the
    report in a browser. The same cell to play with: `station`.

    Exit codes: 0 done, 1 failed, 3 poses missing, 4 a gate failed.
    """
    if output is not None and output.exists() and not output.is_dir():
        raise ConfigError("not-a-folder", path=output)
    if gige and not is_isolated():
        # Discovery broadcasts on every network: the same command again, where there is only loopback.
        command = isolated_command([sys.executable, "-m", "station.cli", *sys.argv[1:]])
        os.execv(command[0], command)
    folder = output or state_root() / "demo" / time.strftime("%Y%m%d-%H%M%S")
    arguments = ["--seed", str(seed), "--scene", scene, "--mount", mount, "--noise", noise]
    arguments += ["--time-scale", str(time_scale), *(["--gige"] if gige else [])]
    quiet, started_s = headless or as_json, time.monotonic()
    if not quiet:
        err.print(f"SIMULATED cell, seed {seed}: takes about a minute, nothing real moves.", style="dim")
    # A worn arm is worth poses that tell its table from the rest.
    plan = MakePlan(poses, seed, aim="arm" if noise == "high" else "camera")
    served = ["--simulate", "--root", str(folder), *arguments]
    with own_daemon(served, folder / "daemon.log") as socket:
        outcome, approved_again = asyncio.run(_captured(socket, plan, quiet))
    if outcome.session.recording and not quiet:
        err.print("Solving …", style="dim")
    solved, made = _solved(outcome), Path(outcome.session.folder)
    arm = solved.arm_table
    # The camera's true pose is that on the true arm: the X of the corrected one is to be compared with it.
    own, sigma = solved.result, solved.sigma
    if arm is not None and arm.result is not None:
        own, sigma = arm.result, Sigma.of(arm.covariance)
    result = DemoJson(
        seed,
        scene,
        mount,
        noise,
        truth_error=ErrorJson(*truth_error(Path(outcome.session.recording), own.matrix)),
        sigma=sigma,
        poses=PosesJson(len(outcome.session.poses), outcome.session.captured),
        recording=outcome.session.recording,
        calibration=str(made / CALIBRATION_FILE),
        report=str(made / REPORT_FILE),
        gates_passed=all(gate.passed for gate in solved.quality.gates),
        approved_again=approved_again,
    )
    if as_json:
        print_json(result)
    else:
        _show_demo(result, solved, arm is not None and arm.offered, time.monotonic() - started_s)
    if opened:
        open_report(Path(result.report), err)
    if not result.gates_passed:
        raise typer.Exit(_GATE_FAILED)
    if result.poses.captured < result.poses.planned:
        raise typer.Exit(3)


def _show_demo(result: DemoJson, solved: Calibration, arm_is_corrected: bool, duration_s: float) -> None:
    out.print(f"SIMULATED cell, seed {result.seed}: {result.mount}, {result.scene} scene", style="bold")
    off, by_table = result.truth_error, ", by the corrected arm," * arm_is_corrected
    true = (
        f"The true camera pose is known here. The found one{by_table} is off by {off.translation_mm:.3f} mm "
        f"and {off.rotation_deg:.4f}°."
    )
    for sentence in (use_text(solved), true, *arm_sentences(solved)):
        out.print(sentence, soft_wrap=not out.is_terminal)
    verdict = "all gates passed" if result.gates_passed else ("a gate FAILED", "red")
    taken = f"{result.poses.captured} of {result.poses.planned} poses, "
    out.print(Text.assemble(taken, verdict, f", {duration_s:.0f} s in all"))
    if again := result.approved_again:
        out.print(f"approved again by itself {again} time{'s' * (again > 1)}: this computer was busy")
    for name in ("recording", "calibration", "report"):
        out.print(f"{name:<12} {getattr(result, name)}")


async def _captured(socket: Path, plan: MakePlan, quiet: bool) -> tuple[StationStatus, int]:
    """The session at its end, and how often it was approved again."""
    async with attended(socket, headless=True, quiet=quiet) as shell:
        await shell.client.call(plan, timeout_s=PLAN_S)
        return await shell.carry_out(Purpose.RUN), shell.approved_again


def _solved(outcome: StationStatus) -> Calibration:
    """What `calibrate solve` finds in a process of its own, as on an operator's laptop."""
    session, why = outcome.session, outcome.reason or outcome.state.value
    if not session.recording:
        saved = f", saved in {session.folder}" if session.captured else ""
        raise StationError(
            "demo-unfinished", captured=session.captured, poses=len(session.poses), saved=saved, why=why
        )
    command = [sys.executable, "-m", "calibrate.cli", *solve_arguments(session.recording, session.folder)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode not in (0, _GATE_FAILED):
        raise StationError("demo-solve-failed", exit_code=done.returncode, said=done.stderr.strip())
    return read_calibration(Path(session.folder) / CALIBRATION_FILE)


def truth_error(recording: Path, found: Matrix4) -> tuple[float, float]:
    """Distance (mm) and angle (deg) of the found X from the truth that rides in a simulated recording."""
    attachment = open_recording(recording).attachments().get("truth.json")
    if attachment is None:
        raise StationError("not-simulated", path=recording)
    truth = msgspec.json.decode(attachment, type=CellTruth)
    delta = difference(np.array(found), np.array(truth.camera_mount))
    translation_mm = 1000 * float(np.linalg.norm(delta[:3]))
    rotation_deg = float(np.degrees(np.linalg.norm(delta[3:])))
    return round(translation_mm, 4), round(rotation_deg, 5)
