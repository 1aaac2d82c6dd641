"""Figures as SVG text, deterministic: the same input gives the same bytes."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

_BLUE, _RED, _ORANGE = "#0969da", "#b42318", "#bc4c00"
_STYLE: Any = {
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


def _axes() -> tuple[Figure, Axes]:
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(3.5, 1.9), layout="constrained")
        return figure, figure.subplots()


def _svg(figure: Figure) -> str:
    buffer = io.StringIO()
    with matplotlib.rc_context(_STYLE):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def by_view(values: Mapping[int, float], unit: str, limit: float | None = None) -> str:
    """A bar for each pose, the largest marked; the limit where it is near."""
    figure, axes = _axes()
    largest = max(values, key=lambda index: values[index])
    axes.bar(
        [index + 1 for index in values],
        list(values.values()),
        color=[_ORANGE if index == largest else _BLUE for index in values],
    )
    axes.set(xlabel="pose", ylabel=unit)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if limit is not None and values[largest] > 0.3 * limit:
        axes.axhline(limit, color=_RED, linewidth=1.5)
    return _svg(figure)


def shares(values: Mapping[str, float]) -> str:
    """A bar for each source with its share, the largest above."""
    figure, axes = _axes()
    bars = axes.barh(list(values), [100 * share for share in values.values()], color=_BLUE)
    axes.bar_label(bars, fmt="%.0f %%", padding=3)
    axes.set(xlim=(0, 118 * max(values.values())), xticks=[])
    axes.invert_yaxis()
    axes.grid(False)
    return _svg(figure)
