"""`station plan`: makes, imports, checks and shows pose plans. The arm is never touched."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
import typer
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

from calibrate.files.formatting import WORTH_SAYING
from calibrate.handeye.solution import MEASURED
from recordings.plain_text import printed
from recordings.schema.messages import Mount, Vector6
from station.cell.config import StationConfig
from station.cell.config_file import load_config
from station.cell.errors import ConfigError, LimitError, StationError
from station.cell.layout import CellLayout, cell_geometry, geometry_from, layout_of
from station.cell.limits import PlanCheck, Problem, check_plan
from station.cell.pose_plan import Plan, plan_sha256
from station.cell.socket_folder import default_socket
from station.cli.console import AsJson, Socket, err, out, print_json
from station.operate.motion import status_now
from station.plan.choose import CRITERIA, WITH_TABLE, Aim
from station.plan.files import load_plan, save_plan, taught_plan
from station.plan.planner import make_plan
from station.plan.predict import ArmForecast, forecast_arm, with_forecast
from station.plan.preview import save_picture

SceneName = Literal["paper", "blog", "paper-binned"]
"""Of `station.simulation.truth`, which is loaded only where it is wanted."""
_ASK_S = 3.0
"""A daemon that serves answers within milliseconds, on a busy computer within a second."""
_NOTHING_KNOWN_M = 0.05
"""A larger expected error says no more than that there are too few poses yet."""


def plan_command(
    config: Annotated[
        Path | None, typer.Option(help="The cell's configuration; none: a simulated cell")
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Where plan.yaml goes")] = None,
    check: Annotated[Path | None, typer.Option(help="Check this plan instead of making one")] = None,
    taught: Annotated[
        Path | None, typer.Option(help="Recording whose poses become the plan, e.g. guided by hand")
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(help="Joints where the arm stands, degrees: 0,-90,90,…; without it the arm is asked"),
    ] = None,
    poses: Annotated[int, typer.Option(min=3, max=200, help="Poses to plan")] = 25,
    seed: Annotated[int, typer.Option(help="The same seed gives the same plan")] = 0,
    scene: Annotated[SceneName, typer.Option(help="Simulated cell")] = "paper",
    socket: Socket = None,
    purpose: Annotated[
        Aim, typer.Option("--for", help="arm: its table too; both: board and lens too")
    ] = "camera",
    picture: Annotated[Path | None, typer.Option(help="Save a picture of the plan (png, svg, pdf)")] = None,
    as_json: AsJson = False,
) -> None:
    """Make a pose plan, or check one. Nothing moves.

    The file holds radians and metres and may be edited; then `--check` it. Next: `station capture --plan
    plan.yaml`.

    Exit codes: 0 it may be run, 1 the check lists what is wrong, 2 usage or configuration.
    """
    if output is not None and check is None:
        _require_replaceable(output)
    cell, standing = _cell(config, scene, start)
    if config is not None and standing is None:
        standing = asked_standing(cell, socket or default_socket())
    criterion = CRITERIA[purpose]
    plan = _given(cell, check, taught)
    if plan is None:
        with _progress(quiet=as_json) as report:
            plan = make_plan(
                cell, start_joints_rad=standing, seed=seed, count=poses, criterion=criterion, progress=report
            )
    geometry = cell_geometry(cell) if standing is None else geometry_from(cell, standing)
    outcome = check_plan(plan, standing, geometry)
    shown = _scene(cell, needed=picture is not None)
    told, cut = (plan, ()) if shown is None else with_forecast(shown, plan)
    if check is None:
        plan = told
        if output is not None:
            save_plan(plan, output)
    arm = None
    if shown is not None and criterion in WITH_TABLE:
        arm = forecast_arm(shown, plan)
    if shown is not None and picture is not None:
        save_picture(shown, plan, picture)
    if as_json:
        print_json(_summary(plan, told, outcome, arm))
    else:
        _show(told, outcome, cut, output if check is None else None, cell.capture.goal_m)
        if arm is not None:
            _show_arm(arm)
    if outcome.problems:
        raise typer.Exit(LimitError.exit_code)


def _show_arm(arm: ArmForecast) -> None:
    out.print(
        f"with the arm's table from these poses a point is placed to about {1000 * arm.with_table_m:.2f} mm "
        "(1σ) over the workspace, if corners, board and arm are as good as assumed"
    )
    if arm.if_measured_m < WORTH_SAYING * arm.with_table_m:
        out.print(
            f"a board measured to {MEASURED:.2%} (board: square_tolerance) makes that "
            f"{1000 * arm.if_measured_m:.2f} mm"
        )
    if arm.open:
        out.print(f"these poses tell little of {', '.join(arm.open)}: take more poses, or tilt them more")


def _require_replaceable(output: Path) -> None:
    """A plan may be replaced; anything else that stands there, the configuration say, is left alone."""
    if output.exists():
        try:
            load_plan(output)
        except ConfigError:
            raise ConfigError("target-exists", path=output) from None


def _cell(
    config: Path | None, scene: SceneName, start: str | None
) -> tuple[StationConfig, list[float] | None]:
    """The cell to plan for, and where its arm stands."""
    standing = _joints(start) if start is not None else None
    if config is not None:
        return load_config(config)[0], standing
    # Simulation is loaded only where it is wanted.
    from station.simulation.cells import cell_config, make_cell

    truth = make_cell(scene, 0, "low", "eye-in-hand")
    return cell_config(truth), standing or list(truth.start_joints_rad)


def asked_standing(cell: StationConfig, socket: Path) -> list[float] | None:
    """Joints where the arm stands: by the daemon that serves this cell, else by the arm itself, only reading.

    None, and a line that says so, where neither answers.
    """
    with contextlib.suppress(StationError, OSError, TimeoutError):
        status = asyncio.run(asyncio.wait_for(status_now(socket), _ASK_S))
        ours = (status.cell, status.mount) == (cell.name, cell.mount)
        if ours and status.robot.model == cell.robot.model and status.robot.joints_rad is not None:
            return list(status.robot.joints_rad)
    try:
        return list(asyncio.run(_read_joints(cell)))
    except StationError as problem:
        err.print(
            f"Where the arm stands is not known ({printed(problem)}): the plan begins at its first pose. The "
            "way there is checked before it moves.",
            style="yellow",
        )
        return None


async def _read_joints(cell: StationConfig) -> Vector6:
    """By the read-only half of the driver. Raises RobotError."""
    from station.devices.base import fresh
    from station.devices.rtde import PORT
    from station.devices.ur_link import UrLink
    from station.devices.ur_probe import check_port

    await check_port(cell.robot.host, PORT)
    link = UrLink(cell.robot)
    try:
        await link.connect()
        return (await fresh(link)).joints_rad
    finally:
        await link.close()


def _scene(cell: StationConfig, needed: bool) -> CellLayout | None:
    """The scene to draw and forecast. Checking needs none: None where the configuration says too little."""
    try:
        return layout_of(cell)
    except ConfigError:
        if needed:
            raise
        return None


def _joints(text: str) -> list[float]:
    try:
        degrees = [float(part) for part in text.replace(";", ",").split(",")]
    except ValueError:
        degrees = []
    if len(degrees) != 6 or not np.isfinite(degrees).all():
        raise ConfigError(
            "usage",
            problem=f"--start {text!r} is no posture",
            advice="Give six joint angles in degrees, e.g. 0,-90,90,-90,-90,0.",
        )
    return [float(np.deg2rad(angle)) for angle in degrees]


def _given(
    cell: StationConfig,
    check: Path | None,
    taught: Path | None,
) -> Plan | None:
    """The plan that is there already; None when one is to be made."""
    if check is not None and taught is not None:
        raise ConfigError(
            "usage", problem="--check and --taught exclude each other", advice="Give one of them."
        )
    if check is not None:
        return load_plan(check)
    return None if taught is None else taught_plan(taught, cell.robot.model, cell.mount)


@contextlib.contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[str, float], None]]:
    with Progress(
        TextColumn("{task.description}"), BarColumn(), console=err, transient=True, disable=quiet
    ) as bar:
        task = bar.add_task("planning", total=1.0)

        yield lambda text, done: bar.update(task, description=text, completed=done)


class PlanJson(msgspec.Struct, frozen=True):
    """`station plan --json`"""

    plan_sha256: str
    poses: int
    robot: str
    mount: Mount
    duration_s: float
    path_m: float
    largest_step_rad: float
    top_speed_m_s: float
    expected_sigma_mm: float | None
    note: str
    problems: list[Problem]
    workspace_mm: float | msgspec.UnsetType = msgspec.UNSET
    """With `--for arm` or `both`: 1σ of a point with the arm's table."""
    workspace_if_board_measured_mm: float | msgspec.UnsetType = msgspec.UNSET
    open_parameters: list[str] | msgspec.UnsetType = msgspec.UNSET


