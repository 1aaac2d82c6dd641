"""Boards are found where the projection puts them, the right way round, or refused with the reason."""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
import pytest

from calibrate.boards.detect import detect
from calibrate.boards.grids import count_circles, find_circles
from calibrate.boards.model import (
    BoardError,
    ambiguity_text,
    board_from_turned,
    board_points,
    fixes_a_plane,
    looks_same_turns,
)
from calibrate.views.projection import project_at
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel
from station.simulation.renderer import Light, render
from tests.calibrate.sessions import CAMERA, PAPER_BOARD, looking

CHARUCO = BoardSpec(BoardKind.CHARUCO, 8, 6, 0.024, 0.018, "DICT_5X5_100")
BOARDS = [
    PAPER_BOARD,
    BoardSpec(BoardKind.CHESSBOARD, 6, 7, 0.024),
    CHARUCO,
    msgspec.structs.replace(CHARUCO, legacy=True),
    BoardSpec(BoardKind.ASYMMETRIC_CIRCLES, 4, 11, 0.013),
    BoardSpec(BoardKind.APRIL_GRID, 4, 3, 0.036, 0.0108),
    BoardSpec(BoardKind.ARUCO, square_m=0.12, dictionary="DICT_4X4_50", tag_id=7),
    BoardSpec(BoardKind.APRIL_TAG, square_m=0.12, tag_id=3),
]
EXACT_LIMIT_PX = {BoardKind.APRIL_GRID: 0.25, BoardKind.ASYMMETRIC_CIRCLES: 0.05}


def picture(spec: BoardSpec, seed: int, **light: float) -> tuple[np.ndarray, np.ndarray]:
    """(image, camera_from_board)"""
    rng = np.random.default_rng(seed)
    seen = looking(spec, rng)
    return render(CAMERA, spec, seen, Light(**({"pixel_noise": 1.5} | light)), rng), seen


@pytest.mark.parametrize(
    "spec", BOARDS, ids=lambda s: f"{s.kind.value}{'-legacy' if s.legacy else ''}-{s.columns}"
)
def test_points_lie_where_the_projection_puts_them(spec: BoardSpec) -> None:
    """Identity of every point included: a turned or mirrored order would miss by a whole board."""
    for seed in range(3):
        image, seen = picture(spec, seed)
        found = detect(image, spec)
        assert found.found, found.reason
        # Of 14 such small april grids half miss a marker or two; which ones is chance.
        least = 0.8 if spec.kind is BoardKind.APRIL_GRID else 0.9
        assert len(found.corners) >= least * found.expected
        truth = project_at(CAMERA, seen, board_points(spec)[found.corners.ids])
        miss = np.linalg.norm(found.corners.pixels - truth, axis=1)
        assert np.sqrt(np.square(miss).mean()) < EXACT_LIMIT_PX.get(spec.kind, 0.10)


@pytest.mark.parametrize(
    "spec", [BoardSpec(BoardKind.CHESSBOARD, 7, 5, 0.025), BoardSpec(BoardKind.CIRCLES, 7, 5, 0.022)]
)
def test_a_symmetric_board_is_found_in_one_of_its_turns(spec: BoardSpec) -> None:
    image, seen = picture(spec, 4)
    found = detect(image, spec)
    readings = [
        project_at(CAMERA, seen @ board_from_turned(spec, t), board_points(spec))
        for t in looks_same_turns(spec)
    ]
    assert min(np.abs(found.corners.pixels - r).max() for r in readings) < 0.6
    assert "looks the same" in ambiguity_text(spec)


@pytest.mark.parametrize(
    ("columns", "rows", "turns"), [(7, 6, 1), (11, 9, 2), (8, 6, 2), (6, 6, 4), (5, 5, 2)]
)
def test_colours_decide_only_where_columns_and_rows_differ_in_parity(
    columns: int, rows: int, turns: int
) -> None:
    assert len(looks_same_turns(BoardSpec(BoardKind.CHESSBOARD, columns, rows, 0.02))) == turns


