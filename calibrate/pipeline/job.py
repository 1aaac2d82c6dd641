"""Offline job: a recording in, a solved and judged calibration out. No files are written here.

`prepare_views` finds boards, lens and board poses (`recorded_views`, `lens`), `solve_recording` solves
(`handeye`), judges (`gates`) and puts the calibration together (`document`). `pictures` does the same for
pictures and poses that a program holds.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import cv2
import msgspec
import numpy as np

from calibrate.arms.classes import ARM_CLASSES
from calibrate.boards.detect import Detection
from calibrate.boards.model import check_board, has_markers
from calibrate.errors import BadViewsError, CalibrationError, require_choice
from calibrate.files.calibration import Calibration
from calibrate.files.versions import who
from calibrate.handeye.blas_threads import one_blas_thread
from calibrate.handeye.cell_fit import STAGES
from calibrate.handeye.metrics import FEWEST_TO_SOLVE
from calibrate.handeye.priors import BoardTolerance, LensPrior
from calibrate.handeye.solution import Profile, Solution, SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.lens.intrinsics import Intrinsics, LensModel, calibrate_intrinsics
from calibrate.lens.pnp import solve_pnp, view_rms_px
from calibrate.pipeline.document import make_calibration
from calibrate.pipeline.gates import GateLimits, judge
from calibrate.pipeline.recorded_views import LoadedViews, Progress, load_views
from calibrate.pipeline.solved import Solved
from calibrate.results import AllViews, Excluded, Gate
from calibrate.views.projection import intrinsics_names
from calibrate.views.view_set import ViewSet
from recordings.geometry import difference
from recordings.reader import Recording, open_recording
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel

_MEDIAN_VIEW_PX = 20.0


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
    arm_class: str = ""
    """Class of the arm (`arms.classes`), instead of the recorded one or of looking it up by the model."""
    without: tuple[int, ...] = ()
    """Numbers, from 1, of the poses that a person leaves out."""
    threads: int | None = None
    """Threads of the board detection; the result does not depend on it."""

    def __post_init__(self) -> None:
        require_choice("profile", self.profile, get_args(Profile))
        require_choice("lens_model", self.lens_model, get_args(LensModel))
        if self.arm_class:
            require_choice("arm_class", self.arm_class, ARM_CLASSES)

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


@dataclass(frozen=True, eq=False)
class SolvedRecording(PreparedViews, Solved):
    calibration: Calibration
    solve_ms: float
    """Of everything, opening and detection included."""


@contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """OpenCV adds up in another order on every run when it uses its own threads."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


@single_threaded_opencv()
@one_blas_thread()
def prepare_views(
    path: Path,
    options: JobOptions | None = None,
    progress: Progress | None = None,
    fewest: int = FEWEST_TO_SOLVE,
    known: Mapping[int, Detection] | None = None,
) -> PreparedViews:
    """Open, find the boards, the lens where it is not known, and the board poses.

    known: pose number → what was seen in its picture, where that was looked at before.

    Raises RecordingError (unsealed, damaged) or CalibrationError; each says what to do next.
    """
    options = options or JobOptions()
    recording = open_recording(path)
    camera = options.camera
    if options.find_intrinsics:
        recorded = recording.info.camera
        camera = CameraModel(recorded.width, recorded.height)
    board = _board(options, recording.info.board)
    loaded = load_views(recording, board, camera, progress, options.threads, fewest, options.without, known)
    views, intrinsics = with_board_poses(loaded.views, loaded.board, options.lens_model)
    return PreparedViews(recording, loaded, views, intrinsics)


def with_board_poses(
    views: ViewSet, board: BoardSpec, model: LensModel = "plumb_bob"
) -> tuple[ViewSet, Intrinsics | None]:
    """Add `camera_from_board`, through the lens found from these views where the camera has none.

    Views without corners stay as they are. Raises CalibrationError where no lens explains the corners, or the
    given one does not.
    """
    if board.kind is BoardKind.UNSEEN:
        return views, None
    intrinsics = calibrate_intrinsics(views, model) if views.camera.matrix is None else None
    if intrinsics is not None:
        views = replace(views, camera=intrinsics.camera)
    views = solve_pnp(views, board)
    median = float(np.median([view_rms_px(v, views.camera, v.camera_from_board) for v in views]))  # type: ignore[arg-type]
    if not median <= _MEDIAN_VIEW_PX:
        raise BadViewsError("lens-misfit", median_px=median, limit_px=_MEDIAN_VIEW_PX)
    return views, intrinsics


