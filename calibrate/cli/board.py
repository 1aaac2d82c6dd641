"""`calibrate board`: a board to print at true scale."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer

from calibrate.boards.model import ambiguity_text, describe_board, typed_board
from calibrate.boards.printing import PAPER_MM, board_sheet, board_texture
from calibrate.cli.inputs import read_board
from calibrate.cli.output import check_target, err, out
from calibrate.errors import UsageError
from calibrate.files.calibration import write_output

PAGES, TEXTURES = (".pdf", ".svg"), (".png", ".ppm")


def board(
    typed: Annotated[
        str,
        typer.Argument(
            metavar="BOARD",
            help="Inner corners and mm, '7x6 25'; 'charuco 12x9 30 22 DICT_6X6_250' (squares, marker); "
            "'circles 7x5 30'; 'april-grid 6x6 30 9' (gap); 'april-tag 120 3', 'aruco 120 3' (number)",
        ),
    ] = "7x6 25",
    output: Annotated[Path, typer.Option("-o", "--output", help="NAME.pdf, .svg, .png or .ppm")] = Path(
        "board.pdf"
    ),
    board_file: Annotated[
        Path | None,
        typer.Option("--board", help="YAML with a board: dataset.yaml, a station's configuration"),
    ] = None,
    paper: Annotated[
        str | None, typer.Option(help=f"{', '.join(PAPER_MM)}; default: as large as needed")
    ] = None,
    square_px: Annotated[int, typer.Option(min=4, max=1000, help="png, ppm: pixels a square")] = 100,
) -> None:
    """Write a board to print (PDF, SVG) or for a simulator (PNG, PPM).

    Unless told: 8 × 7 squares of 25 mm. With a bar to measure on the paper, and the lines for the
    station's configuration. A PNG or PPM is a texture: the board alone, with a white border of one square.
    """
    suffix = output.suffix.lower()
    if suffix not in (*PAGES, *TEXTURES):
        raise UsageError("board-format", path=output)
    check_target(output, "export")
    spec = typed_board(typed) if board_file is None else read_board(board_file)
    if suffix in TEXTURES:
        texture = board_texture(spec, square_px)
        write_output(output, cv2.imencode(suffix, cv2.merge([texture] * 3))[1].tobytes())
        height_m, width_m = np.array(texture.shape) * spec.square_m / square_px
        size = f"its rectangle is {width_m:.6g} × {height_m:.6g} m"
        out.print(f"written: {output} ({describe_board(spec)}, {square_px} pixels a square; {size})")
    else:
        sheet = board_sheet(spec, paper)
        write_output(output, sheet.encode("pdf" if suffix == ".pdf" else "svg"))
        size = f"{sheet.width_mm:.0f} × {sheet.height_mm:.0f} mm"
        out.print(f"written: {output} ({describe_board(spec)}, {size})")
        out.print(
            "print at 100 % (no fitting to the page), glue it on something flat, measure bar and square"
        )
    if warning := ambiguity_text(spec):
        err.print(warning, style="yellow")
