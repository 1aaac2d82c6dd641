"""What is written without protobuf's objects or NumPy's arrays says what those would have said."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from recordings.schema import viewing
from recordings.schema.definitions import encode, encode_robot_state
from recordings.schema.messages import RobotState, Stamps

INTEGERS = st.integers(-(2**63), 2**63 - 1) | st.integers(-1, 130)
NUMBERS = st.floats() | st.sampled_from([0.0, -0.0, 1.0])
SIX = st.tuples(*[NUMBERS] * 6)
STAMPS = st.builds(Stamps, INTEGERS, INTEGERS, NUMBERS, INTEGERS)
STATES = st.builds(RobotState, STAMPS, SIX, SIX, SIX, SIX, *[INTEGERS] * 5, NUMBERS, NUMBERS)
POSES = st.tuples(*[st.floats(-4.0, 4.0)] * 6)


@given(STATES)
def test_a_state_has_the_bytes_of_protobuf(state: RobotState) -> None:
    assert encode_robot_state(state) == encode(state)


@given(STAMPS, SIX, st.tuples(*[st.integers(1, 127)] * 5), st.tuples(*[st.floats(0.01, 1.0)] * 2))
def test_so_has_a_usual_one(stamps: Stamps, six: tuple, modes: tuple, fractions: tuple) -> None:  # type: ignore[type-arg]
    state = RobotState(stamps, six, six[::-1], six, six[::-1], *modes, *fractions)
    assert encode_robot_state(state) == encode(state)


def _matrix(pose: tuple[float, ...]) -> np.ndarray:  # type: ignore[type-arg]
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array(pose[3:]))[0]
    T[:3, 3] = pose[:3]
    return T


@given(POSES, POSES)
def test_the_flange_is_where_matrices_say(tcp_pose: tuple, tcp_offset: tuple) -> None:  # type: ignore[type-arg]
    expected = _matrix(tcp_pose) @ np.linalg.inv(_matrix(tcp_offset))
    T = viewing.base_from_flange(tcp_pose, tcp_offset)
    np.testing.assert_allclose(T, expected, atol=1e-12)
    x, y, z, w = viewing.quaternion_xyzw(T)
    assert w >= 0
    angle, axis = 2 * np.arctan2(np.hypot(np.hypot(x, y), z), w), np.array([x, y, z])
    turned = cv2.Rodrigues(axis / max(float(np.linalg.norm(axis)), 1e-300) * angle)[0]
    np.testing.assert_allclose(turned, expected[:3, :3], atol=1e-12)
