"""The figures in docs/contributor/solver.md, written out: whoever changes a constant changes the page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibrate.check import drift
from calibrate.handeye import arm, arm_fit, corner_modes, linear, mixture, noise_scales, priors, readings
from calibrate.handeye.axxb import certificate, paper
from calibrate.handeye.axxb.pairs import MAX_PAIRS

PAGE = (Path(__file__).parents[3] / "docs/contributor/solver.md").read_text()


@pytest.mark.parametrize(
    ("figure", "value", "said"),
    [
        (paper.WEIGHT, 1.0, "w = 1 rad²/m²"),
        (paper.SETTINGS.factor, 0.5, "mutant = p1 + 0.5 (p2 − p3)"),
        (paper.SETTINGS.crossover, 0.9, "crossover 0.9"),
        (paper.SETTINGS.population, 30, "30 candidates"),
        (paper.SETTINGS.generations, 100, "100 generations"),
        (paper.BOX, [np.pi / 2] * 3 + [1.0] * 3, "|γ| ≤ π/2,  |b| ≤ 1 m per component"),
        (certificate.FLOOR, 1e-8, "max(f, 1e-8 tr reduced)"),
        (certificate.TOLERANCE, 1e-6, "certified at ≤ 1e-6"),
        (len(certificate._constraints()), 20, "With the 20 independent equations"),
        (MAX_PAIRS, 20_000, "thinned above 20 000"),
        (corner_modes.STUDENT, 8.0, "corner weight = (8 + 2) / (8 + r²/σ²)"),
        (mixture.GAIN, [1, 3, 10], "g = 1, 3, 10"),
        ([mixture.GARBAGE_M, mixture.GARBAGE_RAD], [0.3, 1.0], "garbage: 0.3 m, 1 rad"),
        (noise_scales._USUAL_ROBOT, [1e-4, np.radians(0.02)], "s₀ = 0.1 mm, 0.02°"),
        (priors.BoardTolerance().square, 0.003, "`square_tolerance` (0.3 %)"),
        (priors.BoardTolerance().flatness_m, 0.001, "`flatness_m` (1 mm)"),
        (priors._KNOWN_SHARE, 0.002, "0.2 % of focal length and width"),
        (priors.ASPECT_SIGMA, 0.001, "pixels square to 0.1 %"),
        (linear.MAX_STEPS, 15, "At most 15 linearisations"),
        (len(arm.FLEX), 9, "and 9 numbers of a bracket's compliance"),
        (arm_fit.SIZES[[0, -1]], [0.0075, 3.84], "ten sizes from 0.0075 to 3.84 mm and mrad"),
        ([arm_fit.RIGID, arm_fit.BENDS[-1]], [0.5, 1.6], "a rigid bracket counts one half, others up to 1.6"),
        (readings._CLEAR, 10.0, "10 + ln n more"),
        (drift.FALSE_ALARM, 0.05, "F⁻¹(0.95; 6, ν)"),
        ([drift.SHIFT_M, np.degrees(drift.TURN_RAD)], [0.5e-3, 0.1], "shift = 0.5 mm or 0.1°"),
    ],
)
def test_a_figure_is_the_one_on_the_page(figure: object, value: object, said: str) -> None:
    assert figure == pytest.approx(value)
    assert said in PAGE
