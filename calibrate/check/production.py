"""The drift check on pictures that are taken anyway, of one tag or small board that is fixed in the cell.

The earlier pictures are solved with the installed posterior as prior; the tag's place and the noise are
estimated from them. Then the newest ones, 3 to 30 of them, are tested for a shift of the camera against the
tag since. Errors of X, lens, arm and tag are the same before and after.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from calibrate.check.drift import DriftCheck, powers
from calibrate.errors import TooFewViewsError
from calibrate.handeye.cell_state import CellState, Layout
from calibrate.handeye.corner_fit import fit_corners
from calibrate.handeye.estimate import estimate
from calibrate.handeye.linear import Linear
from calibrate.handeye.mixture import GAIN, class_chances, expected
from calibrate.handeye.noise_scales import Scales
from calibrate.handeye.posterior import KnownCell
from calibrate.handeye.uncertainty import inverse_of
from calibrate.views.view_set import ViewSet, require_no_copies
from recordings.geometry import Array

EARLIER, MOST_EARLIER = 60, 300
"""Fewest and most earlier pictures."""
MOST_PICTURES = 1000
"""Newest pictures of a folder that are looked at; not every one shows the tag."""
NEWEST = (3, 5, 10, 20, 30)
"""Numbers of newest pictures that are tested, each for itself."""
FALSE_ALARM = 1e-6
"""Of one test: a cell is looked at again with every picture, for years."""
_STILL = np.repeat([0.03e-3, np.radians(0.003)], 3)
"""1σ of the camera's thermal motion in a sound cell; it does not count as a shift."""
_ROUNDS = 10
"""Rounds of expectation and maximisation for one test."""
_MANY = 1e6
"""Degrees of freedom of noise that hundreds of pictures tell."""


@dataclass(frozen=True, eq=False)
class EarlierPictures:
    """What the earlier pictures tell of the cell, the tag's pose included."""

    known: KnownCell
    state: CellState
    covariance: Array
    """(G, G) in the order of `Layout`."""
    scales: Scales

    @classmethod
    def of(cls, views: ViewSet, known: KnownCell) -> EarlierPictures:
        """Solve them. Raises TooFewViewsError, BadViewsError."""
        if len(views) < EARLIER:
            raise TooFewViewsError(
                views=len(views),
                needed=EARLIER + NEWEST[0],
                counted=f"{len(views)} earlier pictures with the tag",
                advice="Go on taking pictures.",
            )
        known = known.beside(views)
        prior = known.prior(camera_may_have_moved=False)
        observed, start = known.observe(views), known.start(views)
        # Errors of an arm without joints count as its noise here: no picture may begin as an outlier.
        wide = Linear.at(observed, start, observed.present).first_scales()
        scales = replace(known.scales, robot=wide.robot, shares=wide.shares)
        found = estimate(observed, start, prior, scales, fit="robot")
        return cls(known, found.state, found.covariance, found.scales)

    def test(self, newest: ViewSet) -> DriftCheck:
        """Test the newest pictures, oldest first; return the clearest of the tests by `NEWEST`."""
        observed = self.known.observe(newest)
        C = newest.camera_from_board
        C = fit_corners(observed, self.state.camera, C, shape=self.state.shape, robust=True).C
        linear = Linear.at(observed, replace(self.state, C=C), observed.present)
        tests = [self._shift(linear, count) for count in NEWEST if count <= len(newest)]
        return min(tests, key=lambda test: test.p_value)

    def _shift(self, linear: Linear, count: int) -> DriftCheck:
        """Test the last `count` pictures by how much likelier they are with a shift than without.

        Residual = m + J u + J_X δ, u from before, δ the shift since. Twice the gain in log likelihood follows
        χ²(6). Whole pictures are blurred, so their corners are as many times as noisy as the robot.
        """
        at = Layout.of(self.state)
        J = np.concatenate([linear.J, linear.J[..., at.X]], axis=2)[-count:]
        S, _ = linear.noise(self.scales)
        S[:, :-1] = GAIN[:, None, None] ** 2 * S[:, :1]
        still, free = np.zeros((2, at.size + 6, at.size + 6))
        free[: at.size, : at.size] = still[: at.size, : at.size] = inverse_of(self.covariance)
        still[-6:, -6:] = np.diag(_STILL**-2.0)
        without, _, _ = self._likelihood(linear.m[-count:], J, S[-count:], still)
        likelihood, step, covariance = self._likelihood(linear.m[-count:], J, S[-count:], free)
        statistic, threshold = 2 * (likelihood - without), float(special.chdtri(6, FALSE_ALARM))
        shift, covariance = step[-6:], covariance[-6:, -6:] + np.diag(_STILL**2)
        power_translation, power_rotation = powers(covariance, _MANY, FALSE_ALARM)
        return DriftCheck(
            passed=statistic <= threshold,
            shift=shift,
            covariance=covariance,
            statistic=statistic,
            threshold=threshold,
            p_value=float(special.chdtrc(6, max(statistic, 0.0))),
            power_translation=power_translation,
            power_rotation=power_rotation,
            views_needed=None,
            disagreement=0.0,
            views=count,
            arm_known=self.known.knows_arm,
        )

    def _likelihood(self, m: Array, J: Array, S: Array, before: Array) -> tuple[float, Array, Array]:
        """Maximise over x the likelihood of residuals m + J x times a normal prior of x about 0.

        S: (n, K, 6, 6) covariance of a residual in each noise class; before: (g, g) information of the prior.
        Returns the logarithm of the maximum, x, and its covariance. The search begins at x = 0, so that one
        blurred picture among three does not begin as the right one.
        """
        S_inverse, residual = np.asarray(np.linalg.inv(S), dtype=float), m
        for _ in range(_ROUNDS):
            chances, _ = class_chances(residual, S, S_inverse, self.scales.shares)
            WJ = expected(chances, S_inverse) @ J
            covariance = inverse_of(before + np.einsum("nia,nib->ab", J, WJ))
            step = -covariance @ np.einsum("nia,ni->a", WJ, m)
            residual = m + J @ step
        _, density = class_chances(residual, S, S_inverse, self.scales.shares)
        return float(density.sum() - 0.5 * step @ before @ step), step, covariance


def check_production(views: ViewSet, known: KnownCell) -> DriftCheck:
    """Test the newest of all pictures, oldest first, against those before.

    Each is of a stop of its own: those of one stop share its error of the robot. Raises as
    `EarlierPictures.of`, and BadViewsError for a picture that is there twice.
    """
    require_no_copies(views)
    known, newest = known.beside(views), min(NEWEST[-1], max(NEWEST[0], len(views) - EARLIER))
    earlier = replace(views, views=views.views[:-newest][-MOST_EARLIER:])
    return EarlierPictures.of(earlier, known).test(replace(views, views=views.views[-newest:]))
