"""Ways to write a pose: each by the definition of its rotation, and what numbers alone leave open."""

from __future__ import annotations

import math

import numpy as np
import pytest

from recordings.importers.conventions import NAMED, convention, possible
from tests.codes import raises


def turn(axis: str, angle_rad: float) -> np.ndarray:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    rows = {"x": [[1, 0, 0], [0, c, -s], [0, s, c]], "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]]}
    return np.array(rows.get(axis, [[c, -s, 0], [s, c, 0], [0, 0, 1]]))


A, B, C = 0.5, -0.3, 1.1
DEGREES = np.degrees([A, B, C]).tolist()


@pytest.mark.parametrize(
    ("name", "angles", "expected"),
    [
        ("kuka-abc", DEGREES, turn("z", A) @ turn("y", B) @ turn("x", C)),
        ("fanuc-xyzwpr", DEGREES, turn("z", C) @ turn("y", B) @ turn("x", A)),
        ("xarm-rpy", DEGREES, turn("z", C) @ turn("y", B) @ turn("x", A)),
        ("euler-ZYZ-deg-mm", DEGREES, turn("z", A) @ turn("y", B) @ turn("z", C)),
        ("euler-XYZ-mm", [A, B, C], turn("x", A) @ turn("y", B) @ turn("z", C)),
        ("rotvec-mm", [0, 0, A], turn("z", A)),
        ("abb-quaternion", [math.cos(A / 2), math.sin(A / 2), 0, 0], turn("x", A)),
        ("xyzw-mm", [math.sin(A / 2), 0, 0, math.cos(A / 2)], turn("x", A)),
    ],
)
def test_a_pose_is_read_as_its_convention_says(name: str, angles: list[float], expected: np.ndarray) -> None:
    (T,) = convention(name).poses(np.array([[100, 200, 300, *angles]]))
    np.testing.assert_allclose(T[:3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], [0.1, 0.2, 0.3])
    (inverted,) = convention(f"{convention(name).name}-inverse").poses(np.array([[100, 200, 300, *angles]]))
    np.testing.assert_allclose(inverted @ T, np.eye(4), atol=1e-12)


def test_a_name_spells_what_it_means() -> None:
    for known in NAMED.values():
        assert convention(known.name) == known
    for wrong in ("", "euler", "euler-XXY", "zivid-mm", "xyzw-inches"):
        with raises("no-convention"):
            convention(wrong)


def test_numbers_say_what_they_can() -> None:
    half = math.sqrt(0.5)
    forms = {how.name for how, _ in possible(np.array([[400.0, 0, 300, half, 0, 0, half]] * 3))}
    assert forms == {"xyzw-mm", "wxyz-mm"}
    assert possible(np.array([[0.4, 0, 0.3, half, half, half, half]] * 3)) == []
    for scale, found in ((1, ["matrix"]), (2, []), ([1, 1, -1], [])):  # larger, mirrored
        rows = np.hstack([np.diag(np.ones(3) * scale), np.full((3, 1), 0.4)])
        assert [how.name for how, _ in possible(rows.reshape(1, 12))] == found
    assert all(how.degrees for how, _ in possible(np.array([[400.0, 0, 300, 90, 0, 20]] * 3)))
    assert not any(how.degrees for how, _ in possible(np.array([[0.4, 0, 0.3, 1, 0, 2]] * 3)))
