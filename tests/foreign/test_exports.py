"""Every export by its own readers: 500 points are where the calibration shows them, to the pixel."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibrate.files.calibration import Calibration, FramePose, Lens
from calibrate.files.exports import FORMATS, export
from calibrate.geometry import Transform
from recordings.schema.messages import CameraIdentity, RobotIdentity
from station.simulation.cells import make_cell
from tests.calibrate.files.test_exports import offered_arm
from tests.foreign.export_readers import READERS
from tests.foreign.judges import FOLDER, missing
from tests.station.calibrated_cell import calibration_of

R, t = Rotation.from_rotvec([0.4, -2.1, 1.3]).as_matrix(), np.array([0.123456789, -0.5, 1.75])
K = np.array([[834.67, 0.0, 322.77], [0.0, 831.45, 247.61], [0.0, 0.0, 1.0]])
SIZE = (640, 512)
DISTORTION = [-0.0903, 0.0738, 4e-4, -2.7e-4, 0.119]
MOUNTS = {"in-hand": ("eye-in-hand", "flange"), "to-hand": ("eye-to-hand", "base")}
BY_OTHERS = {"ur-kinematics"}


def seen_points() -> np.ndarray[Any, Any]:
    """(500, 3) in the camera, all over the image, 0.3 to 2 m ahead."""
    random = np.random.default_rng(0)
    ahead = random.uniform(0.3, 2.0, 500)
    pixels = random.uniform([0, 0], SIZE, (500, 2))
    return np.column_stack([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(500)]) * ahead[:, None]


def made(mount: str) -> Calibration:
    """A calibration with nothing symmetric in it, and another camera pose beside its arm's table."""
    said, parent = MOUNTS[mount]
    matrix, own = np.eye(4), np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = R, t
    own[:3, :3], own[:3, 3] = R @ Rotation.from_rotvec([0.01, 0.02, 0.03]).as_matrix(), t + 0.001
    return msgspec.structs.replace(
        calibration_of(make_cell(), RobotIdentity("UR10e"), CameraIdentity(model="camera")),
        mount=said,
        result=FramePose.of(Transform(parent, "camera", matrix)),
        intrinsics=Lens(*SIZE, tuple(map(tuple, K.tolist())), tuple(DISTORTION), "plumb_bob", 0.1, "given"),
        arm_table=offered_arm(FramePose.of(Transform(f"corrected_{parent}", "camera", own))),
    )


@pytest.fixture(scope="module")
def read(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Case and format → what its reader found."""
    library = FOLDER / "python"
    folder = tmp_path_factory.mktemp("exports")
    (folder / "points.json").write_text(json.dumps((seen_points() @ R.T + t).tolist()))
    for case in MOUNTS:
        (folder / case).mkdir()
        calibration = made(case)
        for name in READERS:
            (folder / case / f"{name}{FORMATS[name].suffix}").write_bytes(export(calibration, name))
    ran = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("export_readers.py")), str(folder)],
        env=os.environ
        | {"PYTHONPATH": str(library), "PATH": f"{library / 'bin'}{os.pathsep}{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert ran.returncode == 0, ran.stderr
    found: dict[str, dict[str, Any]] = json.loads(ran.stdout)
    return found


@pytest.mark.parametrize("case", MOUNTS)
@pytest.mark.parametrize("name", READERS)
def test_500_points(read: dict[str, dict[str, Any]], name: str, case: str) -> None:
    found = read[f"{case} {name}"]
    if "missing" in found:
        missing(str(found["missing"]))
    points = seen_points()
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(DISTORTION))[0][:, 0]
    if "camera" in found:
        np.testing.assert_allclose(found["camera"], points, atol=1e-12)
    elif "K" in found:
        np.testing.assert_array_equal(found["K"], K)
        np.testing.assert_array_equal(found["D"], DISTORTION)
        assert found["size"] == [*SIZE, "plumb_bob", "camera"]
    else:
        assert np.linalg.norm(np.array(found["pixels"]) - pixels, axis=1).max() < 1e-9


def test_every_format_has_a_reader() -> None:
    assert set(READERS) | BY_OTHERS == set(FORMATS)
