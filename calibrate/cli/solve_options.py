"""The options that every command which solves shares, written once."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer

from calibrate.cli.files import read_board, read_camera
from calibrate.errors import UsageError
from calibrate.gates import GateLimits, read_limits
from calibrate.handeye.solution import Profile
from calibrate.job import JobOptions
from calibrate.lens.intrinsics import LensModel

ProfileName = Annotated[Profile, typer.Option(help="robust: the station's; paper: the published method")]
Seed = Annotated[int, typer.Option(min=0, help="Random seed")]
BoardFile = Annotated[
    Path | None, typer.Option("--board", help="YAML of a board that replaces the recorded one")
]
SquareMm = Annotated[
    float | None, typer.Option("--square-mm", help="Square size that replaces the recorded one")
]
CameraFile = Annotated[
    Path | None, typer.Option("--camera", help="Fixed intrinsics: camera_info YAML or a calibration file")
]
Find = Annotated[
    bool,
    typer.Option(
        "--estimate-intrinsics",
        "--find-intrinsics",
        help="Estimate the intrinsics even where some are recorded",
    ),
]
LensKind = Annotated[LensModel, typer.Option("--lens", help="Lens model of estimated intrinsics")]
GatesFile = Annotated[Path | None, typer.Option("--gates", help="YAML of other gate limits")]
Without = Annotated[str | None, typer.Option(help="Poses to exclude, e.g. 3,7")]
Threads = Annotated[int | None, typer.Option(min=1, help="Threads of the board detection")]
Distance = Annotated[
    float | None,
    typer.Option("--working-distance-mm", min=1.0, max=1e5, help="Distance for predicted error, mm"),
]
AccuracyMm = Annotated[
    float | None,
    typer.Option("--robot-accuracy-mm", min=0.0, help="Arm without joints: its error, 1σ per axis"),
]
AccuracyDeg = Annotated[
    float | None,
    typer.Option("--robot-accuracy-deg", min=0.0, help="The same of its orientation (1 mrad a mm)"),
]

TimeLimit = Annotated[float, typer.Option(min=0.0, max=1e6, help="Time limit, s (0: none)")]
MemoryLimit = Annotated[int, typer.Option(min=0, max=2**30, help="Memory limit, MiB (0: none)")]


def takes(
    build: Callable[..., object], parameter: str = "options"
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorate a command: the options of `build` replace its `parameter`, which gets what `build` returns."""
    offered = inspect.signature(build, eval_str=True).parameters

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        own = inspect.signature(command, eval_str=True)
        rest = [p for name, p in own.parameters.items() if name != parameter]
        needed = [p for p in rest if p.default is p.empty]
        optional = [p for p in rest if p.default is not p.empty]

        @wraps(command)
        def run(**given: Any) -> Any:
            chosen = {name: given.pop(name) for name in offered if name in given}
            return command(**given, **{parameter: build(**chosen)})

        run.__signature__ = own.replace(  # type: ignore[attr-defined]
            parameters=[*needed, *offered.values(), *optional]
        )
        run.__annotations__ = {p.name: p.annotation for p in [*rest, *offered.values()]}
        return run

    return decorate


def picture_options(
    seed: Seed = 0,
    board: BoardFile = None,
    square_mm: SquareMm = None,
    camera: CameraFile = None,
    find_intrinsics: Find = False,
    lens: LensKind = "plumb_bob",
    without: Without = None,
    threads: Threads = None,
) -> JobOptions:
    """Options of reading images."""
    if camera is not None and find_intrinsics:
        raise UsageError(
            "options",
            why="--camera fixes the intrinsics, --estimate-intrinsics estimates them",
            advice="Choose one of them.",
        )
    model, sigma = (None, {}) if camera is None else read_camera(camera)
    return JobOptions(
        seed=seed,
        board=None if board is None else read_board(board),
        square_m=None if square_mm is None else square_mm / 1000,
        camera=model,
        camera_sigma=sigma,
        lens_model=lens,
        find_intrinsics=find_intrinsics,
        without=() if without is None else _numbers(without),
        threads=threads,
    )


def _numbers(words: str) -> tuple[int, ...]:
    try:
        return tuple(sorted({int(word) for word in words.split(",")}))
    except ValueError:
        raise typer.BadParameter(f"--without {words}: give pose numbers, e.g. 3,7") from None


@takes(picture_options)
def job_options(
    options: JobOptions,
    profile: ProfileName = "robust",
    gates: GatesFile = None,
    working_distance_mm: Distance = None,
    robot_accuracy_mm: AccuracyMm = None,
    robot_accuracy_deg: AccuracyDeg = None,
) -> JobOptions:
    """Add how they are solved and judged."""
    return replace(
        options,
        profile=profile,
        limits=GateLimits() if gates is None else read_limits(gates),
        working_distance_m=None if working_distance_mm is None else working_distance_mm / 1000,
        robot_accuracy_m=None if robot_accuracy_mm is None else robot_accuracy_mm / 1000,
        robot_accuracy_rad=None if robot_accuracy_deg is None else math.radians(robot_accuracy_deg),
    )
