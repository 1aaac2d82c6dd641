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
FIELDS = (8, 6)
"""Columns and rows of fields into which the image is divided."""
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
"""Matplotlib's Axes."""
P = ParamSpec("P")


def drawn(width: float, height: float) -> Callable[[Callable[Concatenate[Axes, P], None]], Callable[P, str]]:
    """Make a function that fills axes one that returns them as SVG; sizes in inches."""

    def decorate(fill: Callable[Concatenate[Axes, P], None]) -> Callable[P, str]:
        @wraps(fill)
        def svg(*args: P.args, **named: P.kwargs) -> str:
            buffer = io.StringIO()
            with matplotlib.rc_context(STYLE):
                figure = Figure(figsize=(width, height), layout="constrained")
                fill(figure.subplots(), *args, **named)
                figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
            text = buffer.getvalue()
            return text[text.index("<svg") :]

        return svg

    return decorate


@drawn(4.6, 1.9)
def by_view(axes: Axes, values: Mapping[int, float], unit: str, limit: float | None = None) -> None:
    """A bar for each pose, the largest marked; the limit where it is near."""
    largest = max(values, key=lambda index: values[index])
    axes.bar(
        [index + 1 for index in values],
        list(values.values()),
        color=[_ORANGE if index == largest else _BLUE for index in values],
    )
    axes.set(xlabel="pose", ylabel=unit)
    axes.xaxis.get_major_locator().set_params(integer=True)
    if limit is not None and values[largest] > 0.3 * limit:
        axes.axhline(limit, color=_RED, linewidth=1.5)


@drawn(4.6, 1.9)
def shares(axes: Axes, values: Mapping[str, float]) -> None:
    """A bar for each source with its share, the largest above."""
    bars = axes.barh(list(values), [100 * share for share in values.values()], color=_BLUE)
    axes.bar_label(bars, fmt="%.0f %%", padding=3)
    axes.set(xlim=(0, 118 * max(values.values())), xticks=[])
    axes.invert_yaxis()
    axes.grid(False)


@drawn(4.6, 1.9)
def field_misses(axes: Axes, middles: Array, misses: Array, camera: CameraModel) -> None:
    """An arrow for each field of the image: mean miss (n, 2) px at `middles` (n, 2).

    A quarter of a pixel, or the largest where that is more, is as long as a field.
    """
    longest = max(0.25, float(np.linalg.norm(misses, axis=1).max(initial=0.0)))
    scale = longest * FIELDS[0] / camera.width
    axes.scatter(*middles.T, s=6, color=_GREY)
    axes.quiver(*middles.T, *misses.T, angles="xy", scale_units="xy", scale=scale, color=_ORANGE, width=0.006)
    axes.set(xlim=(0, camera.width), ylim=(camera.height, 0), xticks=[], yticks=[])
    axes.set_aspect("equal")
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(True)
