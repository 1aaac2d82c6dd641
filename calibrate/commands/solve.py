"""`calibrate solve | compare | report`: from a recording to a calibration."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import typer
from rich.table import Table

from calibrate.bounds import MEMORY_LIMIT_MIB, TIME_LIMIT_S, bounded
from calibrate.calibration import Touch, write_calibration
from calibrate.commands.files import read_board, read_camera
from calibrate.commands.install import Root, history_rows
from calibrate.commands.output import AsJson, check_target, detection_progress, out, print_json
from calibrate.errors import CalibrationError
from calibrate.gates import GateLimits, read_limits
from calibrate.install import load_installed
from calibrate.pipeline import JobOptions, SolvedRecording, prepare_views, solve_recording, solver_options
from calibrate.summary import summary

Rec = Annotated[Path, typer.Argument(help="A recording (.mcap) or a session folder", show_default=False)]
GATE_FAILED = 4


class ProfileName(StrEnum):
    robust = "robust"
    paper = "paper"


class LensName(StrEnum):
    plumb_bob = "plumb_bob"
    rational = "rational_polynomial"
    fisheye = "equidistant"


Profile = Annotated[
    ProfileName, typer.Option(help="robust: the station's; paper: the published method, exactly")
]
Seed = Annotated[int, typer.Option(help="Of every random draw")]
BoardFile = Annotated[
    Path | None, typer.Option("--board", help="YAML of another board than the recorded one")
]
SquareMm = Annotated[float | None, typer.Option("--square-mm", help="Another square size")]
CameraFile = Annotated[
    Path | None, typer.Option("--camera", help="Known lens: camera_info YAML or a calibration file")
]
Find = Annotated[bool, typer.Option("--find-intrinsics", help="Find the lens even where it is recorded")]
LensKind = Annotated[LensName, typer.Option("--lens", help="Model of a lens that has to be found")]
GatesFile = Annotated[Path | None, typer.Option("--gates", help="YAML of other limits")]
Threads = Annotated[int | None, typer.Option(help="For finding boards; the result does not depend on it")]
Distance = Annotated[float | None, typer.Option("--working-distance-mm", help="Where the error is stated")]

TimeLimit = Annotated[float, typer.Option(help="The solve ends with an error after so long; 0: no limit")]
MemoryLimit = Annotated[int, typer.Option(help="… when this process needs so much; 0: no limit")]


def register(app: typer.Typer) -> None:
    app.command("solve")(solve)
    app.command("compare")(compare)
    app.command("report")(report_file)


def job_options(
    profile: ProfileName,
    seed: int,
    board: Path | None,
    square_mm: float | None,
    camera: Path | None,
    find_intrinsics: bool,
    lens: LensName,
    gates: Path | None,
    threads: int | None,
    working_distance_mm: float | None,
) -> JobOptions:
    return JobOptions(
        profile=profile.value,
        seed=seed,
        board=None if board is None else read_board(board),
        square_m=None if square_mm is None else square_mm / 1000,
        camera=None if camera is None else read_camera(camera),
        lens_model=lens.value,
        find_intrinsics=find_intrinsics,
        limits=GateLimits() if gates is None else read_limits(gates),
        working_distance_m=None if working_distance_mm is None else working_distance_mm / 1000,
        threads=threads,
    )


def solve(
    recording: Rec,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Default: NAME.calibration.yaml in this folder")
    ] = None,
    profile: Profile = ProfileName.robust,
    as_json: AsJson = False,
    seed: Seed = 0,
    board: BoardFile = None,
    square_mm: SquareMm = None,
    camera: CameraFile = None,
    find_intrinsics: Find = False,
    lens: LensKind = LensName.plumb_bob,
    gates: GatesFile = None,
    threads: Threads = None,
    working_distance_mm: Distance = None,
    report: Annotated[Path | None, typer.Option(help="Also write the report (HTML)")] = None,
    time_limit_s: TimeLimit = TIME_LIMIT_S,
    memory_limit_mib: MemoryLimit = MEMORY_LIMIT_MIB,
) -> None:
    """Solve a recording and write the calibration file. Exit 4: written, but a gate failed."""
    options = job_options(
        profile, seed, board, square_mm, camera, find_intrinsics, lens, gates, threads, working_distance_mm
    )
    target = output or Path(f"{recording.name.removesuffix('.mcap')}.calibration.yaml")
    check_target(target)
    with bounded(time_limit_s, memory_limit_mib), detection_progress() as progress:
        job = solve_recording(recording, options, progress)
    write_calibration(job.calibration, target)
    if report is not None:
        _write_report(job, report, options)
    if as_json:
        print_json(solve_json(job))
    else:
        out.print(summary(job.calibration))
        out.print(f"written: {target}" + ("" if report is None else f"  report: {report}"))
        if job.passed:
            out.print(f"next: calibrate install {target}")
    if not job.passed:
        raise typer.Exit(GATE_FAILED)


def solve_json(job: SolvedRecording) -> dict[str, Any]:
    """The contract of `calibrate solve --json`."""
    plain = msgspec.to_builtins(job.calibration)
    views, quality, lens = plain["views"], plain["quality"], plain["intrinsics"]
    holdout = quality.get("holdout")
    proof = quality["certificate"]
    return {
        "mount": plain["mount"],
        "result": plain["result"],
        "sigma": plain["sigma"],
        "covariance": plain["covariance"],
        "views": {
            "used": views["used"],
            "rejected": [{"index": r["index"], "reason": r["reason"]} for r in views.get("rejected", [])],
        },
        "intrinsics": {key: lens[key] for key in ("width", "height", "matrix", "distortion", "rms_px")},
        "holdout": None if holdout is None else {"e_t_m": holdout["e_t_m"], "e_R": holdout["e_R"]},
        "certificate": {
            key: proof[key] for key in ("certified", "relative_gap", "objective", "distance_sigma")
        },
        "gates": quality["gates"],
        "solve_ms": sum(job.stage_ms.values()),
    }


def report_file(
    recording: Rec,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Default: NAME.report.html in this folder")
    ] = None,
    profile: Profile = ProfileName.robust,
    seed: Seed = 0,
    board: BoardFile = None,
    square_mm: SquareMm = None,
    camera: CameraFile = None,
    find_intrinsics: Find = False,
    lens: LensKind = LensName.plumb_bob,
    gates: GatesFile = None,
    threads: Threads = None,
    working_distance_mm: Distance = None,
    root: Root = None,
    time_limit_s: TimeLimit = TIME_LIMIT_S,
    memory_limit_mib: MemoryLimit = MEMORY_LIMIT_MIB,
) -> None:
    """Solve a recording again and write its report: one HTML file. With the history of what is installed."""
    options = job_options(
        profile, seed, board, square_mm, camera, find_intrinsics, lens, gates, threads, working_distance_mm
    )
    target = output or Path(f"{recording.name.removesuffix('.mcap')}.report.html")
    with bounded(time_limit_s, memory_limit_mib), detection_progress() as progress:
        job = solve_recording(recording, options, progress)
    _write_report(job, target, options, root)
    out.print(f"written: {target}")


def _write_report(job: SolvedRecording, target: Path, options: JobOptions, root: Path | None = None) -> None:
    from calibrate.peers import compare_all  # like matplotlib, slow to load
    from calibrate.report import write_report

    try:
        peers = compare_all(job.views, solver_options(options, job))
    except CalibrationError:  # the report stands without the comparison
        peers = []
    write_report(job, target, peers, history_rows(root), _touches(job, root))


def _touches(job: SolvedRecording, root: Path | None) -> list[Touch]:
    """What was found by hand with the installed calibration, when it is of this recording."""
    try:
        installed = load_installed(root, allow_simulated=True)
    except CalibrationError:
        return []
    same = installed.provenance.recording_sha256 == job.calibration.provenance.recording_sha256
    return installed.verification if same else []


def compare(
    recording: Rec,
    as_json: AsJson = False,
    seed: Seed = 0,
    board: BoardFile = None,
    square_mm: SquareMm = None,
    camera: CameraFile = None,
    find_intrinsics: Find = False,
    lens: LensKind = LensName.plumb_bob,
    threads: Threads = None,
) -> None:
    """Every method side by side on the same views."""
    from calibrate.peers import compare_all

    options = job_options(
        ProfileName.robust, seed, board, square_mm, camera, find_intrinsics, lens, None, threads, None
    )
    with bounded(), detection_progress() as progress:
        prepared = prepare_views(recording, options, progress)
        results = compare_all(prepared.views, solver_options(options, prepared))
    if as_json:
        print_json(
            {
                "mount": prepared.views.mount,
                "views": [view.index for view in prepared.views],
                "methods": [peer_plain(peer) for peer in results],
            }
        )
        return
    table = Table("method", "e_t mm", "e_R", "spread mm", "spread °", "px", "σ from ours", "ms", "", box=None)
    for peer in results:
        table.add_row(
            peer.name,
            _number(peer.e_t_m, 1e3, 3),
            _number(peer.e_R, 1, 5),
            _number(peer.board_spread_m, 1e3, 3),
            _number(peer.board_spread_rad, float(np.degrees(1)), 4),
            _number(peer.reprojection_px, 1, 3),
            _number(peer.distance_sigma, 1, 1),
            _number(peer.time_ms, 1, 1),
            peer.note,
        )
    out.print(table)


def peer_plain(peer: Any) -> dict[str, Any]:
    plain = {
        key: value.tolist() if isinstance(value, np.ndarray) else value
        for key, value in vars(peer).items()
        if not key.startswith("samples_")
    }
    return {key: float(value) if isinstance(value, np.floating) else value for key, value in plain.items()}


def _number(value: float | None, factor: float, digits: int) -> str:
    return "-" if value is None else f"{value * factor:.{digits}f}"
