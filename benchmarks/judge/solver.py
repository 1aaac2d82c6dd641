"""The only door to what is judged: a cell goes in as the product's views, its answer comes out as numbers."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.judge.cell import COLUMNS, ROWS, Cell
from benchmarks.judge.frames import Array
from benchmarks.judge.lenses import Lens
from calibrate.errors import CalibrationError
from calibrate.handeye.solution import Reading, Solution, SolveOptions
from calibrate.handeye.solve import solve_views
from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.lens.pnp import solve_pnp
from calibrate.pipeline.gates import judge
from calibrate.pipeline.job import single_threaded_opencv
from calibrate.views.corners import Corners
from calibrate.views.projection import intrinsics_names
from calibrate.views.view_set import BoardView, ViewSet
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel, Mount

_CLASSES = {
    "UR": "universal-robots",
    "industrial six": "industrial-six",
    "seven joints": "seven-joints",
    "servo arm": "servo",
}
"""The judge's class of arms → what a user tells the product."""


@dataclass(frozen=True)
class Stated:
    """What the product says of a placed point, millimetres."""

    error_mm: float
    """Rms, at recorded postures."""
    workspace_mm: float
    """Rms, over the workspace."""
    at_m: float
    """Distance along the camera's axis for which it is said."""
    p95_mm: float | None = None
    """Distance that holds 95 of 100."""
    parts_mm: dict[str, float] = field(default_factory=dict)
    """Part → its rms."""
    arm: str = ""
    """Where the arm's error comes from."""


@dataclass(frozen=True, eq=False)
class Answer:
    """What the product answers to a cell."""

    refused: str
    """Why there is no calibration, as a code; empty where there is one."""
    closed: tuple[str, ...] = ()
    """Gates that are closed; one that names another reading has that after a colon."""
    X: Array | None = None
    """(4, 4) as it is installed."""
    covariance: Array | None = None
    """(6, 6) of X: [translation, rotation vector] in the parent's frame."""
    X_corrected: Array | None = None
    """(4, 4) beside a corrected arm; the same as X where the arm is taken as it is."""
    covariance_corrected: Array | None = None
    """(6, 6)"""
    threshold: float = 0.0
    """Of δᵀ C⁻¹ δ: what the stated 95 % region holds."""
    stated: Stated | None = None
    cpu_s: float = 0.0
    """Of the solve."""

    @property
    def passed(self) -> bool:
        """The verdict."""
        return not self.refused and not self.closed

    @property
    def named(self) -> str:
        """The code or the reading by which the recording is refused; empty where it is not."""
        reading = next((gate for gate in self.closed if gate.startswith("session:")), "")
        return self.refused or reading


def answer(cell: Cell) -> Answer:
    """Solve and judge a cell as the product's own command line would."""
    return _answer(cell, SolveOptions(arm_class=_told_class(cell)))


def answer_with_arm_told(cell: Cell, accuracy_m: float, accuracy_rad: float) -> Answer:
    """The same where the product is told the size of that arm's errors: 1σ per axis of the flange."""
    told = SolveOptions(
        arm_class=_told_class(cell),
        robot_accuracy_m=max(accuracy_m, 1e-6),
        robot_accuracy_rad=max(accuracy_rad, 1e-6),
    )
    return _answer(cell, told)


