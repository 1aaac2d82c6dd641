"""Results of the solver that the calibration file keeps as they are; their fields are keys of the file."""
# ruff: noqa: N815  (e_t and e_R are written as the paper writes them)

from __future__ import annotations

import msgspec


class RejectedView(msgspec.Struct, frozen=True, omit_defaults=True):
    index: int
    """Pose number of the session, from 0."""
    name: str
    reason: str
    """For people."""
    kind: str = ""
    """wrong-pose, wrong-number, inconsistent, corners, unreadable-picture, by-hand."""
    belongs_to: int | None = None
    """Pose number of the view whose recorded pose belongs to this image (wrong-pose)."""
    wrong_number: int | None = None
    """Place in [δt, δφ] of the only wrong number of its recorded pose."""
    slip: float = 0.0
    """Recorded minus true of that number, metres or radians."""


class HoldoutScore(msgspec.Struct, frozen=True, omit_defaults=True):
    """Equations 24 to 26 of the paper on pairs that took no part in the fit."""

    e_t_m: float
    """Mean translation error."""
    e_R: float
    """Mean spectral norm of the rotation error."""
    samples_e_t_m: list[float]
    """Per held-out pair."""
    samples_e_R: list[float]
    pairs: list[tuple[int, int]]
    """Pose numbers (earlier, later) of the held-out pairs."""
    fitted_views: int
    note: str = ""


class BoardShape(msgspec.Struct, frozen=True):
    """Shape of the board by the views, with 1σ each; see `handeye.observations.SHAPE`."""

    scale: float
    """True over stated size, minus 1."""
    anisotropy: float
    """x against y of the print."""
    bend_m: tuple[float, float, float]
    sigma: tuple[float, float, float, float, float]
