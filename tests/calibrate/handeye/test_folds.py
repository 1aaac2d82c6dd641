"""Left-out and held-out views judge the claim, and take no part in what they judge."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from calibrate.handeye import describe, diagnosis
from calibrate.handeye.cell_fit import fit_cell
from calibrate.handeye.diagnosis import cross_validate
from calibrate.handeye.estimate import estimate
from calibrate.handeye.metrics import HELD_OUT
from calibrate.handeye.priors import LensPrior, Priors
from calibrate.handeye.solve import SolveOptions, solve_views
from calibrate.pipeline.gates import judge
from recordings.geometry import perturb
from tests.calibrate.cells import LOW, MID, MOUNTS, make_cell, nudged

VIEWS = 20
CV = SolveOptions(holdout=False)


@pytest.fixture(scope="module")
def fit():
    cell = make_cell(np.random.default_rng(0), VIEWS, MID)
    return fit_cell(cell.views, Priors(LensPrior.given(cell.camera)), 0)


def spoiled(fit, places):
    """The same fit, but these views' poses and pictures are garbage now."""
    flange, pixels = fit.observed.flange.copy(), fit.observed.pixels.copy()
    flange[places] = perturb(flange[places], np.full(6, 0.3))
    pixels[places] += 40.0
    return replace(fit, observed=replace(fit.observed, flange=flange, pixels=pixels))


def test_the_held_out_views_of_a_solve_leave_its_partial_fit_alone(monkeypatch):
    """By the front door: another start is all that they may give."""
    views = make_cell(np.random.default_rng(0), VIEWS, MID).views
    last = list(range(VIEWS - HELD_OUT, VIEWS))
    slips = 1e-3 * np.random.default_rng(1).normal(size=(HELD_OUT, 6))
    judged = []
    score = describe.score_holdout
    monkeypatch.setattr(describe, "score_holdout", lambda X, *a: judged.append(X) or score(X, *a))
    scores = [
        solve_views(seen, SolveOptions(folds=False)).judgement.figures.holdout
        for seen in (views, nudged(views, last, slips))
    ]
    assert scores[0].fitted_views == VIEWS - HELD_OUT
    assert min(place for pair in scores[0].pairs for place in pair) == last[0]
    np.testing.assert_allclose(judged[0], judged[1], atol=1e-5)  # a leak moves it by ten times that
    assert abs(scores[0].e_t_m - scores[1].e_t_m) > 1e-6


def test_left_out_views_take_no_part_in_the_fold_that_predicts_them(fit, monkeypatch):
    found = {}

    def remembered(name):
        def fold(*given, **options):
            result = estimate(*given, **options)
            found.setdefault(name, []).append(result.state.X)
            return result

        return fold

    spoilt = spoiled(fit, np.array([3]))
    for name, seen in (("as it is", fit), ("spoilt", spoilt)):
        monkeypatch.setattr(diagnosis, "estimate", remembered(name))
        cross_validate(seen, 0)
    same = [np.array_equal(a, b) for a, b in zip(found["as it is"], found["spoilt"], strict=True)]
    assert len(same) == diagnosis.FOLDS and sum(same) == 1


@MOUNTS
def test_sound_claims_are_confirmed(mount):
    for seed in range(2):
        cell = make_cell(np.random.default_rng(seed), 15, LOW if seed % 2 else MID, mount=mount)
        solution = solve_views(cell.views, CV)
        cv = solution.judgement.figures.cross_validation
        assert cv.folds == 5
        assert 0.5 < cv.rms_mm / cv.claimed_mm < cv.limit
        assert all(g.passed for g in judge(solution) if g.name == "cross_validation")


def test_a_claim_that_is_too_small_closes_the_gate(fit, monkeypatch):
    """Each fold claims a third of its error: covariance and noise."""

    def boasting(*given, **options):
        found = estimate(*given, **options)
        scales = replace(found.scales, robot=found.scales.robot / 3, tau_px=found.scales.tau_px / 3)
        return replace(found, covariance=found.covariance / 9, scales=scales)

    honest = cross_validate(fit, 0)
    monkeypatch.setattr(diagnosis, "estimate", boasting)
    boasted = cross_validate(fit, 0)
    assert boasted.claimed_mm == pytest.approx(honest.claimed_mm / 3, rel=0.01)
    assert honest.rms_mm < honest.limit * honest.claimed_mm
    assert boasted.rms_mm > boasted.limit * boasted.claimed_mm
    bare = solve_views(fit.views, replace(CV, folds=False))
    figures = msgspec.structs.replace(bare.judgement.figures, cross_validation=boasted)
    solution = replace(bare, judgement=replace(bare.judgement, figures=figures))
    assert "cross_validation" in [g.name for g in judge(solution) if not g.passed]


def test_five_views_are_too_few_to_leave_some_out():
    views = make_cell(np.random.default_rng(0), 6, LOW).views
    assert solve_views(views.select(list(range(5))), CV).judgement.figures.cross_validation is None
    assert solve_views(views, CV).judgement.figures.cross_validation is not None
