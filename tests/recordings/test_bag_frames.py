"""Frames of a bag: chains walked in both directions, interpolation, and what cannot be a chain."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from recordings.errors import ImportSourceError
from recordings.importers.frames import FrameTree
from recordings.importers.messages import FrameMessage
from recordings.importers.stops import StandstillLimits, StopFinder


def frame(stamp_ns: int, parent: str, child: str, T: np.ndarray) -> FrameMessage:
    x, y, z = T[:3, 3].tolist()
    sign = 1 - 2 * (stamp_ns // 1000 % 2)  # q and -q are one rotation
    qx, qy, qz, qw = (sign * Rotation.from_matrix(T[:3, :3]).as_quat()).tolist()
    return FrameMessage(stamp_ns, parent, child, (x, y, z), (qx, qy, qz, qw))


def random_pose(seed: int) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    T[:3, 3] = np.random.default_rng(seed).normal(size=3)
    return T


def turned(angle_rad: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0, 0, angle_rad]).as_matrix()
    return T


def test_a_chain_is_walked_against_its_arrows_too() -> None:
    """world → base_link and tool0 → flange fixed, base_link → tool0 moving; asked from both sides."""
    A, B = random_pose(1), random_pose(2)
    tree = FrameTree()
    tree.add([frame(0, "world", "base_link", A), frame(0, "tool0", "flange", B)])
    for n in range(11):
        tree.add([frame(n * 1000, "base_link", "tool0", turned(0.01 * n))])
    T = tree.track("world", "flange").at(np.array([4500]))[0]
    np.testing.assert_allclose(T, A @ turned(0.045) @ B, atol=1e-12)
    back = tree.track("flange", "world").at(np.array([4500]))[0]
    np.testing.assert_allclose(back, np.linalg.inv(T), atol=1e-12)


def test_a_board_seen_from_two_sides_joins_no_arm() -> None:
    """Else the flange would be where an earlier calibration places it."""
    tree, names = FrameTree(), ["base", "shoulder", "elbow", "wrist", "tool0"]
    for n, link in enumerate([*pairwise(names), ("camera", "board")]):
        tree.add([frame(t, *link, turned(0.1 * n * t)) for t in range(2)])
    tree.add([frame(0, "tool0", "camera", random_pose(1)), frame(0, "base", "board", random_pose(2))])
    assert [pair for pair, _ in tree.chain("base", "tool0")] == list(pairwise(names))


def test_the_nearest_report_of_every_moving_link_counts() -> None:
    tree = FrameTree()
    for n in range(10):
        tree.add([frame(n * 10_000_000, "base", "flange", turned(0.1 * n))])
    track = tree.track("base", "flange")
    assert track.gap_s(23_000_000) == pytest.approx(0.003)
    assert track.gap_s(-1) == np.inf
    assert track.gap_s(90_000_001) == np.inf


@pytest.mark.parametrize("q", [(0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.1), (np.nan, 0.0, 0.0, 1.0)])
def test_what_is_no_rotation_is_refused(q: tuple[float, float, float, float]) -> None:
    with pytest.raises(ImportSourceError):
        FrameTree().add([FrameMessage(0, "base", "flange", (0.0, 0.0, 0.0), q)])


def test_frames_that_never_move_are_no_arm() -> None:
    tree = FrameTree()
    tree.add([frame(n, "base", "flange", turned(0.1)) for n in range(5)])
    with pytest.raises(ImportSourceError):
        tree.find("base", "flange")
    still = tree.track("base", "flange").at(np.array([9]))[0]  # as frames of a camera's driver
    np.testing.assert_allclose(still, turned(0.1), atol=1e-12)


def test_an_arm_that_drifts_slowly_does_not_stand() -> None:
    """0.2 mm in the window of 0.3 s: four times the limit; with that limit it stands."""
    tree = FrameTree()
    for n in range(400):
        T = np.eye(4)
        T[0, 3] = n * 10e-6 * 2 / 3
        tree.add([frame(n * 10_000_000, "base", "flange", T)])
    images = np.array([1_000_000_000, 2_000_000_000], np.int64)
    finder, wide = StopFinder(tree.track("base", "flange"), images, None, 0.05), StandstillLimits(0.001)
    assert finder.stops(StandstillLimits())[0] == finder.stops(StandstillLimits(0.0, 0.0))[0] == []
    assert len(finder.stops(wide)[0]) == 1
    fast = np.array([900_000_000, 1_900_000_000], np.int64), np.array([0.0, 0.1])
    (stop,) = replace(finder, speeds=fast).stops(wide)[0]
    assert stop.place == 0, "a joint turned before the second image"
    (stop,) = replace(finder, images_ns=images[::-1]).stops(wide)[0]
    assert stop.place == 0, "the latest, in whatever order they came"
    (rare := FrameTree()).add([frame(n * 10**8, "base", "flange", turned(0.1 * (n < 5))) for n in range(40)])
    finder = replace(finder, track=rare.track("base", "flange"))
    assert len(finder.stops(StandstillLimits())[0]) == 1, "it reports at 10 Hz"


def test_limits_come_from_an_arm_that_reports_with_more_noise() -> None:
    """0.03 mm (1σ) at ten stops: nothing stands by the usual limits, and by the proposed ones all ten do."""
    tree, rng = FrameTree(), np.random.default_rng(1)
    for n in range(2000):
        stop, share = divmod(n, 200)
        T = np.eye(4)
        T[:3, 3] = rng.normal(scale=30e-6, size=3)
        T[0, 3] += 0.05 * (stop + min(1.0, share / 100))  # moves for one second, stands for one
        tree.add([frame(n * 10_000_000, "base", "flange", T)])
    images_ns = np.arange(250, 20_000, 500) * 1_000_000
    finder = StopFinder(tree.track("base", "flange"), images_ns, None, 0.05)
    assert finder.stops(StandstillLimits())[0] == []
    wider, stops = finder.wider(StandstillLimits())
    assert stops == len(finder.stops(wider)[0]) == 10
    assert not finder.wider(wider)
    assert len(finder.stops(StandstillLimits(every_image=True))[0]) == len(images_ns)
