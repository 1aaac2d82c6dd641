"""A drawing made of braille dots: lines, areas and words."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from textual.content import Content

Points = NDArray[np.float64]
BRAILLE = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
"""Bits of a braille letter's dots, rows from the top."""
PER_LETTER = (2, 4)
"""Dots across and down."""


class Canvas:
    """`width` × `height` letters to draw dots in; x right, y down, in dots.

    Each part has a rank; a letter has the colour of the highest rank in it.
    """

    def __init__(self, width: int, height: int) -> None:
        self.columns, self.rows = max(1, width), max(1, height)
        self.width, self.height = self.columns * PER_LETTER[0], self.rows * PER_LETTER[1]
        self._dots = np.zeros((self.height, self.width), dtype=bool)
        self._rank = np.zeros((self.rows, self.columns), dtype=int)
        self._texts: list[tuple[int, int, str, int]] = []

    def points(self, where: Points, rank: int) -> None:
        """Draw dots at (n, 2) places; those outside are left out."""
        if not len(where):
            return
        at = np.floor(where).astype(int)
        at = at[(at >= 0).all(axis=1) & (at[:, 0] < self.width) & (at[:, 1] < self.height)]
        self._dots[at[:, 1], at[:, 0]] = True
        np.maximum.at(self._rank, (at[:, 1] // PER_LETTER[1], at[:, 0] // PER_LETTER[0]), rank)

    def lines(self, starts: Points, ends: Points, rank: int, dash: int = 0) -> None:
        """Draw lines from (n, 2) to (n, 2) places; `dash`: length of dashes and gaps in dots, 0: solid."""
        for start, end in zip(starts, ends, strict=True):
            length = float(np.abs(end - start).max())
            if not math.isfinite(length) or length > 8 * (self.width + self.height):
                continue
            steps = np.arange(round(length) + 1)
            if dash:
                steps = steps[steps % (2 * dash) < dash]
            self.points(start + (end - start) * (steps / max(length, 1.0))[:, None], rank)

    def rod(self, start: Points, end: Points, radius: float, rank: int) -> None:
        """Fill all dots within `radius` of the line from `start` to `end`, (2,) each."""
        low = np.floor(np.minimum(start, end) - radius).clip(0).astype(int)
        high = np.ceil(np.maximum(start, end) + radius).astype(int) + 1
        x, y = np.meshgrid(
            np.arange(low[0], min(high[0], self.width)), np.arange(low[1], min(high[1], self.height))
        )
        if not x.size:
            return
        dots = np.stack([x.ravel(), y.ravel()], axis=1).astype(float)
        along = end - start
        share = ((dots - start) @ along / max(float(along @ along), 1e-9)).clip(0, 1)
        near = np.linalg.norm(dots - start - share[:, None] * along, axis=1) <= max(radius, 0.5)
        self.points(dots[near], rank)

    def text(self, at: Points, words: str, rank: int) -> None:
        """Write words; their first letter is the one with the dot `at` (2,), or next to it where they fit."""
        if np.isfinite(at).all():
            column, row = (at // PER_LETTER).astype(int).tolist()
            self._texts.append((max(0, min(column, self.columns - len(words))), row, words, rank))

    def content(self, styles: Sequence[str]) -> Content:
        """Return the drawing; `styles` of the ranks, from rank 1 on."""
        across, down = PER_LETTER
        cells = self._dots.reshape(self.rows, down, self.columns, across).transpose(0, 2, 1, 3)
        codes = (cells * BRAILLE).sum(axis=(2, 3))
        letters = [[chr(0x2800 + code) if code else " " for code in row] for row in codes.tolist()]
        rank = self._rank.copy()
        for column, row, words, order in sorted(self._texts, key=lambda text: text[3]):
            for i, letter in enumerate(words):
                if 0 <= row < self.rows and 0 <= column + i < self.columns:
                    letters[row][column + i] = letter
                    rank[row, column + i] = order
        return Content("\n").join(
            _row(row, ranks, styles) for row, ranks in zip(letters, rank.tolist(), strict=True)
        )


def _row(letters: list[str], ranks: list[int], styles: Sequence[str]) -> Content:
    """Join neighbours of one style."""
    runs: list[tuple[str, str]] = []
    begun = 0
    for i in range(1, len(letters) + 1):
        if i == len(letters) or ranks[i] != ranks[begun]:
            style = styles[ranks[begun] - 1] if ranks[begun] else ""
            runs.append(("".join(letters[begun:i]), style))
            begun = i
    return Content.assemble(*runs)
