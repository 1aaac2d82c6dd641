"""The choices of one offline run."""

from __future__ import annotations

from dataclasses import dataclass, field

from calibrate.handeye.solution import Profile
from calibrate.lens.intrinsics import LensModel
from calibrate.quality.gates import GateLimits
from recordings.schema.messages import BoardSpec, CameraModel


@dataclass(frozen=True)
class JobOptions:
    """What a person may choose for one run; recorded in the calibration's provenance."""

    profile: Profile = "robust"
    seed: int = 0
    board: BoardSpec | None = None
    """Instead of the recorded one."""
    square_m: float | None = None
    """Another size of square; a charuco board's markers and an april-grid's gaps grow with it."""
    camera: CameraModel | None = None
    """Known intrinsics, instead of the recorded ones or of finding them."""
    camera_sigma: dict[str, float] = field(default_factory=dict)
    """Their 1σ by parameter, where it is stated; else the usual 0.2 %."""
    lens_model: LensModel = "plumb_bob"
    find_intrinsics: bool = False
    """Find them from these pictures even where some are recorded."""
    limits: GateLimits = field(default_factory=GateLimits)
    accept_move: bool = False
    """Use both parts of a session in which camera or board was moved half-way."""
    working_distance_m: float | None = None
    without: tuple[int, ...] = ()
    """Numbers, from 1, of the poses that a person leaves out."""
    threads: int | None = None
