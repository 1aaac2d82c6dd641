"""Rate and gaps of a stream whose stamps come block by block."""

from __future__ import annotations

import numpy as np

from recordings.streams import Steps


def test_the_median_of_steps_is_theirs() -> None:
    rng = np.random.default_rng(3)
    stamps_s = np.cumsum(rng.exponential(0.002, 20_001))
    steps = Steps()
    for block in np.array_split(stamps_s, 7):
        steps.add(block)
    real = np.diff(stamps_s)
    assert steps.count == len(real)
    assert abs(steps.median_s() / np.median(real) - 1) < 1e-3
    assert abs(steps.longer_than(0.01)[0] - (real > 0.01).sum()) < 20
    assert steps.longer_than(0.01)[1] == real.max()
    steps.begin()
    steps.add(np.array([0.0, 1.0, 0.5]))
    assert (steps.count, steps.backward) == (len(real) + 2, 1)