def test_a_turned_picture_gives_the_same_corner_order() -> None:
    """The paper's board: turning the picture by 180° turns every corner's place, not its identity."""
    image, _ = picture(PAPER_BOARD, 5)
    straight, turned = (
        detect(image, PAPER_BOARD),
        detect(np.ascontiguousarray(image[::-1, ::-1]), PAPER_BOARD),
    )
    mirrored = np.array([CAMERA.width - 1, CAMERA.height - 1]) - turned.corners.pixels
    assert np.abs(mirrored - straight.corners.pixels).max() < 0.15


def test_partial_charuco_is_used_and_its_points_keep_their_identity() -> None:
    image, seen = picture(CHARUCO, 6)
    image[:, : CAMERA.width // 2] = 90
    found = detect(image, CHARUCO)
    assert 6 <= len(found.corners) < found.expected
    truth = project_at(CAMERA, seen, board_points(CHARUCO)[found.corners.ids])
    assert np.linalg.norm(found.corners.pixels - truth, axis=1).max() < 0.6


def test_corners_in_a_line_are_refused_and_not_handed_to_the_solver() -> None:
    """One such view would make every pose and lens fit of the recording fail."""
    image, seen = picture(CHARUCO, 6)
    points = board_points(CHARUCO)
    size_m = CHARUCO.square_m
    rows = np.array([[-1.0, -1.0], [7.0, -1.0], [7.0, 0.6], [-1.0, 0.6]]) * size_m
    outline = project_at(CAMERA, seen, np.column_stack([rows, np.zeros(4)]))
    band = cv2.fillConvexPoly(np.zeros_like(image), outline.round().astype(np.int32), 1)
    found = detect(np.where(band > 0, image, 90).astype(np.uint8), CHARUCO)
    assert (found.cause, len(found.corners)) == ("in-line", 0)
    row = points[:, 1] == points[0, 1]
    assert not fixes_a_plane(points[row])
    assert not fixes_a_plane(np.concatenate([points[row], points[~row][:1]]))
    assert fixes_a_plane(np.concatenate([points[row], points[~row][:2]]))


def test_sixteen_bits_and_colour_give_the_corners_of_eight_bits() -> None:
    image, _ = picture(PAPER_BOARD, 7)
    plain = detect(image, PAPER_BOARD)
    assert (
        np.abs(
            detect(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), PAPER_BOARD).corners.pixels - plain.corners.pixels
        ).max()
        < 0.02
    )
    twelve_bits = image.astype(np.uint16) << 4
    twelve_bits[0, 0] = 4095
    assert np.abs(detect(twelve_bits, PAPER_BOARD).corners.pixels - plain.corners.pixels)[1:].max() < 0.02


@pytest.mark.parametrize(
    "spec",
    [s for s in BOARDS if s.kind in (BoardKind.ARUCO, BoardKind.APRIL_TAG)],
    ids=lambda s: s.kind.value,
)
def test_a_tag_that_lies_in_the_picture_is_found(spec: BoardSpec) -> None:
    """OpenCV's own search for quadrilaterals leaves out 8 of 55."""
    for seed in range(16):
        image, seen = picture(spec, seed)
        truth = project_at(CAMERA, seen, board_points(spec))
        if truth.min() > 5 and (truth < np.array([CAMERA.width, CAMERA.height]) - 6).all():
            found = detect(image, spec)
            assert found.found, seed
            assert np.abs(found.corners.pixels - truth).max() < 0.5, seed


def test_a_tag_of_another_number_or_seen_twice_is_not_the_board() -> None:
    spec = BoardSpec(BoardKind.APRIL_TAG, square_m=0.12, tag_id=3)
    image, _ = picture(spec, 0)
    assert detect(image, spec).found
    assert not detect(image, msgspec.structs.replace(spec, tag_id=4)).found
    assert not detect(np.concatenate([image, image], axis=1), spec).found


