"""`calibrate board`: a board to print at true scale."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer

from calibrate.boards.model import ambiguity_text, describe_board, usual_markers
from calibrate.boards.printing import PAPER_MM, board_sheet, board_texture
from calibrate.cli.files import read_board
from calibrate.cli.output import check_target, err, out
from calibrate.errors import UsageError
from calibrate.files.calibration import write_output
from recordings.schema.messages import SINGLE_TAGS, BoardKind, BoardSpec

PAGES, TEXTURES = (".pdf", ".svg"), (".png", ".ppm")


def board(
    output: Annotated[Path, typer.Option("-o", "--output", help="NAME.pdf, .svg, .png or .ppm")] = Path(
        "board.pdf"
    ),
    board_file: Annotated[
        Path | None,
        typer.Option("--board", help="YAML with a board: dataset.yaml, a station's configuration"),
    ] = None,
    kind: Annotated[BoardKind, typer.Option(help="Kind of the pattern")] = BoardKind.CHESSBOARD,
    columns: Annotated[
        int, typer.Option(help="Columns of inner corners, circles or tags; charuco: squares")
    ] = 7,
    rows: Annotated[int, typer.Option(help="Rows of the same")] = 6,
    square_mm: Annotated[
        float, typer.Option(help="Square, distance of circles, or side of a tag, mm")
    ] = 25.0,
    marker_mm: Annotated[
        float | None, typer.Option(help="charuco: side of a marker, mm; april-grid: gap")
    ] = None,
    dictionary: Annotated[
        str | None, typer.Option(help="Dictionary of the markers, such as DICT_6X6_250")
    ] = None,
    tag_id: Annotated[int, typer.Option("--id", help="aruco, april-tag: number of the tag")] = 0,
    legacy: Annotated[bool, typer.Option(help="charuco: layout before OpenCV 4.6")] = False,
    paper: Annotated[
        str | None, typer.Option(help=f"{', '.join(PAPER_MM)}; default: as large as needed")
    ] = None,
    square_px: Annotated[int, typer.Option(min=4, max=1000, help="png, ppm: pixels a square")] = 100,
) -> None:
    """Write a printable board (PDF or SVG, true scale), or one for a simulator (PNG or PPM).

    Without options: 8 × 7 squares of 25 mm. With a bar to measure on the paper, and the lines for the
    station's configuration. A PNG or PPM is a texture: the board alone, with a white border of one square.
    """
    suffix = output.suffix.lower()
    if suffix not in (*PAGES, *TEXTURES):
        raise UsageError("board-format", path=output)
    check_target(output, "export")
    usual_m, usual = usual_markers(kind, square_mm / 1000)
    marker_m = usual_m if marker_mm is None else marker_mm / 1000
    dictionary = dictionary or usual
    if kind in SINGLE_TAGS:
        columns = rows = 1
    spec = BoardSpec(kind, columns, rows, square_mm / 1000, marker_m, dictionary, legacy, tag_id=tag_id)
    if board_file is not None:
        spec = read_board(board_file)
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
