"""Poses in pendants' numbers, by RoboDK's readers and writers of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings.geometry import Array, pose
from recordings.importers.conventions import convention
from tests.foreign.judges import library

MAKERS = {"ur-pendant": "UR", "kuka-abc": "KUKA", "fanuc-xyzwpr": "Fanuc", "abb-quaternion": "ABB"}
"""Convention → its name in RoboDK."""
LOCKED = [Rotation.from_euler("ZYX", [20, pitch, -50], degrees=True) for pitch in (90, -90)]
HALF_TURNS = [Rotation.from_quat(axis) for axis in np.eye(4)]
TURNS = [*LOCKED, *HALF_TURNS, *Rotation.random(200, rng=np.random.default_rng(1))]


@pytest.fixture(scope="module")
def robodk() -> Any:
    return library("robodk.robomath", "robodk")


def poses() -> Array:
    """(n, 4, 4), metres."""
    at = np.random.default_rng(2).uniform(-2, 2, (len(TURNS), 3))
    return pose(np.array([turn.as_matrix() for turn in TURNS]), at)


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
@pytest.mark.parametrize("name", MAKERS)
def test_what_is_written_is_read_by_robodk(robodk: Any, name: str) -> None:
    for T, numbers in zip(poses(), convention(name).numbers(poses()).tolist(), strict=True):
        if name == "abb-quaternion":  # which it reads without a place
            theirs = np.array(robodk.quaternion_2_pose(numbers[3:]).Rows())
            theirs[:3, 3] = numbers[:3]
        else:
            theirs = np.array(getattr(robodk, f"{MAKERS[name]}_2_Pose")(numbers).Rows())
        theirs[:3, 3] /= 1000
        np.testing.assert_allclose(theirs, T, atol=1e-9)


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
@pytest.mark.parametrize("name", MAKERS)
def test_what_robodk_writes_is_read(robodk: Any, name: str) -> None:
    for T in poses():
        in_mm = T.copy()
        in_mm[:3, 3] *= 1000
        numbers = getattr(robodk, f"Pose_2_{MAKERS[name]}")(robodk.Mat(in_mm.tolist()))
        (back,) = convention(name).poses(np.array([numbers]))
        np.testing.assert_allclose(back, T, atol=1e-3)  # near half turns its quaternion is 3e-4 off
