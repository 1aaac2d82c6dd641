"""Writing a pose in another program's numbers: what an import reads back, and what others make of it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from recordings.geometry import Array, pose
from recordings.importers.conventions import NAMED, Convention, convention, euler_angles

FORMS = ("matrix", "xyzw", "wxyz", "rotvec")
MOVED = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX", "XYX", "XZX", "YXY", "YZY", "ZXZ", "ZYZ")
SEQUENCES = (*MOVED, *map(str.lower, MOVED))
QUARTERS = [k * math.pi / 2 for k in range(-4, 5)]
"""Where gimbal lock, half turns and no turn are."""
ANGLE = st.builds(
    lambda turn, off: turn + off,
    st.sampled_from(QUARTERS) | st.floats(-7, 7),
    st.just(0.0) | st.floats(-17, -1).map(lambda power: 10.0**power),
)


@st.composite
def poses(draw: st.DrawFn) -> Array:
    """Poses (4, 4) of any orientation, often near the places where angles lose their meaning."""
    sequence = draw(st.sampled_from(SEQUENCES))
    angles = draw(st.tuples(ANGLE, ANGLE, ANGLE))
    at = draw(st.tuples(*[st.floats(-3, 3)] * 3))
    return pose(Rotation.from_euler(sequence, angles).as_matrix(), at)


conventions = st.sampled_from(sorted(NAMED)).map(convention) | st.builds(
    Convention,
    rotation=st.sampled_from(FORMS + SEQUENCES),
    unit_m=st.sampled_from([1.0, 1e-3, 1e-2, 0.0254]),
    degrees=st.booleans(),
    inverse=st.booleans(),
    rotation_first=st.booleans(),
)


@given(conventions, poses())
def test_what_is_written_is_read_back(how: Convention, T: Array) -> None:
    (back,) = how.poses(how.numbers(T[None]))
    np.testing.assert_allclose(back, T, atol=1e-13 if how.inverse is False else 1e-12)


@given(conventions, poses())
def test_what_is_written_is_finite_and_in_its_range(how: Convention, T: Array) -> None:
    numbers = how.numbers(T[None])
    assert np.isfinite(numbers).all()
    if how.rotation in SEQUENCES:
        turn = numbers[0, :3] if how.rotation_first else numbers[0, 3:]
        turn = np.radians(turn) if how.degrees else turn
        assert np.abs(turn).max() <= math.pi + 1e-12
        low, high = (0, math.pi) if how.rotation[0] == how.rotation[2] else (-math.pi / 2, math.pi / 2)
        assert low - 1e-12 <= turn[1] <= high + 1e-12


@given(st.sampled_from(SEQUENCES), st.lists(st.tuples(ANGLE, ANGLE, ANGLE), min_size=1, max_size=5))
def test_another_program_makes_the_same_turn_of_the_angles(
    sequence: str, angles: list[tuple[float, float, float]]
) -> None:
    """SciPy's own rule of sequences, also at gimbal lock."""
    R = Rotation.from_euler(sequence, angles).as_matrix()
    same = Rotation.from_euler(sequence, euler_angles(sequence, R)).as_matrix()
    np.testing.assert_allclose(same, R, atol=1e-13)


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_the_angles_are_those_of_another_program(sequence: str) -> None:
    R = Rotation.random(200, rng=np.random.default_rng(3))
    theirs = R.as_euler(sequence)
    ours = euler_angles(sequence, R.as_matrix())
    np.testing.assert_allclose(np.exp(1j * ours), np.exp(1j * theirs), atol=1e-9)


@pytest.mark.parametrize("pitch_deg", [90.0, -90.0])
def test_at_gimbal_lock_the_angle_about_x_is_none(pitch_deg: float) -> None:
    """The split of the outer two is a matter of taste there; noise would read as a finding."""
    R = Rotation.from_euler("ZYX", [25.0, pitch_deg, 40.0], degrees=True).as_matrix()
    (abc,) = convention("kuka-abc").numbers(pose(R, [0, 0, 0])[None])[:, 3:]
    outer_deg = 25.0 - 40.0 if pitch_deg > 0 else 25.0 + 40.0
    assert abc == pytest.approx([outer_deg, pitch_deg, 0.0], abs=1e-6)
    (wpr,) = convention("fanuc-xyzwpr").numbers(pose(R, [0, 0, 0])[None])[:, 3:]
    assert wpr == pytest.approx([0.0, pitch_deg, outer_deg], abs=1e-6)


def test_published_poses_are_written_as_their_makers_do() -> None:
    """A tool that looks down: UR's rotation vector (0, π, 0), ABB's quaternion (0, 0, 1, 0).

    By KUKA's order of turns, A about Z, then B about the new Y, then C about the newest X.
    """
    down = pose(np.diag([-1.0, 1.0, -1.0]), [0.1, -0.2, 0.3])[None]
    assert np.abs(convention("ur-rotvec").numbers(down)[0]) == pytest.approx([0.1, 0.2, 0.3, 0, math.pi, 0])
    assert np.abs(convention("ur-pendant").numbers(down)[0]) == pytest.approx([100, 200, 300, 0, math.pi, 0])
    assert np.abs(convention("abb-quaternion").numbers(down)[0]) == pytest.approx([100, 200, 300, 0, 0, 1, 0])
    R = (
        Rotation.from_rotvec([0, 0, math.radians(30)])
        * Rotation.from_rotvec([0, math.radians(20), 0])
        * Rotation.from_rotvec([math.radians(10), 0, 0])
    )
    turned = pose(R.as_matrix(), [0, 0, 0])[None]
    assert convention("kuka-abc").numbers(turned)[0, 3:] == pytest.approx([30, 20, 10])
    assert convention("fanuc-xyzwpr").numbers(turned)[0, 3:] == pytest.approx([10, 20, 30])


def test_what_the_numbers_are_is_said_for_every_convention() -> None:
    assert len({how.about for how in NAMED.values()}) == len(set(NAMED.values()))
    assert convention("kuka-abc").about == "x y z in mm, angles in ° about the moved axes Z Y X"