def _summary(plan: Plan, told: Plan, outcome: PlanCheck, arm: ArmForecast | None) -> PlanJson:
    """`told`: the plan with its forecast."""
    last = told.poses[-1].predicted_sigma_m
    said = PlanJson(
        plan_sha256=plan_sha256(plan),
        poses=len(plan.poses),
        robot=plan.robot,
        mount=plan.mount,
        duration_s=round(outcome.duration_s, 3),
        path_m=round(outcome.path_m, 4),
        largest_step_rad=round(outcome.largest_step_rad, 4),
        top_speed_m_s=round(outcome.top_speed_m_s, 4),
        expected_sigma_mm=None if last is None else round(1000 * last, 4),
        note=plan.note,
        problems=list(outcome.problems),
    )
    if arm is None:
        return said
    return msgspec.structs.replace(
        said,
        workspace_mm=round(1000 * arm.with_table_m, 4),
        workspace_if_board_measured_mm=round(1000 * arm.if_measured_m, 4),
        open_parameters=list(arm.open),
    )


def _goal_text(plan: Plan, goal_m: float) -> str:
    """A sentence on when the goal of accuracy is reached; empty for plans without a forecast."""
    sigmas = [pose.predicted_sigma_m for pose in plan.poses]
    if not sigmas or sigmas[-1] is None:
        return ""
    reached = (n for n, sigma in enumerate(sigmas, start=1) if sigma is not None and sigma <= goal_m)
    number = next(reached, None)
    goal = f"goal of {1000 * goal_m:.2g} mm (capture.goal_m)"
    if number is not None:
        return f"enough for the {goal} after pose {number}, if corners and arm are as good as assumed"
    if sigmas[-1] >= _NOTHING_KNOWN_M:
        return f"not enough for the {goal}: poses so few or so much alike tell next to nothing"
    more = int(np.ceil(len(sigmas) * (sigmas[-1] / goal_m) ** 2))
    return f"not enough for the {goal}: about {more} poses would be (--poses), or a better camera or arm"


