"""`station touch-test`: a person brings the tip onto corners of the board; the offsets are kept."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from calibrate.boards.model import board_points, outer_corners
from calibrate.errors import CalibrationError
from calibrate.files.touch import Touch, touch_text
from station.cell.errors import RefusedError
from station.cell.socket_folder import default_socket
from station.cli.attended import no_terminal
from station.cli.console import Socket, err, out
from station.operate.motion import status_now
from station.operate.tip_offsets import SeenBoard, note_touches, pointer_tip, read_touch, see_board
from station.protocol.client import Client


def touch_test_command(
    calibration: Annotated[
        Path | None, typer.Argument(help="A calibration file; default: the installed one", show_default=False)
    ] = None,
    corner: Annotated[
        list[int] | None,
        typer.Option(help="Corner to touch, 0: the board's origin; default: the four outermost"),
    ] = None,
    pointer_mm: Annotated[
        float | None, typer.Option(help="Length of a pointer along the flange's z axis, mm")
    ] = None,
    socket: Socket = None,
) -> None:
    """Test a calibration by touching corners of the board by hand.

    The board must be in the camera's view at the start, and stay where it is. The station commands no move:
    bring the tip onto each corner with freedrive or the pendant, and the arm's position is read. The offsets
    are written into the calibration.

    Exit codes: 0 all corners touched, 3 some left out, 1 none.
    """
    if not sys.stdin.isatty():
        raise no_terminal()
    path, pointer_m = socket or default_socket(), None if pointer_mm is None else pointer_mm / 1000

    async def look() -> tuple[SeenBoard, Path | None, str]:
        async with Client(path) as client:
            return await see_board(client, calibration), client.root, client.camera

    board, root, camera = asyncio.run(look())
    err.print(f"Tip: {pointer_tip(board, pointer_m)[1]}. Enter reads the arm, s leaves a corner out, q ends.")
    touches: list[Touch] = []
    wanted = corner or list(outer_corners(board.calibration.board))
    try:
        for number in wanted:
            if not _touched(board, number, path, pointer_m, touches):
                break
    finally:
        _write(root, calibration, touches, camera)
    if len(touches) < len(wanted):
        raise typer.Exit(3 if touches else 1)


def _touched(
    board: SeenBoard, corner: int, socket: Path, pointer_m: float | None, touches: list[Touch]
) -> bool:
    """Ask for one corner until it is read or left out; False: no more of them."""
    x_mm, y_mm = 1000 * board_points(board.calibration.board)[corner, :2]
    question = f"Bring the tip onto corner {corner} (x {x_mm:.0f}, y {y_mm:.0f} mm on the board), hold it"
    while True:
        try:
            said = str(typer.prompt(question, default="", show_default=False, err=True)).strip()
        except typer.Abort:
            return False
        if said in ("s", "q"):
            return said == "s"
        try:
            touches.append(read_touch(board, corner, asyncio.run(status_now(socket)), pointer_m))
        except RefusedError as problem:
            err.print(str(problem), style="yellow")
            continue
        err.print(touch_text(touches[-1]))
        return True


def _write(root: Path | None, file: Path | None, touches: list[Touch], camera: str) -> None:
    if not touches:
        return
    try:
        out.print(note_touches(root, file, touches, camera))
    except (CalibrationError, OSError) as problem:
        err.print(Text.assemble(("Not written", "red"), f": {problem}"))
        for touch in touches:
            err.print(f"  {touch_text(touch)}")
