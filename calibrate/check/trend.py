"""The trend of the drift checks of one solve: the camera moves along a straight line in time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibrate.check.drift import DriftCheck, limit
from calibrate.check.history import CheckEntry, Trend
from calibrate.handeye.cell_state import Quadratic
from calibrate.handeye.posterior import KnownCell
from calibrate.handeye.uncertainty import inverse_of
from recordings.schema.messages import BoardSpec

FEWEST_FOR_TREND = 5
"""Fewest drift checks from which a trend is estimated."""
_TREND_P = 0.01
"""Probability of a slope this clear by chance, below which a trend is reported."""


def entry_of(
    check: DriftCheck, wall_s: float, generation: int, recording: str, board: BoardSpec | None = None
) -> CheckEntry:
    """Make the line of a check by views of `board`; None: the calibration's own."""
    evidence = check.evidence or Quadratic(np.zeros((0, 0)), np.zeros(0))
    return CheckEntry(
        wall_s,
        generation,
        recording,
        check.passed,
        tuple(check.shift.tolist()),
        check.statistic,
        check.threshold,
        check.p_value,
        right=tuple(evidence.right.tolist()),
        information_lower=tuple(evidence.N[np.tril_indices(len(evidence.N))].tolist()),
        board=board,
    )


def _evidence(entry: CheckEntry) -> Quadratic:
    size = len(entry.right)
    N = np.zeros((size, size))
    N[np.tril_indices(size)] = entry.information_lower
    return Quadratic(N + np.tril(N, -1).T, np.array(entry.right))


def find_trend(
    checks: Sequence[CheckEntry], known: KnownCell, board: BoardSpec | None = None
) -> Trend | None:
    """Look for a trend in those checks of one solve that saw one board; None where chance explains it.

    board: the calibration's own where None; `known` is what is known before its views. The checks are solved
    together: lens, board and arm are the same in all, the camera's pose moves along a straight line of six
    slopes. These are tested at 1 % like the shift of one check, as all have the calibration's noise.
    """
    size = len(known.covariance)
    entries = [entry for entry in checks if entry.board == board and len(entry.right) == size]
    if len(entries) < FEWEST_FOR_TREND:
        return None
    days = np.array([entry.wall_s for entry in entries]) / 86400
    span = float(np.ptp(days))
    if span <= 0:
        return None
    # [X ⊕ δ at the middle, slope, the rest]; only what is known of the rest is a prior.
    N, right = np.zeros((size + 6, size + 6)), np.zeros(size + 6)
    N[12:, 12:] = known.prior(camera_may_have_moved=True).information[6:, 6:]
    for entry, day in zip(entries, days - days.mean(), strict=True):
        at = np.zeros((size, size + 6))
        at[:6, :6], at[:6, 6:12], at[6:, 12:] = np.eye(6), day * np.eye(6), np.eye(size - 6)
        evidence = _evidence(entry)
        N += at.T @ evidence.N @ at
        right += at.T @ evidence.right
    covariance = inverse_of(N)
    slope = (covariance @ right)[6:12]
    statistic = float(slope @ np.linalg.solve(covariance[6:12, 6:12], slope))
    if statistic <= limit(known.freedom, _TREND_P):
        return None
    millimetres = float(np.linalg.norm(slope[:3]) * 1e3 * span)
    degrees = float(np.degrees(np.linalg.norm(slope[3:])) * span)
    return Trend(millimetres, degrees, span, len(entries))
