"""Views: a robot pose with the board's points seen in one image. The solver's input."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibrate.arms.kinematics import RobotModel
from calibrate.errors import BadViewsError, require_choice
from calibrate.views.arrays import array_of
from calibrate.views.corners import NO_CORNERS, Corners
from recordings.geometry import Array, inverse
from recordings.schema.messages import CameraModel, Mount

NOMINAL_CAMERA = CameraModel(640, 480, ((600.0, 0.0, 320.0), (0.0, 600.0, 240.0), (0.0, 0.0, 1.0)))
"""Stands in where no picture shows the board: its poses were told."""


def require_mount(mount: object) -> None:
    require_choice("mount", mount, get_args(Mount))


def require_size(camera: CameraModel, size: tuple[int, int], index: int, name: str) -> None:
    """Raise BadViewsError for an image of another size (width, height) than the camera's."""
    if size != (camera.width, camera.height):
        expected, (width, height) = f"{camera.width}×{camera.height}", size
        raise BadViewsError(
            "image-size", view=index + 1, name=name, width_px=width, height_px=height, expected=expected
        )


@dataclass(frozen=True, eq=False)
class BoardView:
    """One image of the board: robot pose, detected corners, and the board pose once it is known."""

    index: int
    """Pose number in the session, as people see it."""
    name: str
    base_from_flange: Array
    """(4, 4)"""
    corners: Corners
    """What the detector measured, in pixels of the camera's whole image; `NO_CORNERS` of a board pose that
    was told."""
    joints_rad: Array | None = None
    """(k,) of `JOINTS`, or None where no joints were recorded."""
    camera_from_board: Array | None = None
    """(4, 4) PnP, once intrinsics are known."""

    def __post_init__(self) -> None:
        itself = f"view {self.index + 1} ({self.name})"
        for name, shape in _SHAPES.items():
            if (given := getattr(self, name)) is not None:
                object.__setattr__(self, name, array_of(given, shape, f"{name} of {itself}"))
        object.__setattr__(self, "corners", self.corners.checked(itself))
        if self.joints_rad is not None and len(self.joints_rad) not in JOINTS:
            raise BadViewsError(
                "shape",
                what=f"joints_rad of {itself}",
                given=f"({len(self.joints_rad)},)",
                wanted=f"({JOINTS[0]},) to ({JOINTS[-1]},)",
            )


JOINTS = range(5, 8)
"""How many joints an arm may have."""
_SHAPES = {
    "base_from_flange": (4, 4),
    "joints_rad": (-1,),
    "camera_from_board": (4, 4),
}


@dataclass(frozen=True, eq=False)
class ViewSet:
    """All views of a session, in capture order, of one camera and one board."""

    mount: Mount
    views: tuple[BoardView, ...]
    camera: CameraModel
    """matrix is None until intrinsics are known."""
    robot_model: str = "unknown"
    arm: RobotModel | None = None
    """The arm's table as its maker calibrated it; None: the published one of `robot_model`."""

    def __post_init__(self) -> None:
        require_mount(self.mount)

    @classmethod
    def from_poses(cls, mount: Mount, base_from_flange: ArrayLike, camera_from_board: ArrayLike) -> ViewSet:
        """Make views without corners from poses (n, 4, 4); a nominal camera stands in for the real one."""
        flange = array_of(base_from_flange, (-1, 4, 4), "base_from_flange")
        boards = array_of(camera_from_board, flange.shape, "camera_from_board")
        views = (
            BoardView(i, f"view {i}", F, NO_CORNERS, camera_from_board=C)
            for i, (F, C) in enumerate(zip(flange, boards, strict=True))
        )
        return cls(mount, tuple(views), NOMINAL_CAMERA)

    def __len__(self) -> int:
        return len(self.views)

    def __iter__(self) -> Iterator[BoardView]:
        return iter(self.views)

    def select(self, positions: list[int]) -> ViewSet:
        """Select the views at these places in the tuple (not pose numbers)."""
        return replace(self, views=tuple(self.views[i] for i in positions))

    @property
    def base_from_flange(self) -> Array:
        """(n, 4, 4)"""
        return np.array([v.base_from_flange for v in self.views]).reshape(-1, 4, 4)

    @property
    def camera_from_board(self) -> Array:
        """(n, 4, 4); ValueError while a view has no PnP pose yet."""
        if any(v.camera_from_board is None for v in self.views):
            raise ValueError("camera_from_board is not known yet: run PnP first")
        return np.array([v.camera_from_board for v in self.views]).reshape(-1, 4, 4)


