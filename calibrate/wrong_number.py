"""A recorded pose with one wrong number: a slip of typing, an axis that reads wrong. The other five count.

Errors of this kind are told from others by what is left when the number is ignored. Where most bad views are
wrong in other ways, those that look so are such errors that chance has laid along an axis.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from calibrate.geometry import Array

_AGREE = 0.99
"""Share of good views whose other five numbers pass for agreeing."""
_NAMES = ("x", "y", "z", "rotation about x", "rotation about y", "rotation about z")


def wrong_numbers(miss: Array, covariance: Array, freedom: float) -> dict[int, int]:
    """Bad view → the one wrong number of its pose, a place in [δt, δφ]. Empty unless half of them have one.

    `miss` (m, 6) of the bad views and its covariance (m, 6, 6), were they good, by scales known with
    `freedom` degrees of freedom.
    """
    numbers = (_wrong_number(*view, freedom) for view in zip(miss, covariance, strict=True))
    found = {place: number for place, number in enumerate(numbers) if number is not None}
    return found if 2 * len(found) >= len(miss) else {}


def _wrong_number(miss: Array, covariance: Array, freedom: float) -> int | None:
    """The only one without which the others agree."""
    left = np.empty(6)
    for number in range(6):
        others = np.delete(np.arange(6), number)
        left[number] = miss[others] @ np.linalg.solve(covariance[np.ix_(others, others)], miss[others])
    explains = np.flatnonzero(left <= 5 * stats.f.ppf(_AGREE, 5, freedom))
    return int(explains[0]) if len(explains) == 1 else None


def tell_wrong_number(miss: Array, number: int) -> str:
    """One sentence for people; `miss` (6,) in m and rad."""
    size = f"{np.degrees(abs(miss[number])):.3f}°" if number >= 3 else f"{abs(miss[number]) * 1e3:.2f} mm"
    return (
        f"only {_NAMES[number]} in base is off, by {size}: wrong pose, or the board was moved; "
        "the other five numbers agree and are used"
    )
