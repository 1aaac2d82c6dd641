"""Ambiguous pictures are read the way that agrees with the robot, whatever X is."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.scene import random_rotation
from calibrate.boards.model import board_from_turned, board_points
from calibrate.lens.pnp import candidate_poses, choose_candidates, solve_pnp
from calibrate.views.corners import Corners
from calibrate.views.projection import project
from calibrate.views.view_set import BoardView, ViewSet
from recordings.geometry import Array, inverse, perturb, pose, rotation_angle, transform_points
from recordings.schema.messages import BoardKind, BoardSpec, CameraModel, Mount
from tests.calibrate.sessions import looking

TWO_WAYS = BoardSpec(BoardKind.CHESSBOARD, 8, 6, 0.0285)
FOUR_WAYS = BoardSpec(BoardKind.CHESSBOARD, 6, 6, 0.03)
MARKED = BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025)
CAMERA = CameraModel(1280, 1024, ((1667.0, 0, 639.5), (0, 1667.0, 511.5), (0, 0, 1)), (0.0,) * 5)


def scene(spec: BoardSpec, count: int, mount: Mount, seed: int, noise: float) -> tuple[Array, Array]:
    """(camera_from_board, base_from_flange) with X and the board anywhere."""
    rng = np.random.default_rng(seed)
    X, P = (pose(random_rotation(rng), rng.uniform(-1, 1, 3)) for _ in range(2))
    seen = np.array([looking(spec, rng, (0.1, 0.6), 0.8, np.pi) for _ in range(count)])
    flange = P @ inverse(X @ seen) if mount == "eye-in-hand" else X @ seen @ inverse(P)
    return seen, perturb(flange, rng.normal(size=(count, 6)) * noise)


@settings(max_examples=15)
@given(
    seed=st.integers(0, 10_000),
    mount=st.sampled_from(["eye-in-hand", "eye-to-hand"]),
    spec=st.sampled_from([TWO_WAYS, FOUR_WAYS]),
)
def test_all_views_end_up_read_the_same_way(seed: int, mount: Mount, spec: BoardSpec) -> None:
    """Which way is not known and does not matter: X is the same for all of them."""
    ways = (0, 2) if spec is TWO_WAYS else (0, 1, 2, 3)
    seen, flanges = scene(spec, 12, mount, seed, 0.0005)
    first = np.random.default_rng(seed).integers(0, len(ways), 12)
    candidates = [
        np.array([s @ board_from_turned(spec, ways[(first[i] + k) % len(ways)]) for k in range(len(ways))])
        for i, s in enumerate(seen)
    ]
    chosen = choose_candidates(candidates, flanges, mount)
    kept = {int(first[i] + k) % len(ways) for i, k in enumerate(chosen)}
    assert len(kept) == 1


def test_more_views_than_voters_follow_the_voters() -> None:
    seen, flanges = scene(TWO_WAYS, 150, "eye-in-hand", 5, 0.0005)
    first = np.random.default_rng(5).integers(0, 2, 150)
    candidates = [
        np.array([s @ board_from_turned(TWO_WAYS, 2 * int((first[i] + k) % 2)) for k in range(2)])
        for i, s in enumerate(seen)
    ]
    chosen = choose_candidates(candidates, flanges, "eye-in-hand")
    assert len({(int(first[i]) + k) % 2 for i, k in enumerate(chosen)}) == 1


def test_a_fifth_of_wrong_robot_poses_does_not_turn_the_others() -> None:
    seen, flanges = scene(TWO_WAYS, 15, "eye-in-hand", 6, 0.0005)
    rng = np.random.default_rng(6)
    for k in (2, 7, 11):
        flanges[k] = pose(random_rotation(rng), rng.uniform(-1, 1, 3))
    candidates = [np.array([s, s @ board_from_turned(TWO_WAYS, 2)]) for s in seen]
    chosen = np.array(choose_candidates(candidates, flanges, "eye-in-hand"))
    right = np.delete(chosen, [2, 7, 11])
    assert len(set(right.tolist())) == 1


def test_one_sure_picture_does_not_decide_for_the_doubtful_ones() -> None:
    """A small board far away may be tilted to either side; the robot's motion says to which."""
    rng = np.random.default_rng(4)
    points = board_points(MARKED)
    X, P = (pose(random_rotation(rng), rng.uniform(-1, 1, 3)) for _ in range(2))
    views, right = [], []
    while len(views) < 13:
        far = len(views) >= 8
        C = looking(MARKED, rng, (0.1, 0.25) if far else (0.3, 0.6), 4.0 if far else 0.4, np.pi)
        pixels = project(CAMERA, transform_points(C, points)).pixels + rng.normal(size=(len(points), 2)) * 0.3
        view = BoardView(len(views), "", P @ inverse(X @ C), Corners(points, pixels))
        readings = [found.camera_from_board for found in candidate_poses(view, CAMERA, MARKED)]
        off = [float(rotation_angle(found[:3, :3].T @ C[:3, :3])) for found in readings]
        if far and not (len(off) == 2 and off[0] > 0.15 > 3 * off[1]):
            continue  # only those whose better fit is the wrong one, by much
        views.append(view)
        right.append(readings[int(np.argmin(off))])
    solved = solve_pnp(ViewSet("eye-in-hand", tuple(views), CAMERA), MARKED)
    np.testing.assert_allclose(solved.camera_from_board, right, atol=1e-4)
