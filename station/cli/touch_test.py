"""`station touch-test`: the tip over corners of the board, then a person's hand; the offsets are kept."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from calibrate.boards.model import outer_corners
from calibrate.errors import CalibrationError
from calibrate.files.calibration import read_calibration
from calibrate.files.install import installed_calibration
from calibrate.files.touch import Touch, touch_text
from recordings.schema.messages import BoardSpec
from station.cell.errors import RefusedError, StationError
from station.cell.status import HoverOffer, MotionPreview
from station.cli.attended import Attended, attended, ctrl_c_at_once
from station.cli.console import AsJson, Socket, err, out
from station.operate.touch_test import (
    STANDOFF_M,
    UNREACHABLE,
    Hovering,
    note_touches,
    touch_test,
    touch_told,
)


def touch_test_command(
    calibration: Annotated[
        Path | None, typer.Argument(help="A calibration file; default: the installed one", show_default=False)
    ] = None,
    corner: Annotated[
        list[int] | None,
        typer.Option(help="Corner to visit, 0: the board's origin; default: the four outermost"),
    ] = None,
    standoff_mm: Annotated[float, typer.Option(help="Height of the tip over the board, mm; 61 or more")] = (
        1000 * STANDOFF_M
    ),
    pointer_mm: Annotated[
        float | None, typer.Option(help="Length of a pointer along the flange's z axis, mm")
    ] = None,
    socket: Socket = None,
    as_json: AsJson = False,
) -> None:
    """Test a calibration by touching corners of the board by hand.

    The board must be in the camera's view at the start. Every motion is asked for: at most 0.05 m/s, 50 mm
    and more from the board. Down to the board the tip goes by your hand only (freedrive on the pendant). The
    offsets are written into the calibration. Ctrl-C stops the arm.

    --json: no questions, simulated cells only, nothing is written.

    Exit codes: 0 all corners visited, 3 some left out, 1 none.
    """

    async def visited() -> _ShellToucher:
        async with attended(socket, headless=as_json) as shell:
            if as_json:
                shell.require_simulated()
            root, camera = shell.client.root, shell.client.camera
            found = read_calibration(calibration) if calibration else installed_calibration(root, camera)
            visit = _ShellToucher(shell, found.board, corner, pointer_mm, as_json)
            try:
                await touch_test(shell.client, visit, calibration, standoff_mm / 1000)
            finally:
                visit.write(root, calibration, camera)
        return visit

    visit = asyncio.run(visited())
    if as_json:
        print(json.dumps({"calibration": str(calibration or "installed"), "corners": visit.rows}))
    if len(visit.rows) < visit.wanted:
        raise typer.Exit(3 if visit.rows else 1)


class _ShellToucher:
    """The person at this terminal, who guides the tip."""

    def __init__(
        self,
        shell: Attended,
        board: BoardSpec,
        corners: list[int] | None,
        pointer_mm: float | None,
        quiet: bool,
    ) -> None:
        self._shell, self._board, self._pointer_mm, self._quiet = shell, board, pointer_mm, quiet
        self._left = list(corners or outer_corners(board))
        self.wanted = len(self._left)
        self.rows: list[dict[str, object]] = []
        self._touches: list[Touch] = []

    async def next_corner(self) -> int | None:
        return self._left.pop(0) if self._left else None

    def pointer_m(self) -> float | None:
        return None if self._pointer_mm is None else self._pointer_mm / 1000

    async def approves(self, preview: MotionPreview) -> bool:
        if not (yes := await self._shell.approves(preview)):
            err.print("Nothing moved.")
            self._left.clear()
        return yes

    def refused(self, corner: int, problem: StationError) -> None:
        if problem.code not in UNREACHABLE:
            raise problem  # it would be the same at every corner
        err.print(Text.assemble((f"Corner {corner} is left out", "yellow"), f": {problem}"))

    async def touch(self, offer: HoverOffer, arrival: Awaitable[Hovering]) -> None:
        hovering = await arrival
        self.rows.append(_row(hovering))
        if self._quiet:
            return
        err.print(hovering.instructions(self._board) + "\n  (s: leave this corner out, q: no more corners)")
        while True:
            try:
                with ctrl_c_at_once():
                    said = str(typer.prompt("offset x,y", default="", show_default=False, err=True)).strip()
            except typer.Abort:
                said = "q"
            if said in ("s", "q"):
                if said == "q":
                    self._left.clear()
                return
            try:
                touch = touch_told(hovering, said, await self._shell.status())
            except RefusedError as problem:
                err.print(str(problem), style="yellow")
                continue
            self._touches.append(touch)
            err.print(touch_text(touch))
            return

    def write(self, root: Path | None, file: Path | None, camera: str) -> None:
        if not self._touches:
            return
        try:
            out.print(note_touches(root, file, self._touches, camera))
        except (CalibrationError, OSError) as problem:
            err.print(Text.assemble(("Not written", "red"), f": {problem}"))
            for touch in self._touches:
                err.print(f"  {touch_text(touch)}")


def _row(hovering: Hovering) -> dict[str, object]:
    offer = hovering.offer
    return {
        "corner": offer.corner,
        "corner_mm": [1000 * v for v in offer.corner_m],
        "tip_mm": (1000 * hovering.tip_m).tolist(),
        "standoff_mm": 1000 * offer.standoff_m,
        "sigma_mm": [1000 * v for v in offer.sigma_m],
        "top_speed_m_s": offer.go.top_speed_m_s,
        "path_m": offer.go.path_m,
        "duration_s": offer.go.duration_s,
    }
