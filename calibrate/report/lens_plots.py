"""How well the lens is known, drawn over the picture."""

from __future__ import annotations

import matplotlib
import numpy as np

from calibrate.lens.uncertainty import LensUncertainty
from calibrate.report.plots import STYLE, new_figure, svg_text
from calibrate.views import ViewSet


def uncertainty_map(known: LensUncertainty, views: ViewSet) -> str:
    """SVG: 1σ in pixels over the picture, with the corners that fixed the lens."""
    camera, grid = known.camera, known.sigma_px
    u, v = np.linspace(0, camera.width, grid.shape[1]), np.linspace(0, camera.height, grid.shape[0])
    with matplotlib.rc_context(STYLE | {"axes.grid": False}):
        figure, axis = new_figure(6, 3.6)
        filled = axis.contourf(u, v, grid, levels=10, cmap="YlOrBr")
        figure.colorbar(filled, ax=axis, label="1σ, px")
        for view in views:
            axis.plot(view.pixels[:, 0], view.pixels[:, 1], ".", markersize=1, color="#0969da")
        axis.set(xlim=(0, camera.width), ylim=(camera.height, 0), xlabel="x, px", ylabel="y, px")
        axis.set_aspect("equal")
        return svg_text(figure)