@pytest.mark.parametrize(
    ("spec", "columns", "rows", "seeds"),
    [
        (BoardSpec(BoardKind.CHESSBOARD, 8, 6, 0.019), 7, 6, (0, 1, 3)),
        *((BoardSpec(BoardKind.CHESSBOARD, 8, 6, 0.019), *size, (1,)) for size in ((6, 5), (6, 4), (8, 4))),
        (BoardSpec(BoardKind.CHESSBOARD, 9, 7, 0.017), 7, 5, (0,)),
        (BoardSpec(BoardKind.ASYMMETRIC_CIRCLES, 4, 11, 0.011), 3, 9, (0, 1, 3)),
        (CHARUCO, 9, 6, (3,)),
        *((BOARDS[5], *size, (0,)) for size in ((3, 4), (6, 6))),
    ],
)
def test_no_part_of_another_board_is_taken_for_this_one(
    spec: BoardSpec, columns: int, rows: int, seeds: tuple[int, ...]
) -> None:
    """Also not every second row of it, nor tags where another layout has others."""
    declared = msgspec.structs.replace(spec, columns=columns, rows=rows)
    for seed in seeds:
        image, _ = picture(spec, seed)
        assert detect(image, spec).found
        found = detect(image, declared)
        assert not found.found
        assert found.cause == "other-board" or spec.kind is not BoardKind.CHESSBOARD
        assert not detect(image, declared, thorough=False).found


@pytest.mark.parametrize("marker", [0.75, 0.8])
def test_a_board_of_markers_is_a_chessboard_to_who_calls_it_one(marker: float) -> None:
    board = msgspec.structs.replace(CHARUCO, marker_m=marker * CHARUCO.square_m)
    squares = BoardSpec(BoardKind.CHESSBOARD, board.columns - 1, board.rows - 1, board.square_m)
    for seed in range(6):
        image, seen = picture(board, seed)
        found, truth = detect(image, squares), project_at(CAMERA, seen, board_points(board))
        assert found.found
        off = np.linalg.norm(found.corners.pixels[:, None] - truth, axis=2).min(axis=1)
        assert off.max() < 2.0


def test_a_grid_of_tags_is_found_by_a_lens_that_bends_it() -> None:
    """Its plane is no plane in the image: a marker lies up to half its side from where one would have it."""
    wide = CameraModel(640, 512, ((330, 0, 320), (0, 330, 256), (0, 0, 1)), (-0.3, 0.11, 0, 0, -0.015))
    spec = BoardSpec(BoardKind.APRIL_GRID, 6, 6, 0.03, 0.009)
    seen = np.eye(4)
    seen[:3, 3] = [0, 0, 0.16] - board_points(spec).mean(axis=0)
    image = render(wide, spec, seen, Light(pixel_noise=1.5), np.random.default_rng(0))
    assert len(detect(image, spec).corners) >= 0.8 * 144


@pytest.mark.parametrize(("columns", "rows"), [(7, 6), (4, 3)])
def test_a_board_declared_in_squares_is_told_by_its_inner_corners(columns: int, rows: int) -> None:
    image, _ = picture(BoardSpec(BoardKind.CHESSBOARD, columns, rows, 0.15 / columns), 8)
    found = detect(image, BoardSpec(BoardKind.CHESSBOARD, columns + 1, rows + 1, 0.15 / columns))
    assert found.cause == "squares-counted"


@pytest.mark.parametrize(
    "spec", [CHARUCO, BoardSpec(BoardKind.APRIL_TAG, square_m=0.12, tag_id=3)], ids=lambda s: s.kind.value
)
def test_a_mirrored_picture_of_markers_is_said_to_be_one(spec: BoardSpec) -> None:
    image, _ = picture(spec, 0)
    assert detect(image, spec).found
    assert detect(np.ascontiguousarray(image[:, ::-1]), spec).cause == "mirrored"
    assert detect(np.full_like(image, 120), spec).cause == "empty"


def test_the_cause_is_told_where_no_board_is_found() -> None:
    image, _ = picture(PAPER_BOARD, 8)
    glare = image.copy()
    glare[60:] = 255
    assert detect(np.full_like(image, 120), PAPER_BOARD).cause == "empty"
    assert detect(glare, PAPER_BOARD).cause == "over-exposed"
    assert detect(np.full_like(image, 4), PAPER_BOARD).cause == "too-dark"
    for columns, rows in ((9, 6), (3, 9)):
        assert detect(image, BoardSpec(BoardKind.CHESSBOARD, columns, rows, 0.025)).cause == "other-board"


