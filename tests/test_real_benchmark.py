"""The rules by which `benchmarks real` and `benchmarks mistakes` count."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.mistakes import MISTAKES, Mistake, Said, named_truly
from benchmarks.real import charge, left_out_error_m, paired_bootstrap
from benchmarks.real_methods import calibration_rs, opencv, ours
from benchmarks.real_sets import RealSet
from benchmarks.scene import make_cell
from calibrate.handeye.noise_scales import MeasurementNoise
from recordings.geometry import difference
from recordings.schema.messages import BoardKind, BoardSpec, Mount


def test_a_failed_fold_is_charged_the_methods_own_worst_error() -> None:
    errors = np.array([[1.0, 2.0, np.nan], [1.0, 5.0, 3.0]])
    counted = charge(errors)
    assert counted.tolist() == [[1.0, 2.0, 5.0], [1.0, 5.0, 3.0]]
    assert charge(errors[:1, [0, 2, 2]]) is None, "it mostly fails"


def test_equal_errors_give_a_ratio_of_one_and_better_ones_stay_below() -> None:
    errors = np.abs(np.random.default_rng(1).normal(size=(5, 30)))
    assert paired_bootstrap(errors, errors) == (1.0, 1.0)
    low, high = paired_bootstrap(0.5 * errors, errors)
    assert low <= high < 0.51


@pytest.mark.parametrize("mount", ["eye-in-hand", "eye-to-hand"])
def test_every_method_answers_in_our_frames_and_predicts_the_board(mount: Mount) -> None:
    cell = make_cell(np.random.default_rng(3), 14, MeasurementNoise(0.02, 1e-5, 1e-5), mount=mount)
    board, views = BoardSpec(BoardKind.CHESSBOARD, 7, 6, 0.025), cell.views
    answers = {"ours": ours(views, board)} | opencv(views, board) | calibration_rs(views)
    assert len(answers) == 1 + 2 * 7 + 1, "the lens is given: OpenCV's seven twice"
    data = RealSet("simulated", views, board, frozenset(), None)
    for name, answer in answers.items():
        # Tsai-Lenz and Andreff are poor even here.
        limit_m = 5e-3 if name.startswith(("Tsai", "Andreff", "Li")) else 1e-3
        assert np.linalg.norm(difference(answer.X, cell.X)[:3]) < limit_m, name
        assert max(left_out_error_m(data, k, answer) for k in range(len(views))) < limit_m, name


SHIFTED = next(mistake for mistake in MISTAKES if mistake.name == "poses shifted by one picture")
SWAPPED = next(mistake for mistake in MISTAKES if mistake.name == "two poses swapped")


@pytest.mark.parametrize(
    ("mistake", "said", "true"),
    [
        (SHIFTED, Said("shifted-pictures", "shifted-pictures", (), ""), True),
        (SHIFTED, Said("board-moved", "board-moved", (), "poses shifted"), False),
        (SWAPPED, Said("pass", "", (3, 9), ""), True),
        (SWAPPED, Said("pass", "", (3, 9, 11), ""), False),
    ],
)
def test_a_mistake_counts_as_named_only_by_its_own_cause(mistake: Mistake, said: Said, true: bool) -> None:
    assert named_truly(mistake, said) is true
