"""The notebook and the script of the docs run, and the notebook's result is as right as it says."""

from __future__ import annotations

import json
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recordings.exporters.export import export_recording
from recordings.geometry import difference
from recordings.reader import open_recording
from tests.calibrate.sessions import Scene, write_session

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"


@pytest.mark.timeout(300)
def test_every_cell_runs_and_x_is_as_near_the_truth_as_is_stated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("vision_calibration")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    cells = json.loads((EXAMPLES / "hand_eye.ipynb").read_text())["cells"]
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert any("image/png" in shown.get("data", ()) for cell in cells for shown in cell.get("outputs", ()))
    off = difference(names["solved"].X, names["X"])
    assert off @ np.linalg.solve(names["solved"].covariance(), off) < 22.5
    assert np.abs(names["by_opencv"] - names["X"]).max() < 1e-3


def test_the_script_runs_on_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_session(tmp_path / "session.mcap", Scene(views=10), known_lens=True)
    export_recording(open_recording(tmp_path / "session.mcap"), tmp_path / "FOLDER", "folder")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["hand_eye.py", "FOLDER"])
    runpy.run_path(str(EXAMPLES / "hand_eye.py"))
    assert (tmp_path / "residuals.png").stat().st_size > 1000
