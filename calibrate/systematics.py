"""Systematic robot error: found in the residuals, said, and modelled so that the covariance stays true.

Two models of the same views: independent robot noise, and noise plus errors θ of the kinematic table with a
normal prior whose scale is fitted like the other noise scales. Twice the gain in restricted likelihood
decides what is said: under the null it is half a χ²(1), half zero, so the threshold's false alarm is about
1 in 1000. The second model counts long before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibrate.estimate import Estimate, estimate
from calibrate.geometry import Array
from calibrate.kinematics import JOINT_NAMES
from calibrate.likelihood.kinematics import displacement_by_joint
from calibrate.likelihood.model import Observations
from calibrate.likelihood.noise import restricted_deviance
from calibrate.likelihood.normal import PRIOR
from calibrate.solution import RobotSystematics

THRESHOLD = 9.55
POSSIBLE = 0.5
"""Above this errors of the table are allowed for, though they may be chance: simulated, the stated error of
arms whose errors nearly drown in the noise else was too small (coverage 65 … 88 %); good ones
lose 1 … 3 %."""
FEWEST_VIEWS = 8
"""Fewer cannot tell 24 parameters from noise."""


@dataclass(frozen=True, eq=False)
class KinematicFit:
    finding: RobotSystematics
    estimate: Estimate
    """With the kinematic model."""
    observed: Observations


def fit_kinematics(observed: Observations, plain: Estimate, derivatives: Array) -> KinematicFit:
    """`derivatives` (n, 6, 24) of the observed views; `plain` the estimate without them."""
    with_table = replace(observed, kinematics=derivatives)
    start = replace(plain.state, theta=np.zeros(derivatives.shape[2]))
    sigma = plain.sigma.copy()
    sigma[PRIOR] = 0.3
    kinematic = estimate(with_table, start, plain.intrinsics_free, sigma)
    gain = restricted_deviance(plain.normal, plain.sigma) - restricted_deviance(
        kinematic.normal, kinematic.sigma
    )
    moved_m = displacement_by_joint(derivatives, kinematic.state.theta)
    worst = int(np.argmax(moved_m))
    detected, possible = bool(gain > THRESHOLD), bool(gain > POSSIBLE)
    finding = RobotSystematics(
        detected=detected,
        possible=possible,
        statistic=float(gain),
        threshold=THRESHOLD,
        worst_joint=JOINT_NAMES[worst] if detected else "",
        worst_joint_rms_m=float(moved_m[worst]) if detected else 0.0,
        scale_mm=float(kinematic.sigma[PRIOR]),
        text=_text(detected, possible, JOINT_NAMES[worst], float(moved_m[worst]), kinematic),
    )
    return KinematicFit(finding, kinematic, with_table)


def _text(detected: bool, possible: bool, joint: str, rms_m: float, fit: Estimate) -> str:
    if not possible:
        return "The robot's residuals do not follow its joints."
    if not detected:
        return (
            "The robot's residuals follow its joints no more than chance may do: errors of about "
            f"{fit.sigma[PRIOR]:.2f} mm (or mrad) in its kinematic table are allowed for."
        )
    return (
        f"The robot's residuals follow its joints: errors of about {fit.sigma[PRIOR]:.2f} mm (or mrad) in "
        f"its kinematic table, most at the {joint} ({rms_m * 1e3:.2f} mm at the flange). "
        "Have the arm calibrated."
    )