def _show(plan: Plan, outcome: PlanCheck, cut: tuple[str, ...], output: Path | None, goal_m: float) -> None:
    table = Table(box=None, pad_edge=False)
    for heading in ("pose", "move s", "turn °", "margin mm", "σ mm"):
        table.add_column(heading, justify="left" if heading == "pose" else "right", no_wrap=True)
    table.add_column("why")
    for pose, move in zip(plan.poses, outcome.moves, strict=True):
        known = pose.predicted_sigma_m is not None and pose.predicted_sigma_m < _NOTHING_KNOWN_M
        sigma = f"{1000 * (pose.predicted_sigma_m or 0):.2f}" if known else "–"
        table.add_row(
            pose.name,
            f"{move.duration_s:.1f}",
            f"{np.rad2deg(move.step_rad):.0f}",
            f"{1000 * move.margin_m:.0f}",
            sigma,
            pose.why,
        )
    out.print(table)
    out.print(
        f"{len(plan.poses)} poses, {outcome.duration_s:.0f} s of motion over {outcome.path_m:.1f} m, "
        f"at most {outcome.top_speed_m_s:.2f} m/s and {np.rad2deg(outcome.largest_step_rad):.0f}° in one move"
    )
    if expected := _goal_text(plan, goal_m):
        out.print(expected)
    if cut:
        out.print(f"by the initial poses these images cut the board: {', '.join(cut)}")
    if plan.note:
        out.print(f"note: {plan.note}")
    for problem in outcome.problems:
        out.print(Text.assemble(("✗", "red"), f" {problem}"))
    if output is not None:
        out.print(f"written to {output}")
    out.print("check: " + ("FAILED, nothing may move" if outcome.problems else "passed"))
