"""Previews carry the exposure assistant's advice to the screen."""

from __future__ import annotations

import numpy as np

from station.analysis import sight
from station.config import PAPER_BOARD
from station.simulation.placement import seen_from
from station.simulation.renderer import Light, render
from station.simulation.scenes import build_cell
from station.status import StationStatus
from station.tui.widgets.panels import detection_lines


def test_a_picture_too_bright_says_what_to_set_on_the_screen() -> None:
    camera = build_cell("paper", 0, "low", "eye-in-hand").camera
    view = seen_from(PAPER_BOARD, 0.5)
    for light, words in ((1.0, ""), (4.0, "too bright")):
        picture = render(camera, PAPER_BOARD, view, Light(illumination=light), np.random.default_rng(0))
        status = sight(picture, PAPER_BOARD, None, False, (10_000.0, 0.0)).status
        assert status.advice.startswith(words) and bool(status.advice) == bool(words)
        shown = "\n".join(detection_lines(StationStatus(detection=status)))
        assert words in shown
    assert sight(picture, PAPER_BOARD, None, False).status.advice == ""