def require_no_copies(views: ViewSet) -> None:
    """Raise BadViewsError for a view that is in the set twice: it tells nothing, and halves the variance."""
    first: dict[bytes, BoardView] = {}
    for view in views:
        seen = view.corners.pixels if len(view.corners) else np.asarray(view.camera_from_board)
        key = view.base_from_flange.tobytes() + seen.tobytes()
        if key in first:
            other = first[key]
            raise BadViewsError(
                "view-twice",
                view=view.index + 1,
                name=view.name,
                other=other.index + 1,
                other_name=other.name,
            )
        first[key] = view


Places = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Observations:
    """All views as the solver works on them, one row a view: made of their `Corners`, padded alike."""

    mount: Mount
    flange: Array
    """(n, 4, 4) recorded base_from_flange."""
    points: Array
    """(n, k, 3) corners on the board, metres; rows beyond a view's own corners are padding."""
    pixels: Array
    """(n, k, 2)"""
    present: Array
    """(n, k) 1 for a corner, 0 for padding."""
    by_arm_errors: Array
    """(n, 6, q) motion of the flange, in base, by each modelled error of arm and bracket."""
    extent: Array = field(default_factory=lambda: np.array([[0.0, 0.0], [1.0, 1.0]]))
    """(2, 2) middle and half size of all corners seen, metres: what the board's bends refer to."""

    def __len__(self) -> int:
        return len(self.flange)

    @property
    def has_pixels(self) -> bool:
        return bool(self.present.any())

    def part(self, places: Places) -> Observations:
        """Select these views."""
        return replace(
            self,
            flange=self.flange[places],
            points=self.points[places],
            pixels=self.pixels[places],
            present=self.present[places],
            by_arm_errors=self.by_arm_errors[places],
        )


def observe_views(views: ViewSet) -> Observations:
    """Pad the views' corners to one array, without errors of the arm."""
    count = max(1, max(len(view.corners) for view in views))
    n = len(views)
    points, pixels, present = np.zeros((n, count, 3)), np.zeros((n, count, 2)), np.zeros((n, count))
    for i, view in enumerate(views):
        k = len(view.corners)
        points[i, :k] = view.corners.points
        pixels[i, :k] = view.corners.pixels
        present[i, :k] = 1.0
    extent = extent_of(points[present > 0]) if present.any() else np.array([[0.0, 0.0], [1.0, 1.0]])
    by_none = np.zeros((n, 6, 0))
    return Observations(views.mount, views.base_from_flange, points, pixels, present, by_none, extent)


def extent_of(points: Array) -> Array:
    """Compute middle and half size (2, 2), metres, of points (m, 3) on the board."""
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    return np.stack([(low + high) / 2, np.maximum((high - low) / 2, 1e-6)])


def implied_flange(mount: Mount, X: Array, Y: Array, C: Array) -> Array:
    """Compute base_from_flange (n, 4, 4): Y C⁻¹ X⁻¹ (eye-in-hand) or X C Y⁻¹ (eye-to-hand)."""
    if mount == "eye-in-hand":
        return np.asarray(Y @ inverse(C) @ inverse(X))
    return np.asarray(X @ C @ inverse(Y))


def board_in_camera(mount: Mount, flange: Array, X: Array, Y: Array) -> Array:
    """Predict camera_from_board (..., 4, 4) of base_from_flange (..., 4, 4): (F X)⁻¹ Y, or X⁻¹ F Y."""
    return np.asarray(inverse(flange @ X) @ Y if mount == "eye-in-hand" else inverse(X) @ flange @ Y)
