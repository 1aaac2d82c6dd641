"""The answer of a solve as programs and notebooks use it: X, covariance, gates, residuals, their picture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from io import BytesIO
from typing import TYPE_CHECKING, Literal

import numpy as np

from calibrate.errors import BadViewsError, require_choice
from calibrate.handeye.reprojection import bent_points
from calibrate.handeye.solution import Solution
from calibrate.results import SHAPE, Gate
from calibrate.views.projection import project_at
from calibrate.views.view_set import BoardView, ViewSet, board_in_camera, observe_views
from recordings.geometry import Array
from recordings.schema.messages import CameraModel

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Solved:
    """X with its uncertainty, and what every picture says of it."""

    views: ViewSet
    """Pictures in which the board was found."""
    solution: Solution
    gates: tuple[Gate, ...]

    @property
    def passed(self) -> bool:
        return all(gate.passed for gate in self.gates)

    @property
    def X(self) -> Array:
        """flange_from_camera (eye-in-hand) or base_from_camera (eye-to-hand), (4, 4), metres.

        For the arm as it is, like a calibration file.
        """
        return self.solution.fit.installed[0]

    @property
    def lens(self) -> CameraModel:
        """The given lens or the one found, as the fit left it."""
        return self.solution.fit.camera

    def covariance(
        self, order: Literal["translation-rotation", "rotation-translation"] = "translation-rotation"
    ) -> Array:
        """Return the covariance (6, 6), m and rad, of [δt, δφ], or of [δφ, δt].

        X is Exp(δφ) times the estimate's rotation, and its translation plus δt: both in the axes of X's
        parent frame, as in ROS's PoseWithCovariance. GTSAM and Sophus perturb in the child's.
        """
        require_choice("order", order, ("translation-rotation", "rotation-translation"))
        shift = 3 * (order == "rotation-translation")
        return np.roll(self.solution.fit.installed[1], (shift, shift), (0, 1))

    @cached_property
    def residuals_px(self) -> dict[int, Array]:
        """Number of a picture → (k, 2): its corners less where calibration and recorded pose put them."""
        cell = self.solution.fit
        observed = observe_views(replace(self.views, views=self._as_read))
        shape = np.zeros(len(SHAPE)) if cell.board is None else cell.board.numbers
        points = bent_points(observed, shape)
        seen = board_in_camera(cell.mount, observed.flange, self.X, cell.board_place.matrix)
        return {
            view.index: view.corners.pixels - project_at(cell.camera, seen[i], points[i, : len(view.corners)])
            for i, view in enumerate(self._as_read)
        }

    @property
    def _as_read(self) -> tuple[BoardView, ...]:
        """The views with boards that look the same turned as the solver turned them."""
        kept = {view.index: view for view in self.solution.evidence.kept}
        return tuple(kept.get(view.index, view) for view in self.views)

    def plot(self) -> Figure:
        """Draw every residual, magnified, where it is in the image; a picture left out is red.

        Needs matplotlib (the extra `report`). Raises BadViewsError for pairs of poses without corners.
        """
        if not any(len(view.corners) for view in self.views):
            raise BadViewsError("no-corners")
        from matplotlib.figure import Figure

        class Shown(Figure):
            def _repr_png_(self) -> bytes:
                """Show it in a notebook, for which a bare Figure has no picture."""
                self.savefig(file := BytesIO())
                return file.getvalue()

        used, figure = set(self.solution.evidence.views.used), Shown(layout="constrained")
        pixels = np.concatenate([view.corners.pixels for view in self._as_read])
        missed = np.concatenate(list(self.residuals_px.values()))
        good = np.concatenate([[index in used] * len(miss) for index, miss in self.residuals_px.items()])
        rms = float(np.sqrt(np.square(missed[good]).sum(axis=1).mean()))
        longer = float(f"{self.lens.width / 40 / rms:.1g}")
        axes = figure.subplots()
        axes.quiver(
            *pixels.T,
            *missed.T * longer,
            angles="xy",
            scale_units="xy",
            scale=1,
            width=1.5e-3,
            color=np.where(good, "tab:blue", "tab:red"),
        )
        axes.set(xlim=(0, self.lens.width), ylim=(self.lens.height, 0), aspect="equal")
        axes.set_title(f"{rms:.2f} px rms over {len(used)} pictures, drawn {longer:g} times as long")
        return figure
