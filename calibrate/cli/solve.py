"""`calibrate solve | compare`: from a recording to a calibration."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from calibrate.arms.classes import CLASSES_HELP
from calibrate.cli.contracts import CompareJson, SolveJson
from calibrate.cli.inputs import read_board, read_camera, read_limits
from calibrate.cli.output import (
    AsJson,
    OpenReport,
    check_target,
    detection_progress,
    err,
    open_report,
    out,
    print_json,
)
from calibrate.cli.solve_options import (
    BoardFile,
    CameraFile,
    GatesFile,
    MemoryLimit,
    ProfileName,
    Seed,
    TimeLimit,
)
from calibrate.errors import UsageError
from calibrate.files.calibration import write_calibration, write_output
from calibrate.files.formatting import summary
from calibrate.files.install import install_line
from calibrate.handeye.solution import camera_frames
from calibrate.lens.intrinsics import LensModel
from calibrate.pipeline.job import JobOptions, SolvedRecording, prepare_views, solve_recording, solver_options
from calibrate.pipeline.resource_limits import MEMORY_LIMIT_MIB, TIME_LIMIT_S, Limits, bounded
from calibrate.report.page import report_page
from calibrate.results import PeerResult
from recordings.geometry import roll_pitch_yaw

Rec = Annotated[Path, typer.Argument(help="A recording (.mcap) or a session folder", show_default=False)]
GATE_FAILED = 4


def solve(
    recording: Rec,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Default: NAME.calibration.yaml in this folder")
    ] = None,
    as_json: AsJson = False,
    report: Annotated[Path | None, typer.Option(help="Also write the report (HTML)")] = None,
    opened: OpenReport = False,
    profile: ProfileName = "robust",
    seed: Seed = 0,
    board: BoardFile = None,
    square_mm: Annotated[
        float | None, typer.Option("--square-mm", help="Square size that replaces the recorded one")
    ] = None,
    camera: CameraFile = None,
    find_intrinsics: Annotated[
        bool,
        typer.Option("--estimate-intrinsics", help="Estimate the intrinsics even where some are recorded"),
    ] = False,
    lens: Annotated[LensModel, typer.Option("--lens", help="Lens of estimated intrinsics")] = "plumb_bob",
    without: Annotated[
        str, typer.Option(help="Poses to exclude, e.g. 3,7; written to the file, with all views to compare")
    ] = "",
    threads: Annotated[int | None, typer.Option(min=1, help="Threads of the board detection")] = None,
    gates: GatesFile = None,
    working_distance_mm: Annotated[
        float | None, typer.Option(min=1.0, max=1e5, help="Distance of the placed point, mm")
    ] = None,
    robot_accuracy_mm: Annotated[
        float | None, typer.Option(min=0.0, help="Arm without joints: its error, 1σ per axis")
    ] = None,
    robot_accuracy_deg: Annotated[
        float | None, typer.Option(min=0.0, help="The same of its orientation (1 mrad a mm)")
    ] = None,
    arm_class: Annotated[
        str | None,
        typer.Option(help=f"{CLASSES_HELP}. Default: as recorded, else by the model", show_default=False),
    ] = None,
    time_limit_s: TimeLimit = TIME_LIMIT_S,
    memory_limit_mib: MemoryLimit = MEMORY_LIMIT_MIB,
) -> None:
    """Solve a recording and write the calibration file.

    Next: look at the report, then `calibrate install`.
    Exit codes: 0 all gates passed, 4 written, but a gate failed.
    """
    if camera is not None and find_intrinsics:
        why = "--camera fixes the intrinsics, --estimate-intrinsics estimates them"
        raise UsageError("options", why=why, advice="Choose one of them.")
    options = replace(
        _given(board, camera, seed),
        profile=profile,
        square_m=None if square_mm is None else square_mm / 1000,
        lens_model=lens,
        find_intrinsics=find_intrinsics,
        without=_numbers(without),
        threads=threads,
        limits=read_limits(gates),
        working_distance_m=None if working_distance_mm is None else working_distance_mm / 1000,
        robot_accuracy_m=None if robot_accuracy_mm is None else robot_accuracy_mm / 1000,
        robot_accuracy_rad=None if robot_accuracy_deg is None else math.radians(robot_accuracy_deg),
        arm_class=arm_class or "",
    )
    name = Path(os.path.abspath(recording)).name  # noqa: PTH100  (`.` has none, and a link keeps its own)
    target = output or Path(f"{name.removesuffix('.mcap')}.calibration.yaml")
    check_target(target, "calibration")
    if opened and report is None:
        report = target.with_suffix(".html")
    if report is not None:
        check_target(report, "report")
        if os.path.realpath(report) == os.path.realpath(target):
            raise UsageError("target-exists", path=target, by="both calibration and report")
    with bounded(Limits(time_limit_s, memory_limit_mib)), detection_progress() as progress:
        job = solve_recording(recording, options, progress)
    write_calibration(job.calibration, target)
    if report is not None:
        write_output(report, report_page(job).encode())
    if as_json:
        print_json(solve_json(job))
    else:
        out.print(summary(job.calibration))
        out.print(f"Written: {target}" + ("" if report is None else f"  Report: {report}"), soft_wrap=True)
        if job.passed:
            out.print(
                f"Next: {install_line(job.calibration.source, target, _root_of(target))}", soft_wrap=True
            )
    if opened and report is not None:
        open_report(report, err)
    if not job.passed:
        raise typer.Exit(GATE_FAILED)


def _given(board: Path | None, camera: Path | None, seed: int) -> JobOptions:
    """Options with the board and the lens of files, where some are named."""
    model, sigma = (None, {}) if camera is None else read_camera(camera)
    spec = None if board is None else read_board(board)
    return JobOptions(seed=seed, board=spec, camera=model, camera_sigma=sigma)


def _numbers(words: str) -> tuple[int, ...]:
    try:
        return tuple(sorted({int(word) for word in words.split(",") if word}))
    except ValueError:
        raise typer.BadParameter(f"--without {words}: give pose numbers, e.g. 3,7") from None


def solve_json(job: SolvedRecording) -> SolveJson:
    """Build the object that `calibrate solve --json` prints: the file's structs, side by side."""
    found = job.calibration
    quality = found.quality
    return SolveJson(
        mount=found.mount,
        result=found.result,
        sigma=found.sigma,
        covariance=found.covariance,
        views=found.views,
        intrinsics=found.intrinsics,
        holdout=quality.holdout,
        certificate=quality.certificate,
        gates=quality.gates,
        verdict="pass" if job.passed else "fail",
        warnings=quality.remarks,
        cross_validation=quality.cross_validation,
        board=quality.board,
        session=quality.session,
        arm=quality.arm,
        arm_table=found.arm_table,
        excluded=found.excluded,
        solve_ms=job.solve_ms,
    )


