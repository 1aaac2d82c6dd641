"""Figures as SVG text, deterministic: the same input gives the same bytes."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeAlias

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from calibrate.geometry import Array
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
