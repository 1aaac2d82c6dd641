"""`station plan`: makes, checks and shows pose plans. The arm is never touched."""

from __future__ import annotations

import asyncio
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import typer
from rich.table import Table
from rich.text import Text

from calibrate.files.formatting import predicted_error
from recordings.cli.console import progress_bar
from recordings.schema.messages import Mount
from station.cell.config import StationConfig
from station.cell.config_file import load_config
from station.cell.errors import ConfigError, LimitError, RefusedError, StationError
from station.cell.layout import approval_sha256, cell_geometry, require_kept_clear
from station.cell.limits import PlanCheck, Problem, check_plan
from station.cell.pose_plan import Plan, plan_sha256
from station.cell.socket_folder import default_socket
from station.cli.console import AsJson, Socket, err, out, print_json
from station.operate.goal import above_goal
from station.operate.motion import status_now
from station.plan.choose import CRITERIA, Aim
from station.plan.files import load_plan, save_plan
from station.plan.planner import make_plan

_ASK_S = 3.0
"""A daemon that serves answers within milliseconds, on a busy computer within a second."""


def plan_command(
    config: Annotated[
        Path | None, typer.Option(help="The cell's configuration; none: a simulated cell")
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Where plan.yaml goes")] = None,
    check: Annotated[Path | None, typer.Option(help="Check this plan instead of making one")] = None,
    poses: Annotated[int, typer.Option(min=4, max=200, help="Poses to plan")] = 25,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same plan")] = 0,
    socket: Socket = None,
    purpose: Annotated[Aim, typer.Option("--for", help="arm: its table, too")] = "camera",
    as_json: AsJson = False,
) -> None:
    """Make a pose plan, or check one. Nothing moves.

    The file holds radians and metres and may be edited; then `--check` it. Next: `station capture --plan
    plan.yaml`.

    Exit codes: 0 it may be run, 1 the check lists what is wrong, 2 usage or configuration.
    """
    cell, standing = _simulated() if config is None else _configured(config, socket or default_socket())
    if check is not None:
        require_kept_clear(cell)  # as before every motion
        plan = load_plan(check)
    else:
        if output is not None:
            _require_replaceable(output)
        with nullcontext() if as_json else progress_bar("planning", err) as bar:
            plan = make_plan(
                cell,
                start_joints_rad=standing,
                seed=seed,
                count=poses,
                criterion=CRITERIA[purpose],
                progress=lambda text, done: bar and bar(round(100 * done), 100, text),
            )
        if output is not None:
            save_plan(plan, output)
    if config is None:
        err.print("This is a plan of the SIMULATED cell. Name yours: --config FILE.", style="yellow")
    outcome = check_plan(plan, standing, cell_geometry(cell))
    if as_json:
        print_json(_summary(plan, cell, outcome))
    else:
        _show(plan, outcome, cell.capture.goal_m)
        if output is not None and check is None:
            out.print(f"written to {output}")
        out.print("check: " + ("FAILED, nothing may move" if outcome.problems else "passed"))
    if outcome.problems:
        raise typer.Exit(LimitError.exit_code)


def _require_replaceable(output: Path) -> None:
    """A plan may be replaced; anything else that stands there, the configuration say, is left alone."""
    if output.exists():
        try:
            load_plan(output)
        except ConfigError:
            raise ConfigError("target-exists", path=output) from None


def _simulated() -> tuple[StationConfig, list[float]]:
    """The paper's cell, and where its arm stands."""
    # Simulation is loaded only where it is wanted.
    from station.simulation.cells import cell_config, make_cell

    truth = make_cell("paper", 0, "low", "eye-in-hand")
    return cell_config(truth), list(truth.start_joints_rad)


def _configured(config: Path, socket: Path) -> tuple[StationConfig, list[float] | None]:
    """The cell of a file, and where its arm stands by the daemon that serves it; None: no daemon tells."""
    cell, _ = load_config(config)
    if cell.robot.driver == "posted":
        raise RefusedError("moved-by-hand", robot=cell.robot.model)
    with suppress(StationError, OSError, TimeoutError):
        status = asyncio.run(asyncio.wait_for(status_now(socket), _ASK_S))
        ours = (status.cell, status.mount) == (cell.name, cell.mount)
        if ours and status.robot.model == cell.robot.model and status.robot.joints_rad is not None:
            return cell, list(status.robot.joints_rad)
    err.print(
        "No daemon tells where the arm stands: the plan begins at its first pose. The way there is checked "
        "before it moves.",
        style="yellow",
    )
    return cell, None


class PlanJson(msgspec.Struct, frozen=True):
    """`station plan --json`"""

    plan_sha256: str
    approval_sha256: str
    """Of plan and cell, for `station capture --headless --approve`."""
    poses: int
    robot: str
    mount: Mount
    duration_s: float
    path_m: float
    largest_step_rad: float
    top_speed_m_s: float
    predicted_error_mm: float | None
    """Placed-point error (1σ) after the last pose."""
    floor_mm: float | None
    """Part of it by the arm, its errors and what it does differently each time: no pose lowers it."""
    note: str
    problems: list[Problem]


def _summary(plan: Plan, cell: StationConfig, outcome: PlanCheck) -> PlanJson:
    last = plan.predicted_error_m(-1)
    return PlanJson(
        plan_sha256=plan_sha256(plan),
        approval_sha256=approval_sha256(plan, cell),
        poses=len(plan.poses),
        robot=plan.robot,
        mount=plan.mount,
        duration_s=round(outcome.duration_s, 3),
        path_m=round(outcome.path_m, 4),
        largest_step_rad=round(outcome.largest_step_rad, 4),
        top_speed_m_s=round(outcome.top_speed_m_s, 4),
        predicted_error_mm=None if last is None else round(1000 * last, 4),
        floor_mm=None if plan.floor_m is None else round(1000 * plan.floor_m, 4),
        note=plan.note,
        problems=list(outcome.problems),
    )


def _show(plan: Plan, outcome: PlanCheck, goal_m: float) -> None:
    table = Table(box=None, pad_edge=False)
    for heading in ("pose", "move s", "turn °", "margin mm", "error mm"):
        table.add_column(heading, justify="left" if heading == "pose" else "right", no_wrap=True)
    table.add_column("why")
    for index, (pose, move) in enumerate(zip(plan.poses, outcome.moves, strict=True)):
        error_m = plan.predicted_error_m(index)
        table.add_row(
            pose.name,
            f"{move.duration_s:.1f}",
            f"{np.rad2deg(move.step_rad):.0f}",
            f"{1000 * move.margin_m:.0f}",
            "–" if error_m is None else f"{1000 * error_m:.2f}",
            pose.why,
        )
    out.print(table)
    out.print(
        f"{len(plan.poses)} poses, {outcome.duration_s:.0f} s of motion over {outcome.path_m:.1f} m, "
        f"at most {outcome.top_speed_m_s:.2f} m/s and {np.rad2deg(outcome.largest_step_rad):.0f}° in one move"
    )
    if (last_m := plan.predicted_error_m(-1)) is not None:
        error = predicted_error(1000 * last_m, plan.working_distance_m)
        out.print(
            f"{error.label} {error.about}: {error.value}, goal {1000 * goal_m:g} mm (capture.goal_m), "
            "if corners and arm are as good as assumed"
        )
    if plan.floor_m is not None and (said := above_goal(1000 * plan.floor_m, 1000 * goal_m)):
        out.print(f"{said[0].upper()}{said[1:]}.")
    if plan.note:
        out.print(f"note: {plan.note}")
    for problem in outcome.problems:
        out.print(Text.assemble(("✗", "red"), f" {problem}"))
