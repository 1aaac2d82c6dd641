"""Figures as SVG text, deterministic: the same input gives the same bytes."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeAlias

import cv2
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from calibrate.geometry import Array
from calibrate.lens.uncertainty import LensUncertainty
from calibrate.projection import camera_matrix, undistort
from calibrate.views import ViewSet
from recordings.schema.messages import CameraModel

_BLUE, _RED, _GREY, _ORANGE = "#0969da", "#b42318", "#8c959f", "#bc4c00"
_DPI = 120
"""Resolution of clouds of points, which would be most of the page as lines."""
STYLE: Any = {
    "svg.hashsalt": "report",
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#eaeef2",
    "axes.axisbelow": True,
}


Axes: TypeAlias = Any
"""Matplotlib's Axes, or an array of them."""
P = ParamSpec("P")


def drawn(
    width: float, height: float, columns: int = 1, *, grid: bool = True
) -> Callable[[Callable[Concatenate[Axes, P], None]], Callable[P, str]]:
    """Make a function that fills axes one that returns them as SVG; sizes in inches."""

    def decorate(fill: Callable[Concatenate[Axes, P], None]) -> Callable[P, str]:
        @wraps(fill)
        def svg(*args: P.args, **named: P.kwargs) -> str:
            buffer = io.StringIO()
            with matplotlib.rc_context(STYLE | {"axes.grid": grid}):
                figure = Figure(figsize=(width, height), layout="constrained")
                fill(figure.subplots(1, columns), *args, **named)
                figure.savefig(buffer, format="svg", dpi=_DPI, metadata={"Date": None, "Creator": None})
            text = buffer.getvalue()
            return text[text.index("<svg") :]

        return svg

    return decorate


@drawn(10, 2.6, 2)
def residuals_by_view(
    axes: Axes, residual_px: Mapping[int, float], robot_mm: Mapping[int, float], limit_px: float | None
) -> None:
    """Bars per pose: RMS of the corners, and pose residual of the robot."""
    for axis, values, unit in (
        (axes[0], residual_px, "corners, px rms"),
        (axes[1], robot_mm, "robot, mm"),
    ):
        axis.bar([str(k + 1) for k in values], list(values.values()), color=_BLUE)
        axis.set_xlabel("pose")
        axis.set_ylabel(unit)
        axis.tick_params(axis="x", labelsize=7)
    if limit_px is not None and residual_px and max(residual_px.values()) > 0.3 * limit_px:
        axes[0].axhline(limit_px, color=_RED, linewidth=1)


@drawn(10, 3.8, 2)
def held_out_over_workspace(axes: Axes, flange_m: Array, without_m: Array, with_table_m: Array) -> None:
    """Held-out error without and with the arm's table (n,) where the flange stood (n, 3), from two sides."""
    largest = float(np.nanmax([without_m, with_table_m], initial=1e-6))
    away = np.hypot(flange_m[:, 0], flange_m[:, 1])
    for axis, x, y, names in (
        (axes[0], flange_m[:, 0], flange_m[:, 1], ("x of base, m", "y of base, m")),
        (axes[1], away, flange_m[:, 2], ("distance from the base's axis, m", "z of base, m")),
    ):
        for miss, colour, label in (
            (without_m, _ORANGE, "without"),
            (with_table_m, _BLUE, "with the table"),
        ):
            size = 300 * np.nan_to_num(miss) / largest
            axis.scatter(x, y, s=size, facecolors="none", edgecolors=colour, linewidths=1.3, label=label)
        axis.set(xlabel=names[0], ylabel=names[1], aspect="equal", adjustable="datalim")
        axis.margins(0.2)
    beside = {"loc": "center left", "bbox_to_anchor": (1.02, 0.5)}
    title = f"area: error,\nlargest {1e3 * largest:.2f} mm"
    axes[1].legend(fontsize=8, markerscale=0.5, title=title, **beside)