def solver_options(options: JobOptions, prepared: PreparedViews) -> SolveOptions:
    return SolveOptions(
        profile=options.profile,
        seed=options.seed,
        intrinsics_from_same_pictures=prepared.intrinsics is not None,
        lens_sigma=_lens_sigma(options, prepared.views.camera),
        board=BoardTolerance.of(prepared.loaded.board),
        unmirrored=has_markers(prepared.loaded.board),
        working_distance_m=options.working_distance_m,
        robot_accuracy_m=options.robot_accuracy_m,
        robot_accuracy_rad=options.robot_accuracy_rad,
        arm_class=options.arm_class or prepared.recording.info.robot.arm_class,
    )


@single_threaded_opencv()
@one_blas_thread()
def solve_recording(
    path: Path,
    options: JobOptions | None = None,
    progress: Progress | None = None,
) -> SolvedRecording:
    """Solve and judge a recording. Raises RecordingError or CalibrationError; each says what to do next."""
    options = options or JobOptions()
    begun_s = time.perf_counter()
    prepared = prepare_views(path, options, progress)
    solution, gates = _judged(prepared, options)
    calibration = make_calibration(
        prepared.recording,
        prepared.loaded,
        prepared.views,
        prepared.intrinsics,
        solution,
        gates,
        options.chosen,
    )
    if options.without:
        excluded = Excluded(
            views=sorted({number - 1 for number in options.without}),
            who=who(),
            all_views=_all_views(path, options, prepared, calibration, progress),
        )
        calibration = msgspec.structs.replace(calibration, excluded=excluded)
    return SolvedRecording(
        **vars(prepared),
        solution=solution,
        gates=gates,
        calibration=calibration,
        solve_ms=1e3 * (time.perf_counter() - begun_s),
    )


def _judged(prepared: PreparedViews, options: JobOptions) -> tuple[Solution, tuple[Gate, ...]]:
    recording = prepared.recording
    solution = solve_views(prepared.views, solver_options(options, prepared))
    of_station = recording.info.source != "imported"
    return solution, judge(solution, options.limits, _clock_bound_s(recording, solution), of_station)


def _all_views(
    path: Path,
    options: JobOptions,
    prepared: PreparedViews,
    calibration: Calibration,
    progress: Progress | None,
) -> AllViews:
    """Solve once more with the views that a person excluded, and say what that gives.

    A person may exclude what cannot be solved at all: then the problem is what all views say.
    """
    STAGES.info("the same with all views, to compare")
    with_all = replace(options, without=())
    try:
        everything = prepare_views(path, with_all, progress, known=prepared.loaded.detections)
        solution, gates = _judged(everything, with_all)
    except CalibrationError as problem:
        return AllViews(problem=str(problem))
    figures = solution.judgement.figures
    evidence = solution.evidence
    excluded = {number - 1 for number in options.without}
    X, _ = solution.fit.installed
    return AllViews(
        error_mm=figures.predicted_error_mm,
        holdout_m=None if figures.holdout is None else figures.holdout.e_t_m,
        failed=[gate.name for gate in gates if not gate.passed],
        shift=tuple(difference(calibration.transform.matrix, X).tolist()),
        views=[view for view in evidence.residuals if view.index in excluded],
        weights=[view for view in evidence.views.weights if view.index in excluded],
    )


_FIXED = 1e-9
"""1σ of a number that the lens' calibration held fixed."""


def _lens_sigma(options: JobOptions, camera: CameraModel) -> tuple[float, ...] | None:
    """Take the stated 1σ; zero: held fixed, not stated: the usual one. None where none is stated."""
    stated = options.camera_sigma
    if options.camera is None or not any(sigma > 0 for sigma in stated.values()):
        return None
    usual = zip(intrinsics_names(camera), LensPrior.given(camera).sigma, strict=True)
    return tuple(max(stated.get(name, float(sigma)), _FIXED) for name, sigma in usual)


def _board(options: JobOptions, recorded: BoardSpec) -> BoardSpec:
    board = options.board or recorded
    if board.kind is BoardKind.UNSEEN and options.square_m is None:
        return board
    check_board(board)
    if options.square_m is not None:
        ratio = options.square_m / board.square_m
        marker_m = None if board.marker_m is None else board.marker_m * ratio
        board = msgspec.structs.replace(board, square_m=options.square_m, marker_m=marker_m)
        check_board(board)
    return board


def _clock_bound_s(recording: Recording, solution: Solution) -> float | None:
    used = set(solution.evidence.views.used)
    bounds = [v.time_bound_s for v in recording.views() if v.index in used and v.time_bound_s is not None]
    return max(bounds) if bounds else None
