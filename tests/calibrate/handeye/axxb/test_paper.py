"""The paper's evolution: what it promises, and that the collapsed form changes nothing in it."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibrate.handeye.axxb.pairs import consecutive_pairs
from calibrate.handeye.axxb.paper import BOX, SETTINGS, EvolutionSettings, _partners, evolve, solve_paper
from recordings.geometry import pose, rotation_exp
from tests.calibrate.cells import LOW, make_cell

ROOT = Path(__file__).parents[4]


def paper_pairs(seed: int):
    cell = make_cell(np.random.default_rng(seed), 19, LOW)
    return consecutive_pairs(cell.views.base_from_flange, cell.views.camera_from_board), cell


def pair_loop_objective(pairs):
    """f of eq. 16 by loops, with rotations by the general map: the reference."""
    alpha = [Rotation.from_matrix(A[:3, :3]).as_rotvec() for A in pairs.A]
    beta = [Rotation.from_matrix(B[:3, :3]).as_rotvec() for B in pairs.B]

    def evaluate(x):
        values = np.zeros(len(x))
        for k, row in enumerate(x):
            R, b = Rotation.from_rotvec(row[:3]).as_matrix(), row[3:]
            for A, B, a, c in zip(pairs.A, pairs.B, alpha, beta, strict=True):
                shift = A[:3, :3] @ b + A[:3, 3] - R @ B[:3, 3] - b
                turn = a - R @ c
                values[k] += turn @ turn + shift @ shift
        return values

    return evaluate


def test_the_settings_are_those_of_the_paper():
    assert EvolutionSettings(population=30, factor=0.5, crossover=0.9, generations=100) == SETTINGS
    np.testing.assert_array_equal(BOX, [np.pi / 2] * 3 + [1.0] * 3)


@pytest.mark.parametrize("seed", range(2))
def test_same_seed_gives_the_same_X_by_form_and_by_pair_loops(seed):
    pairs, _ = paper_pairs(seed)
    by_form = solve_paper(pairs, seed)
    rng = np.random.default_rng(seed)
    by_loops = evolve(pair_loop_objective(pairs), -BOX, BOX, rng, SETTINGS)
    expected = pose(rotation_exp(by_loops[:3]), by_loops[3:])
    np.testing.assert_allclose(by_form.X, expected, rtol=0, atol=1e-12)


def test_partners_are_three_different_others():
    chosen = _partners(np.random.default_rng(0), 200, 7)
    i = np.arange(7)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert (chosen[:, a] != chosen[:, b]).all()
    assert (chosen != i).all()
    counts = np.bincount(chosen[:, :, 0].ravel(), minlength=7)
    assert counts[0] == 0
    assert (abs(counts[1:] - 100) < 45).all()  # uniform over the other six


def test_mutants_are_rounded_to_the_box_and_ties_are_accepted():
    seen = []

    def flat(x):
        seen.append(x.copy())
        return np.zeros(len(x))

    lower, upper = -np.ones(2), np.ones(2)
    setting = EvolutionSettings(population=10, factor=2.0, crossover=1.0, generations=5)
    best = evolve(flat, lower, upper, np.random.default_rng(0), setting)
    everything = np.concatenate(seen)
    assert np.abs(everything).max() == 1.0
    np.testing.assert_array_equal(best, seen[-1][0])  # f equal: the trial replaces its parent