def _answer(cell: Cell, options: SolveOptions) -> Answer:
    begun_s = time.process_time()
    try:
        with single_threaded_opencv():
            views = _views(cell)
            options = replace(
                options,
                intrinsics_from_same_pictures=cell.given is None,
                lens_sigma=None if cell.given is None else _lens_sigma(views.camera, cell.given_told),
            )
            begun_s = time.process_time()
            solution = solve_views(views, options)
            cpu_s = time.process_time() - begun_s
            gates = judge(solution)
    except CalibrationError as problem:
        code = str(problem.values.get("hypothesis", problem.code))
        return Answer(code, cpu_s=time.process_time() - begun_s)
    except Exception as problem:
        # A fault of the product's is an answer, too, and must not end a night's run.
        return Answer(f"crash: {type(problem).__name__}", cpu_s=time.process_time() - begun_s)
    reading = solution.judgement.session.reading
    closed = tuple(
        f"session: {reading.value}" if gate.name == "session" and reading is not Reading.AS_RECORDED
        else gate.name
        for gate in gates
        if not gate.passed
    )  # fmt: skip
    X, covariance = solution.fit.installed
    threshold = solution.fit.confidence_threshold
    fit = solution.fit
    return Answer("", closed, X, covariance, fit.X, fit.covariance, threshold, _stated(solution), cpu_s)


def _stated(solution: Solution) -> Stated:
    """Today the error of X at the working distance stands for both; `point` has the arm's in it."""
    figures = solution.judgement.figures
    point = getattr(figures, "point", None)
    if point is None:
        error_mm = figures.predicted_error_mm or np.nan
        return Stated(error_mm, error_mm, figures.working_distance_m or 0.5)
    parts_mm = {
        name: float(getattr(point, f"{name}_mm"))
        for name in ("from_x", "from_arm", "from_board_lens", "floor")
        if getattr(point, f"{name}_mm", None) is not None
    }
    over_all = getattr(point, "workspace_mm", None)
    return Stated(
        float(point.error_mm),
        float(point.error_mm if over_all is None else over_all),
        float(point.at_m),
        getattr(point, "p95_mm", None),
        parts_mm,
        str(getattr(point, "arm", "")),
    )


def _views(cell: Cell) -> ViewSet:
    """The cell's views with the lens given or found, and the board's pose in each."""
    seen = tuple(
        BoardView(
            i,
            f"view {i + 1}",
            view.flange,
            Corners(view.points, view.pixels),
            view.joints if cell.name.joints else None,
        )
        for i, view in enumerate(cell.views)
    )
    mount: Mount = "eye-in-hand" if cell.world.in_hand else "eye-to-hand"
    camera = CameraModel(cell.lens.width, cell.lens.height)
    if cell.given is not None:
        camera = _camera(cell.given)
    views = ViewSet(mount, seen, camera, _told_arm(cell))
    if cell.given is None:
        views = replace(views, camera=calibrate_intrinsics(views, "plumb_bob").camera)
    board = BoardSpec(BoardKind.CHESSBOARD, COLUMNS, ROWS, cell.board_m)
    return solve_pnp(views, board)


def _told_class(cell: Cell) -> str:
    """The class as a user writes it; empty where nobody told it."""
    return _CLASSES[cell.name.arm] if cell.name.told else ""


def _told_arm(cell: Cell) -> str:
    """The arm's model as a user would write it. Without joints at most its class is told, lest the product
    finds the joints by a table that it knows."""
    model = cell.world.arm.model
    return model if cell.name.told and cell.name.joints and model.startswith("UR") else "unknown"


def _camera(lens: Lens) -> CameraModel:
    fx, fy = lens.focal_px
    cx, cy = lens.centre_px
    matrix = ((fx, 0.0, cx), (0.0, fy, cy), (0.0, 0.0, 1.0))
    return CameraModel(lens.width, lens.height, matrix, lens.distortion, lens.model)


def _lens_sigma(camera: CameraModel, share: float) -> tuple[float, ...]:
    """1σ of a given lens: `share` of the focal length, and of the width for the centre; its distortion is
    as well known as makers' calibrations are."""
    assert camera.matrix is not None
    focal_px = share * camera.matrix[0][0]
    centre_px = share * camera.width
    known = {"fx": focal_px, "fy": focal_px, "cx": centre_px, "cy": centre_px, "p1": 2e-4, "p2": 2e-4}
    return tuple(known.get(name, 0.002) for name in intrinsics_names(camera))
