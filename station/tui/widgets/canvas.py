"""A drawing of points in space made of braille dots: lines, rods and words, seen from one side."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

import cv2
import numpy as np
from textual.content import Content

from recordings.geometry import Array

BRAILLE = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
"""Bits of a braille letter's dots, rows from the top."""
DOWN, ACROSS = BRAILLE.shape
_TURN_RAD, _LIFT_RAD = np.radians([-60.0, 22.0])
"""Direction of view about the base's z axis, and height of the eye above the floor."""
_AXES = np.array(
    [
        [-np.sin(_TURN_RAD), np.cos(_TURN_RAD), 0.0],
        [np.cos(_TURN_RAD) * np.sin(_LIFT_RAD), np.sin(_TURN_RAD) * np.sin(_LIFT_RAD), -np.cos(_LIFT_RAD)],
    ]
)
"""Right and down of the drawing, in the base's frame."""
_FILLED, _SMALLEST_M = 0.86, 0.2
"""Share of the drawing that is filled, and the least size of what fills it."""


class Canvas:
    """`width` × `height` letters, in which the points `around`, (n, 3) in metres, have room.

    Each part has a rank: a dot has the highest drawn there, and a letter the colour of its highest dot.
    """

    def __init__(self, width: int, height: int, around: Array) -> None:
        self._dots = np.zeros((DOWN * max(1, height), ACROSS * max(1, width)), dtype=np.uint8)
        flat = np.nan_to_num(around) @ _AXES.T
        low, high, size = flat.min(axis=0), flat.max(axis=0), np.array(self._dots.shape[::-1])
        self._scale = float(_FILLED * (size / np.maximum(high - low, _SMALLEST_M)).min())
        self._origin = size / 2 - self._scale * (low + high) / 2
        self._texts: list[tuple[int, int, int, str]] = []

    def _place(self, points: Array) -> Array:
        """Dots (…, 2) at which points (…, 3) are seen; far beyond the drawing all the same."""
        seen = np.nan_to_num(points) @ _AXES.T * self._scale + self._origin
        return np.asarray(seen.clip(-1e4, 1e4), dtype=float)

    def edges(self, points: Array, pairs: Sequence[tuple[int, int]], rank: int, dash: int = 0) -> None:
        """Draw lines between pairs of points; `dash`: length of dashes and gaps in dots, 0: solid."""
        for start, end in self._place(points[np.array(pairs)]):
            pieces = max(1, round(float(np.abs(end - start).max()) / (2 * dash))) if dash else 1
            step = (end - start) / pieces
            for begun in start + step * np.arange(pieces)[:, None]:
                self._line(begun, begun + (step / 2 if dash else step), 1, rank)

    def rod(self, start: Array, end: Array, radius_m: float, rank: int) -> None:
        """Draw a line as thick as a body of this radius."""
        begun, ended = self._place(np.stack([start, end]))
        self._line(begun, ended, max(1, round(2 * radius_m * self._scale)), rank)

    def _line(self, start: Array, end: Array, dots: int, rank: int) -> None:
        layer = np.zeros_like(self._dots)
        cv2.line(layer, start.astype(int).tolist(), end.astype(int).tolist(), rank, dots)
        np.maximum(self._dots, layer, out=self._dots)

    def text(self, at: Array, words: str, rank: int, beside: tuple[int, int] = (0, 0)) -> None:
        """Write words that begin so many letters right of and below a point, or next to it where they fit."""
        column, row = (self._place(at) // (ACROSS, DOWN) + beside).astype(int).tolist()
        room = self._dots.shape[1] // ACROSS - len(words)
        self._texts.append((rank, row, max(0, min(column, room)), words))

    def content(self, styles: Sequence[str]) -> Content:
        """Return the drawing; `styles` of the ranks, from rank 1 on."""
        rows, columns = self._dots.shape[0] // DOWN, self._dots.shape[1] // ACROSS
        cells = self._dots.reshape(rows, DOWN, columns, ACROSS).transpose(0, 2, 1, 3)
        codes, ranks = ((cells > 0) * BRAILLE).sum(axis=(2, 3)), cells.max(axis=(2, 3))
        letters = [[chr(0x2800 + code) if code else " " for code in row] for row in codes.tolist()]
        for rank, row, column, words in sorted(self._texts):
            for place, letter in enumerate(words, start=column):
                if 0 <= row < rows and place < columns:
                    letters[row][place], ranks[row, place] = letter, rank
        styled = ("", *styles)
        return Content("\n").join(
            Content.assemble(
                *(
                    ("".join(letter for letter, _ in run), styled[rank])
                    for rank, run in groupby(zip(line, of, strict=True), key=lambda pair: pair[1])
                )
            )
            for line, of in zip(letters, ranks.tolist(), strict=True)
        )
