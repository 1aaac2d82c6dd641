"""A printed board is found by our own detector at the size it says."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest
import yaml

from calibrate.boards.detect import detect
from calibrate.boards.model import BoardError, board_points
from calibrate.boards.printing import Sheet, board_sheet, board_texture
from recordings.schema.messages import BoardKind, BoardSpec

PX_MM = 4.0
BOARDS = [
    BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025),
    BoardSpec(BoardKind.CHESSBOARD, 9, 6, 0.030),
    BoardSpec(BoardKind.CIRCLES, 7, 5, 0.03),
    BoardSpec(BoardKind.ASYMMETRIC_CIRCLES, 4, 11, 0.02),
    BoardSpec(BoardKind.CHARUCO, 7, 5, 0.03, 0.022, "DICT_6X6_250"),
    BoardSpec(BoardKind.CHARUCO, 6, 8, 0.03, 0.022, "DICT_5X5_100", legacy=True),
    BoardSpec(BoardKind.APRIL_GRID, 4, 3, 0.04, 0.012),
    BoardSpec(BoardKind.ARUCO, square_m=0.1, dictionary="DICT_6X6_250", tag_id=42),
    BoardSpec(BoardKind.APRIL_TAG, square_m=0.12, tag_id=5),
]


def printed(sheet: Sheet) -> np.ndarray:
    """The sheet's shapes at PX_MM, four times oversampled."""
    return cv2.resize(sheet.pixels(4 * PX_MM), None, fx=1 / 4, fy=1 / 4, interpolation=cv2.INTER_AREA)


def page_mm(content: bytes) -> tuple[float, float]:
    box = re.search(rb"/MediaBox *\[ *0 0 ([\d.]+) ([\d.]+) *\]", content)
    return float(box[1]) / 72 * 25.4, float(box[2]) / 72 * 25.4


@pytest.mark.parametrize("hidden", [False, True])
def test_a_tag_that_is_seen_on_two_boards_is_read_on_neither(hidden: bool) -> None:
    """Its corners would be in two places at once, and the board's pose anywhere; also where one is hidden."""
    spec = next(board for board in BOARDS if board.kind is BoardKind.APRIL_GRID)
    sheet = printed(board_sheet(spec))
    first_column = sheet[:, : sheet.shape[1] // 4 + 10].copy()
    if hidden:
        sheet[:, : sheet.shape[1] // 4] = 255
    found = detect(np.concatenate([sheet, first_column], axis=1), spec)
    assert sorted(found.corners.ids.tolist()) == [i for i in range(48) if i // 4 % spec.columns]


@pytest.mark.parametrize("spec", BOARDS, ids=lambda s: f"{s.kind.value}-{s.columns}x{s.rows}")
def test_every_printed_board_is_found_whole_and_to_scale(spec: BoardSpec) -> None:
    found = detect(printed(board_sheet(spec)), spec)
    assert len(found.corners) == len(board_points(spec)), found.reason
    # Distances on the sheet are those of the board, to a tenth of a millimetre over the whole board.
    plane = board_points(spec)[found.corners.ids][:, :2] * 1000
    H, _ = cv2.estimateAffine2D(plane, found.corners.pixels / PX_MM)
    scale = np.linalg.svd(H[:, :2], compute_uv=False)
    span = np.ptp(plane, axis=0).max()
    assert np.abs(scale - 1).max() * span < 0.1
    assert np.linalg.det(H[:, :2]) > 0, "the board's frame is mirrored"


@pytest.mark.parametrize("spec", BOARDS, ids=lambda s: f"{s.kind.value}-{s.columns}x{s.rows}")
def test_a_texture_has_whole_pixels_a_square_and_a_white_border(spec: BoardSpec) -> None:
    texture = board_texture(spec, 60)
    found = detect(texture, spec)
    offsets = found.corners.pixels - board_points(spec)[found.corners.ids][:, :2] * 60 / spec.square_m
    assert len(found.corners) == len(board_points(spec)) and np.ptp(offsets, axis=0).max() < 0.5
    border = np.ones_like(texture, bool)
    border[60:-60, 60:-60] = False
    assert (texture[border] == 255).all()
    if spec is BOARDS[0]:
        assert texture.shape == (60 * (spec.rows + 3), 60 * (spec.columns + 3))
        assert set(np.unique(texture)) == {0, 255}


def test_pdf_and_svg_are_pages_of_their_true_size() -> None:
    sheet = board_sheet(BOARDS[0], "A4")
    assert page_mm(sheet.encode("pdf")) == pytest.approx((297.0, 210.0), abs=1e-3)
    size_pt = re.search(rb'width="([\d.]+)pt" height="([\d.]+)pt" viewBox="0 0 \1 \2"', sheet.encode("svg"))
    assert float(size_pt[1]) / 72 * 25.4 == pytest.approx(297.0, abs=1e-3)
    assert sheet.encode("svg") == board_sheet(BOARDS[0], "A4").encode("svg")


def test_the_print_carries_its_own_configuration() -> None:
    text = re.search(r"board: (\{.*\})", board_sheet(BOARDS[5]).encode("svg").decode())
    assert yaml.safe_load(text[1]) == {
        "kind": "charuco",
        "columns": 6,
        "rows": 8,
        "square_m": 0.03,
        "marker_m": 0.022,
        "dictionary": "DICT_5X5_100",
        "legacy": True,
    }


@pytest.mark.parametrize(
    ("paper", "code"), [("A4", "paper-too-small"), ("A3", None), ("letter", "paper-unknown")]
)
def test_a_board_larger_than_the_paper_is_refused(paper, code) -> None:
    try:
        assert board_sheet(BOARDS[1], paper).width_mm == 420.0
    except BoardError as refused:
        assert refused.code == code
    else:
        assert code is None