@pytest.mark.parametrize(
    ("spec", "key"),
    [
        (BoardSpec(BoardKind.CHESSBOARD, 2, 6, 0.025), "columns"),
        (BoardSpec(BoardKind.CHESSBOARD, 7, 6, 25.0), "square_m"),
        (BoardSpec(BoardKind.CHESSBOARD, 7, 6, float("nan")), "square_m"),
        (BoardSpec(BoardKind.CHARUCO, 7, 6, 0.025, 0.03, "DICT_5X5_100"), "marker_m"),
        (BoardSpec(BoardKind.CHARUCO, 7, 6, 0.025, 0.02, "DICT_NONE"), "dictionary-unknown"),
        (BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025, square_tolerance=0.5), "square_tolerance"),
        (BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025, flatness_m=1.0), "flatness_m"),
        (BoardSpec(BoardKind.ARUCO, square_m=0.1), "dictionary"),
        (
            BoardSpec(BoardKind.ARUCO, square_m=0.1, dictionary="DICT_4X4_50", tag_id=50),
            "dictionary-too-small",
        ),
        (BoardSpec(BoardKind.CHARUCO, 10, 11, 0.02, 0.015, "DICT_4X4_50"), "dictionary-too-small"),
        (BoardSpec(BoardKind.APRIL_GRID, 5, 11, 0.02, 0.015, "DICT_4X4_50"), "dictionary-too-small"),
        (BoardSpec(BoardKind.ARUCO, square_m=0.1, dictionary="DICT_4X4_50", tag_id=-1), "tag_id"),
        (BoardSpec(BoardKind.APRIL_TAG, 2, 2, 0.1), "columns"),
    ],
)
def test_impossible_boards_are_refused(spec: BoardSpec, key: str) -> None:
    with pytest.raises(BoardError) as refused:
        detect(np.zeros((100, 100), np.uint8), spec)
    assert key in (refused.value.code, refused.value.values.get("key"))


@pytest.mark.parametrize(
    "spec",
    [BoardSpec(BoardKind.CIRCLES, 7, 5, 0.022), BoardSpec(BoardKind.ASYMMETRIC_CIRCLES, 4, 11, 0.011)],
    ids=lambda s: s.kind.value,
)
def test_a_tilted_circle_is_its_own_centre_not_its_ellipses(spec: BoardSpec) -> None:
    """The ellipses' centres miss by 0.1 px here, and OpenCV guesses circles that it does not find."""
    misses: list[float] = []
    for seed in range(3):
        seen = looking(spec, np.random.default_rng(seed), tilt=(0.9, 0.95), distance_m=0.34)
        image = render(CAMERA, spec, seen, Light(pixel_noise=1.5), np.random.default_rng(seed))
        found = detect(image, spec)
        assert found.found
        truth = project_at(CAMERA, seen, board_points(spec))
        both = [np.linalg.norm(found.corners.pixels - t, axis=1) for t in (truth, truth[::-1])]
        misses += min(both, key=np.median).tolist()
    assert max(misses) < 0.2
    assert np.sqrt(np.square(misses).mean()) < 0.05


def test_a_grid_of_circles_is_found_among_other_dots_and_beside_an_uneven_grid() -> None:
    spec, rng = BoardSpec(BoardKind.ASYMMETRIC_CIRCLES, 4, 5, 0.02), np.random.default_rng(0)
    true = board_points(spec)[:, :2] * 1500 + [520, 250]
    image = np.full((720, 1280), 200, np.uint8)
    for at in rng.uniform((430, 180), (850, 500), (100, 2)):
        if not (490 < at[0] < 760 and 235 < at[1] < 395):
            cv2.circle(image, at.astype(int).tolist(), int(rng.uniform(3, 6)), 60, cv2.FILLED, cv2.LINE_AA)
    uneven = true / 2 + [680, 150]
    uneven[7] += 8
    for at, radius in (*((at, 9) for at in true), *((at, 5) for at in uneven)):
        cv2.circle(image, np.rint(16 * at).astype(int).tolist(), radius * 16, 40, cv2.FILLED, cv2.LINE_AA, 4)
    found = detect(cv2.GaussianBlur(image, (0, 0), 1), spec)
    assert len(found.corners.pixels) == len(true)
    assert np.abs(found.corners.pixels - true).max() < 0.2


