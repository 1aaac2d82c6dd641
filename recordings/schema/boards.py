"""Which numbers cannot be those of a real board."""

from __future__ import annotations

from recordings.schema.messages import (
    LARGEST_FLATNESS_M,
    LARGEST_TOLERANCE,
    SINGLE_TAGS,
    BoardKind,
    BoardSpec,
)

FEWEST_ON_A_SIDE, MOST_ON_A_SIDE = 3, 200
"""Inner corners on a side of a chessboard that OpenCV finds; columns or rows of any board."""


def board_problem(board: BoardSpec) -> tuple[str, str] | None:
    """Return the first key that is wrong, and what is wrong with it; None: nothing is."""
    kind, sides, marker_m = board.kind, (board.columns, board.rows), board.marker_m
    tag, april = kind in SINGLE_TAGS, kind in (BoardKind.APRIL_GRID, BoardKind.APRIL_TAG)
    fewest = 1 if tag or april else FEWEST_ON_A_SIDE if kind is BoardKind.CHESSBOARD else 2
    markers = kind in (BoardKind.CHARUCO, BoardKind.APRIL_GRID)
    counted = f"{sides[0]} × {sides[1]} columns × rows"
    if tag and sides != (1, 1):
        return "columns", f"{counted}: a single tag has none, leave them out"
    if not all(fewest <= side <= MOST_ON_A_SIDE for side in sides):
        what = "inner corners of a chessboard, squares of a charuco board"
        return "columns", f"{counted}, {what}: each is {fewest} to {MOST_ON_A_SIDE}"
    if not 1e-4 <= board.square_m <= 10:
        return "square_m", f"square_m = {board.square_m} is no length in metres (25 mm is 0.025)"
    if markers and not (marker_m and 0 < marker_m < board.square_m):
        what = "side of a marker or gap between tags"
        return "marker_m", f"marker_m = {marker_m}, {what}, is not between 0 and square_m"
    if (markers or tag) and not (april or board.dictionary):
        return "dictionary", f"{kind.value} needs its dictionary, such as DICT_4X4_50"
    if tag and board.tag_id < 0:
        return "tag_id", f"tag_id = {board.tag_id} is negative"
    if (share := board.square_tolerance) is not None and not 0 < share <= LARGEST_TOLERANCE:
        return (
            "square_tolerance",
            f"{share} is no share of square_m (0.3 % is 0.003, limit {LARGEST_TOLERANCE})",
        )
    if (flatness_m := board.flatness_m) is not None and not 0 < flatness_m <= LARGEST_FLATNESS_M:
        limit = f"1 mm is 0.001, limit {LARGEST_FLATNESS_M}"
        return "flatness_m", f"{flatness_m} is no flatness in metres ({limit})"
    return None
