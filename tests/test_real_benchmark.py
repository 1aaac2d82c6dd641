"""The rules by which `benchmarks real` counts."""

from __future__ import annotations

import numpy as np
import yaml

from benchmarks.real import charge, geometric_mean, paired_bootstrap
from benchmarks.real_sets import _GOOD_VIEWS


def test_a_failed_fold_is_charged_the_methods_own_worst_error() -> None:
    errors = np.array([[1.0, 2.0, np.nan], [1.0, 5.0, 3.0]])
    counted = charge(errors)
    assert counted is not None
    assert counted.tolist() == [[1.0, 2.0, 5.0], [1.0, 5.0, 3.0]]


def test_a_method_that_mostly_fails_has_no_figure() -> None:
    assert charge(np.array([[1.0, np.nan, np.nan]])) is None


def test_equal_errors_give_a_ratio_of_one_and_better_ones_stay_below() -> None:
    errors = np.abs(np.random.default_rng(1).normal(size=(5, 30)))
    assert paired_bootstrap(errors, errors) == (1.0, 1.0)
    low, high = paired_bootstrap(0.5 * errors, errors)
    assert low <= high < 0.51


def test_geometric_mean() -> None:
    assert np.isclose(geometric_mean([0.5, 2.0]), 1.0)


def test_good_views_are_numbered_within_their_set() -> None:
    for name, listed in yaml.safe_load(_GOOD_VIEWS.read_text()).items():
        numbers = [*listed["not_good"], *listed.get("no_board", []), *listed.get("seen", {})]
        assert all(1 <= number <= listed["views"] for number in numbers), name