@pytest.mark.parametrize(
    ("spec", "tilt", "distance_m", "light", "share", "rms_px"),
    [
        (CHARUCO, (0.2, 0.6), 0.36, Light(pixel_noise=1.5, illumination=0.08), 0.9, 0.3),
        (CHARUCO, (1.04, 1.05), 0.3, Light(pixel_noise=1.5), 0.9, 0.3),
        (CHARUCO, (0.2, 0.6), 0.8, Light(pixel_noise=1.5), 0.8, 0.2),
        (PAPER_BOARD, (0.78, 0.8), 0.36, Light(illumination=0.35, blur_px=1.2, pixel_noise=3.0), 1.0, 0.4),
        (PAPER_BOARD, (1.04, 1.05), 0.36, Light(illumination=0.35, blur_px=1.2, pixel_noise=3.0), 1.0, 0.4),
    ],
    ids=["dark", "60 degrees", "bits of 2 px", "45 degrees blurred", "60 degrees blurred"],
)
def test_a_board_that_is_hard_to_see_is_found(
    spec: BoardSpec, tilt: tuple[float, float], distance_m: float, light: Light, share: float, rms_px: float
) -> None:
    for seed in range(3):
        seen = looking(spec, np.random.default_rng(seed), tilt, distance_m)
        found = detect(render(CAMERA, spec, seen, light, np.random.default_rng(seed)), spec)
        assert len(found.corners) >= share * found.expected
        truth = project_at(CAMERA, seen, board_points(spec)[found.corners.ids])
        assert np.sqrt(np.square(found.corners.pixels - truth).sum(axis=1).mean()) < rms_px


def test_a_board_under_a_projected_pattern_of_dots_is_found() -> None:
    """As depth cameras throw it."""
    spec, rng = BoardSpec(BoardKind.CHESSBOARD, 11, 8, 0.02), np.random.default_rng(1)
    seen = looking(spec, rng, (0.2, 0.6), 0.5)
    dots = cv2.GaussianBlur(rng.standard_normal((CAMERA.height, CAMERA.width)), (0, 0), 0.6)
    image = render(CAMERA, spec, seen, Light(), rng) * np.exp(0.5 * dots / dots.std() - 0.3)
    found = detect(image.clip(0, 255).astype(np.uint8), spec)
    assert len(found.corners) == found.expected
    miss = found.corners.pixels - project_at(CAMERA, seen, board_points(spec))
    assert np.sqrt(np.square(miss).sum(axis=1).mean()) < 0.6


@pytest.mark.parametrize("blur_px", [0.8, 2.5])
@pytest.mark.parametrize(("columns", "rows"), [(22, 15), (15, 22), (10, 7), (12, 9)])
def test_the_dark_squares_of_a_chessboard_are_no_circles(columns: int, rows: int, blur_px: float) -> None:
    """They lie in an asymmetric grid: one of 22 × 15 squares was read as 11 × 15 circles."""
    dark = np.add.outer(np.arange(rows), np.arange(columns)) % 2
    flat = np.kron(255 * (1 - dark), np.ones((24, 24))).astype(np.uint8)
    flat = cv2.copyMakeBorder(flat, 60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
    height, width = flat.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    seen = corners + np.array([[60, 40], [-30, 80], [-80, -60], [30, -20]], np.float32)
    tilted = cv2.warpPerspective(
        cv2.GaussianBlur(flat, (0, 0), blur_px),
        cv2.getPerspectiveTransform(corners, seen),
        (width, height),
        borderValue=200,
    )
    count = count_circles(tilted)
    for size in ((at, count // at) for at in range(3, count // 3 + 1) if count % at == 0):
        for kind in (BoardKind.CIRCLES, BoardKind.ASYMMETRIC_CIRCLES):
            assert find_circles(tilted, BoardSpec(kind, *size, 0.02)) is None, (kind, size)
