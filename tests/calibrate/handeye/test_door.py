"""The solver is a library: its documented example runs in an empty folder, and its names load on demand."""

import inspect
import subprocess
import sys
import textwrap

import numpy as np

import calibrate.handeye
from tests.calibrate.cells import LOW, make_cell


def test_the_example_of_the_room_runs(tmp_path):
    cell = make_cell(np.random.default_rng(0), 8, LOW)
    poses = {
        "base_from_flange": cell.views.base_from_flange,
        "camera_from_board": cell.views.camera_from_board,
    }
    np.savez(tmp_path / "poses.npz", **poses)
    text = inspect.getdoc(calibrate.handeye) or ""
    example = textwrap.dedent(text[text.index("    import") : text.index("With corners")])
    assert len(example.strip().splitlines()) <= 11
    program = example + f"assert abs(flange_from_camera - np.array({cell.X.tolist()})).max() < 2e-3"
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True)