def _root_of(target: Path) -> Path | None:
    """The state folder of a session's calibration; None: it lies elsewhere."""
    sessions = target.resolve().parent.parent
    return sessions.parent if sessions.name == "sessions" else None


def compare(
    recording: Rec,
    board: BoardFile = None,
    camera: CameraFile = None,
    seed: Seed = 0,
    as_json: AsJson = False,
) -> None:
    """Compare all methods on the same views.

    e_t, e_R: held-out error; spread: of the board's pose over the views; px: reprojection error; σ from ours:
    distance to the result of `solve`, in its own standard uncertainties. Nothing is written.
    """
    from calibrate.handeye.peers import compare_all

    options = _given(board, camera, seed)
    with bounded(), detection_progress() as progress:
        prepared = prepare_views(recording, options, progress)
        results = compare_all(prepared.views, solver_options(options, prepared))
    if as_json:
        views = [view.index for view in prepared.views]
        print_json(CompareJson(prepared.views.mount, views, results))
        return
    table = Table(*_PEER_HEAD, box=None)
    for peer in results:
        table.add_row(*_peer_cells(peer))
    out.print(table)
    out.print(f"\nX, {' from '.join(camera_frames(prepared.views.mount))}:")
    out.print(_table_of_X(results))


_PEER_HEAD = ("method", "e_t mm", "e_R", "spread mm", "spread °", "px", "σ from ours", "ms", "")


def _peer_cells(peer: PeerResult) -> tuple[str, ...]:
    """Make the cells of a method's row below `_PEER_HEAD`."""
    numbers = (
        (peer.e_t_m, 1e3, 3),
        (peer.e_R, 1.0, 5),
        (peer.board_spread_m, 1e3, 3),
        (peer.board_spread_rad, float(np.degrees(1)), 4),
        (peer.reprojection_px, 1.0, 3),
        (peer.distance_sigma, 1.0, 1),
        (peer.time_ms, 1.0, 1),
    )
    cells = ("–" if value is None else f"{value * factor:.{digits}f}" for value, factor, digits in numbers)
    return (peer.name, *cells, peer.note)


def _table_of_X(results: list[PeerResult]) -> Table:
    """Translation, and rotation about fixed axes, as `show` writes them."""
    table = Table("method", "x mm", "y mm", "z mm", "roll °", "pitch °", "yaw °", box=None)
    for peer in results:
        if peer.matrix is None:
            table.add_row(peer.name, "-")
            continue
        turn = [f"{v:.4f}" for v in np.degrees(roll_pitch_yaw(peer.matrix[:3, :3]))] if peer.rigid else ["-"]
        table.add_row(peer.name, *(f"{1e3 * v:.3f}" for v in peer.matrix[:3, 3]), *turn)
    return table