@drawn(10, 3.6, 2)
def residual_scatter(axes: Axes, misses: Array, pixels: Array, camera: CameraModel) -> None:
    """Residuals of the corners (n, 2) px: round zero, and over the image as arrows."""
    reach = float(np.abs(misses).max(initial=1e-3)) * 1.05
    axes[0].scatter(misses[:, 0], misses[:, 1], s=3, color=_BLUE, alpha=0.5, linewidths=0, rasterized=True)
    axes[0].set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="x miss, px", ylabel="y miss, px")
    axes[0].set_aspect("equal")
    sigma = float(np.sqrt(np.square(misses).mean()))
    angle = np.linspace(0, 2 * np.pi, 100)
    for k in (1, 2, 3):
        axes[0].plot(k * sigma * np.cos(angle), k * sigma * np.sin(angle), color=_RED, linewidth=1)
    keep = np.linspace(0, len(pixels) - 1, min(len(pixels), 1500)).astype(int)
    axes[1].quiver(
        pixels[keep, 0],
        pixels[keep, 1],
        misses[keep, 0],
        misses[keep, 1],
        angles="xy",
        color=_BLUE,
        width=0.0015,
        rasterized=True,
    )
    axes[1].set(xlim=(0, camera.width), ylim=(camera.height, 0), xlabel="x, px", ylabel="y, px")
    axes[1].set_aspect("equal")


@drawn(10, 0.95, grid=False)
def error_shares(axis: Axes, shares: Mapping[str, float]) -> None:
    """One bar: where the error of X comes from."""
    colours = (_BLUE, _ORANGE, "#1a7f37", "#8250df", _GREY, "#d4a72c")[: len(shares)]
    left = 0.0
    for (name, share), colour in zip(shares.items(), colours, strict=True):
        axis.barh([0], [share], left=[left], color=colour, label=f"{name.replace('_', ' ')} {share:.0%}")
        left += share
    axis.set_axis_off()
    axis.figure.legend(loc="outside lower center", ncols=6, fontsize=8, frameon=False)


@drawn(10, 3.4, 2, grid=False)
def coverage_map(axes: Axes, views: ViewSet) -> None:
    """Image coverage by boards and corners, and the distortion curve."""
    camera = views.camera
    seen = np.zeros((camera.height // 8 + 1, camera.width // 8 + 1), np.float32)
    for view in views:
        mask = np.zeros(seen.shape, np.uint8)
        cv2.fillConvexPoly(mask, cv2.convexHull((view.pixels / 8).astype(np.float32)).astype(np.int32), 1)
        seen += mask
    extent = (0, camera.width, camera.height, 0)
    shown = axes[0].imshow(seen, extent=extent, cmap="Blues", interpolation="nearest")
    axes[0].figure.colorbar(shown, ax=axes[0], label="views", ticks=MaxNLocator(integer=True))
    for view in views:
        axes[0].plot(view.pixels[:, 0], view.pixels[:, 1], ".", markersize=1, color=_ORANGE, rasterized=True)
    axes[0].set(xlim=(0, camera.width), ylim=(camera.height, 0), xlabel="x, px", ylabel="y, px")
    _distortion_curve(axes[1], camera)


def _distortion_curve(axis: Any, camera: CameraModel) -> None:
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]], float)
    centre = camera_matrix(camera)[:2, 2]
    far = corners[np.linalg.norm(corners - centre, axis=1).argmax()]
    ray = centre + np.linspace(0.01, 1, 60)[:, None] * (far - centre)
    shift = np.linalg.norm(undistort(camera, ray) - centre, axis=1) - np.linalg.norm(ray - centre, axis=1)
    axis.plot(np.linalg.norm(ray - centre, axis=1), shift, color=_BLUE)
    axis.axhline(0, color=_GREY, linewidth=0.7)
    axis.set(xlabel="distance from the principal point, px", ylabel="distortion removed, px")


@drawn(6, 3.6, grid=False)
def uncertainty_map(axis: Axes, known: LensUncertainty, views: ViewSet) -> None:
    """SVG: 1σ in pixels over the picture, with the corners that fixed the lens."""
    camera, grid = known.camera, known.sigma_px
    u, v = np.linspace(0, camera.width, grid.shape[1]), np.linspace(0, camera.height, grid.shape[0])
    filled = axis.contourf(u, v, grid, levels=10, cmap="YlOrBr")
    axis.figure.colorbar(filled, ax=axis, label="1σ, px")
    for view in views:
        axis.plot(view.pixels[:, 0], view.pixels[:, 1], ".", markersize=1, color="#0969da", rasterized=True)
    axis.set(xlim=(0, camera.width), ylim=(camera.height, 0), xlabel="x, px", ylabel="y, px")
    axis.set_aspect("equal")
