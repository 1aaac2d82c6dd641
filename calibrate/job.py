"""What an offline job is given, and what it makes of a recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, get_args

import msgspec

from calibrate.errors import require_choice
from calibrate.files.calibration import Calibration
from calibrate.gates import GateLimits
from calibrate.handeye.solution import Profile, Solution
from calibrate.lens.intrinsics import Intrinsics, LensModel
from calibrate.recorded_views import LoadedViews
from calibrate.results import Gate
from calibrate.views import ViewSet
from recordings.reader import Recording
from recordings.schema.messages import BoardSpec, CameraModel


@dataclass(frozen=True)
class JobOptions:
    """Choices of one offline run; recorded in the calibration's provenance."""

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
    working_distance_m: float | None = None
    robot_accuracy_m: float | None = None
    """1σ per axis of an error of the flange that all views share, for an arm that nothing else describes."""
    robot_accuracy_rad: float | None = None
    without: tuple[int, ...] = ()
    """Numbers, from 1, of the poses that a person leaves out."""
    threads: int | None = None
    """Threads of the board detection; the result does not depend on it."""

    def __post_init__(self) -> None:
        require_choice("profile", self.profile, get_args(Profile))
        require_choice("lens_model", self.lens_model, get_args(LensModel))

    @property
    def chosen(self) -> dict[str, Any]:
        """The choices that differ from the defaults, as plain values; profile and seed stand elsewhere."""
        default = JobOptions()
        return {
            name: msgspec.to_builtins(value)
            for name, value in vars(self).items()
            if name not in ("threads", "profile", "seed") and value != getattr(default, name)
        }


@dataclass(frozen=True, eq=False)
class PreparedViews:
    """A recording's views with lens and board poses: what every solver starts from."""

    recording: Recording
    loaded: LoadedViews
    views: ViewSet
    intrinsics: Intrinsics | None
    """Estimated intrinsics; None when they were given."""
    stage_ms: dict[str, float]


@dataclass(frozen=True, eq=False)
class SolvedRecording(PreparedViews):
    solution: Solution
    coverage: float
    gates: tuple[Gate, ...]
    calibration: Calibration

    @property
    def passed(self) -> bool:
        return all(gate.passed for gate in self.gates)
