"""Numbers as a caller gives them, copied to arrays of the shapes that are needed."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from calibrate.errors import BadViewsError
from recordings.geometry import Array


def array_of(values: ArrayLike, shape: tuple[int, ...], what: str) -> Array:
    """Copy numbers of this shape, -1: any length; masked: NaN. BadViewsError (`shape`) says what is wrong."""
    try:
        found: Array = np.ma.filled(np.ma.array(values, dtype=float, copy=True), np.nan)
    except (TypeError, ValueError):
        found = np.zeros(())
    if not found.size:
        found = found.reshape([max(size, 0) for size in shape]) if -1 in shape else found
    if found.ndim != len(shape) or any(a not in (-1, b) for a, b in zip(shape, found.shape, strict=True)):
        given, wanted = (str(s).replace("-1", "n") for s in (found.shape, shape))
        raise BadViewsError("shape", what=what, given=given, wanted=wanted)
    return found
