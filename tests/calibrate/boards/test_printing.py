"""A printed board is found by our own detector at the size it says."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

from calibrate.boards.detect import detect
from calibrate.boards.model import BoardError, board_points
from calibrate.boards.printing import board_sheet
from calibrate.boards.vector import Circle, Rectangle, Sheet, pdf, svg
from recordings.schema.messages import BoardKind, BoardSpec

PX_MM = 4.0
BOARDS = [
    BoardSpec(kind=BoardKind.CHESSBOARD, columns=7, rows=6, square_m=0.025),
    BoardSpec(kind=BoardKind.CHESSBOARD, columns=9, rows=6, square_m=0.030),
    BoardSpec(kind=BoardKind.CIRCLES, columns=7, rows=5, square_m=0.03),
    BoardSpec(kind=BoardKind.ASYMMETRIC_CIRCLES, columns=4, rows=11, square_m=0.02),
    BoardSpec(
        kind=BoardKind.CHARUCO, columns=7, rows=5, square_m=0.03, marker_m=0.022, dictionary="DICT_6X6_250"
    ),
    BoardSpec(
        kind=BoardKind.CHARUCO,
        columns=6,
        rows=8,
        square_m=0.03,
        marker_m=0.022,
        dictionary="DICT_5X5_100",
        legacy=True,
    ),
    BoardSpec(kind=BoardKind.APRIL_GRID, columns=4, rows=3, square_m=0.04, marker_m=0.012),
    BoardSpec(kind=BoardKind.ARUCO, square_m=0.1, dictionary="DICT_6X6_250", tag_id=42),
    BoardSpec(kind=BoardKind.APRIL_TAG, square_m=0.12, tag_id=5),
]


def rasterise(sheet: Sheet) -> np.ndarray:
    """Black on white at PX_MM, four times oversampled."""
    fine = 4
    scale = PX_MM * fine
    canvas = np.full((round(sheet.height_mm * scale), round(sheet.width_mm * scale)), 235, np.uint8)
    for shape in sheet.shapes:
        if isinstance(shape, Rectangle):
            x0, y0 = round(shape.x * scale), round(shape.y * scale)
            x1, y1 = round((shape.x + shape.width) * scale), round((shape.y + shape.height) * scale)
            canvas[y0:y1, x0:x1] = 20
        elif isinstance(shape, Circle):
            centre = (round(shape.x * scale), round(shape.y * scale))
            cv2.circle(canvas, centre, round(shape.radius * scale), 20, -1)
    return cv2.resize(canvas, None, fx=1 / fine, fy=1 / fine, interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(
    ("kind", "columns", "rows", "held"), [(BoardKind.CHARUCO, 10, 10, 50), (BoardKind.APRIL_GRID, 5, 10, 50)]
)
def test_a_board_needs_no_more_markers_than_its_dictionary_holds(kind, columns, rows, held) -> None:  # type: ignore[no-untyped-def]
    spec = BoardSpec(kind, columns, rows, 0.02, 0.015, "DICT_4X4_50")
    assert board_sheet(spec).shapes
    with pytest.raises(BoardError, match=f"needs {held + 5} markers, DICT_4X4_50 holds {held}"):
        board_sheet(BoardSpec(kind, columns, rows + 1, 0.02, 0.015, "DICT_4X4_50"))


def test_a_tag_that_is_seen_on_two_boards_is_read_on_neither() -> None:
    """Its corners would be in two places at once, and the board's pose anywhere."""
    spec = next(board for board in BOARDS if board.kind is BoardKind.APRIL_GRID)
    sheet = rasterise(board_sheet(spec))
    first_column = sheet[:, : sheet.shape[1] // 4 + 10]
    assert not detect(np.concatenate([sheet, sheet], axis=1), spec).found
    found = detect(np.concatenate([sheet, first_column], axis=1), spec)
    alone = detect(sheet, spec)
    assert sorted(found.indices.tolist()) == [i for i in range(48) if i // 4 % spec.columns]
    at = dict(zip(alone.indices.tolist(), alone.pixels, strict=True))
    np.testing.assert_allclose(found.pixels, [at[i] for i in found.indices.tolist()], atol=0.05)


@pytest.mark.parametrize("spec", BOARDS, ids=lambda s: f"{s.kind.value}-{s.columns}x{s.rows}")
def test_every_printed_board_is_found_whole_and_to_scale(spec: BoardSpec) -> None:
    found = detect(rasterise(board_sheet(spec)), spec)
    assert found.reason == ""
    assert found.corners == len(board_points(spec))
    # Distances on the sheet are those of the board, to a tenth of a millimetre over the whole board.
    plane = board_points(spec)[found.indices][:, :2] * 1000
    H, _ = cv2.estimateAffine2D(plane, found.pixels / PX_MM)
    scale = np.linalg.svd(H[:, :2], compute_uv=False)
    span = np.ptp(plane, axis=0).max()
    assert np.abs(scale - 1).max() * span < 0.1
    assert np.linalg.det(H[:, :2]) > 0, "the board's frame is mirrored"


def test_svg_and_pdf_state_their_true_size() -> None:
    sheet = board_sheet(BOARDS[0], "A4")
    assert (sheet.width_mm, sheet.height_mm) == (297.0, 210.0)
    assert 'width="297.000mm" height="210.000mm"' in svg(sheet)
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf(sheet))
    assert box is not None
    assert float(box[1]) / 72 * 25.4 == pytest.approx(297.0, abs=1e-3)
    assert float(box[2]) / 72 * 25.4 == pytest.approx(210.0, abs=1e-3)


def test_pdf_draws_the_same_shapes_as_svg() -> None:
    sheet = board_sheet(BOARDS[0])
    drawn = re.findall(rb"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re f", pdf(sheet))
    in_svg = re.findall(r'<rect x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)"/>', svg(sheet))
    assert len(drawn) == len(in_svg) >= 28
    points = np.array(drawn, float) / 72 * 25.4
    points[:, 1] = sheet.height_mm - points[:, 1] - points[:, 3]
    assert np.abs(points - np.array(in_svg, float)).max() < 1e-3


def test_pdf_is_whole_by_its_own_table() -> None:
    content = pdf(board_sheet(BOARDS[3]))
    start = int(content.rsplit(b"startxref\n", 1)[1].split()[0])
    assert content[start:].startswith(b"xref")
    for number, offset in enumerate(re.findall(rb"(\d{10}) 00000 n", content[start:]), 1):
        assert content[int(offset) :].startswith(b"%d 0 obj" % number)


def test_the_print_says_what_it_is() -> None:
    text = svg(board_sheet(BOARDS[5]))
    assert "dictionary: DICT_5X5_100" in text
    assert "legacy: true" in text
    assert "square_m: 0.03" in text


def test_a_board_larger_than_the_paper_is_refused_with_one_that_fits() -> None:
    with pytest.raises(BoardError, match="not on A4; it fits on A3"):
        board_sheet(BOARDS[1], "A4")
