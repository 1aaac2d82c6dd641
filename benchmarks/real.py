"""Real and rendered recordings by other people, cross-validated (set STATION_DATASETS to their folder)."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from benchmarks import real_arms
from benchmarks.real_methods import FAILURES, Answer, calibration_rs, opencv, ours, predicted_centre
from benchmarks.real_sets import DATASETS, RealSet, real_sets
from benchmarks.trials import table
from calibrate.views.view_set import ViewSet
from recordings.geometry import Array, difference

FOLDS = 5
FOLD_SEEDS = 5
_RESAMPLES = 4000
_LIMIT = 1.05
_FEWEST_IN_HALF = 5
_FULL = 0.99
"""Weights above count as full."""
OURS = "ours"

RULE = (
    f"{FOLDS}-fold cross-validation over {FOLD_SEEDS} seeds. Lens, X and board place come from the "
    "training views. In every left-out view, X, the robot's pose and the view's own PnP put the board "
    "centre somewhere, and its distance from the trained place counts. No left-out view is dropped. "
    "Where a method fails or refuses a fold, each left-out view of that fold is charged that method's "
    "own worst error in the set; a method that answers in less than half of the folds has no figure. "
    "OpenCV's lens is `cv2.calibrateCamera`'s on the training pictures, or the given one where there is "
    "one, whichever serves the method better; calibration-rs finds its own. `95 %` is a paired "
    "bootstrap over views of ours over the best peer of that set."
)


@dataclass(frozen=True, eq=False)
class SetResult:
    name: str
    real: bool
    views: int
    rms_m: dict[str, float]
    """Method to rms of the left-out board centre; methods without a figure are missing."""
    charged: dict[str, int]
    """Method to number of left-out views that were charged."""
    best_peer: str
    ratio: float
    interval: tuple[float, float]
    half_chi2: list[float]
    half_m: list[float]
    good: int
    full_weight: int
    """Number of the good ones; -1 where the whole set was refused."""
    note: str


def run() -> str:
    if not DATASETS.is_dir():
        return "not measured: no recordings found (set STATION_DATASETS)"
    names = tuple(name for name in os.environ.get("BENCH_SETS", "").split(",") if name)
    return report([measure(each) for each in real_sets(names)]) + "\n\n" + real_arms.report()


def measure(data: RealSet) -> SetResult:
    start = time.process_time()
    errors = cross_validate(data)
    charged = {name: int(np.isnan(e).sum()) for name, e in errors.items()}
    counted = {name: filled for name, e in errors.items() if (filled := charge(e)) is not None}
    rms_m = {name: float(np.sqrt(np.mean(e**2))) for name, e in counted.items()}
    peers = {name: value for name, value in rms_m.items() if name != OURS}
    best = min(peers, key=lambda name: peers[name])
    ratio, interval = float("nan"), (float("nan"), float("nan"))
    if OURS in counted:
        ratio = rms_m[OURS] / rms_m[best]
        interval = paired_bootstrap(counted[OURS], counted[best])
    chi2, apart_m = split_halves(data)
    full, note = _whole_set(data)
    print(f"  {data.name}: {time.process_time() - start:.0f} s CPU, ratio {ratio:.2f}", flush=True)
    return SetResult(
        data.name, data.truth is None, len(data.views), rms_m, charged, best, ratio, interval, chi2, apart_m,
        len(data.good), full, note,
    )  # fmt: skip


def cross_validate(data: RealSet) -> dict[str, Array]:
    """Method to distances (seeds, views) of the left-out board centre, metres; NaN: no answer."""
    n = len(data.views)
    methods: tuple[Callable[[ViewSet], Mapping[str, Answer]], ...] = (
        lambda views: {OURS: ours(views, data.board)},
        lambda views: opencv(views, data.board),
        calibration_rs,
    )
    errors: dict[str, Array] = {OURS: np.full((FOLD_SEEDS, n), np.nan)}
    for seed in range(FOLD_SEEDS):
        for out in np.array_split(np.random.default_rng(seed).permutation(n), FOLDS):
            training = data.views.select(sorted(set(range(n)) - set(out.tolist())))
            for method in methods:
                answers: Mapping[str, Answer] = {}
                with suppress(*FAILURES):
                    answers = method(training)
                for name, answer in answers.items():
                    row = errors.setdefault(name, np.full((FOLD_SEEDS, n), np.nan))
                    row[seed, out] = [left_out_error_m(data, k, answer) for k in out]
    return errors


def left_out_error_m(data: RealSet, place: int, answer: Answer) -> float:
    """Distance of the predicted board centre from the trained one in the view at this place, metres."""
    with suppress(*FAILURES):
        return float(np.linalg.norm(predicted_centre(data.views, place, answer) - answer.centre))
    return float("nan")


def charge(errors: Array) -> Array | None:
    """The errors with each missing one charged the method's own worst; None when most are missing."""
    missing = ~np.isfinite(errors)
    if missing.mean() >= 0.5:
        return None
    return np.where(missing, errors[~missing].max(), errors)


def paired_bootstrap(first: Array, second: Array, seed: int = 0) -> tuple[float, float]:
    """2.5 % and 97.5 % quantile of rms(first) / rms(second) over resampled views; both (seeds, views)."""
    squares = np.stack([np.mean(first**2, axis=0), np.mean(second**2, axis=0)])
    n = squares.shape[1]
    drawn = np.random.default_rng(seed).integers(n, size=(_RESAMPLES, n))
    sums = squares[:, drawn].sum(axis=-1)
    low, high = np.quantile(np.sqrt(sums[0] / sums[1]), [0.025, 0.975])
    return float(low), float(high)


def split_halves(data: RealSet) -> tuple[list[float], list[float]]:
    """chi2 / 6 of X1 - X2 against the sum of both claims, and their distance in metres, for each split."""
    n = len(data.views)
    chi2, apart_m = [], []
    if n // 2 < _FEWEST_IN_HALF:
        return [], []
    for seed in range(FOLD_SEEDS):
        order = np.random.default_rng(100 + seed).permutation(n)
        halves = [data.views.select(sorted(half.tolist())) for half in np.array_split(order, 2)]
        try:
            one, two = (ours(half, data.board) for half in halves)
        except FAILURES:
            chi2.append(float("inf"))
            continue
        if one.covariance is None or two.covariance is None:
            raise ValueError("ours states no covariance")
        delta = difference(one.X, two.X)
        chi2.append(float(delta @ np.linalg.solve(one.covariance + two.covariance, delta)) / 6)
        apart_m.append(float(np.linalg.norm(delta[:3])))
    return chi2, apart_m


def _whole_set(data: RealSet) -> tuple[int, str]:
    """Count good views of full weight when ours gets everything; its error where truth is known."""
    try:
        answer = ours(data.views, data.board)
    except FAILURES as error:
        return -1, f"refused: {str(error).splitlines()[0]}"
    full = sum(answer.weights.get(index, 0.0) > _FULL for index in data.good)
    if data.truth is None or answer.covariance is None:
        return full, ""
    delta = difference(answer.X, data.truth)
    claim_mm = 1e3 * np.sqrt(np.trace(answer.covariance[:3, :3]))
    chi2 = float(delta @ np.linalg.solve(answer.covariance, delta)) / 6
    return full, (
        f"X is {1e3 * np.linalg.norm(delta[:3]):.3f} mm / {np.degrees(np.linalg.norm(delta[3:])):.4f}° from "
        f"the truth, {claim_mm:.3f} mm claimed, chi²/6 {chi2:.1f}"
    )


def geometric_mean(values: list[float]) -> float:
    return float(np.exp(np.mean(np.log(values)))) if values else float("nan")


def report(results: list[SetResult]) -> str:
    answered = [r for r in results if np.isfinite(r.ratio)]
    real = geometric_mean([r.ratio for r in answered if r.real])
    rest = geometric_mean(sorted(r.ratio for r in answered)[1:])
    above = [r.name for r in answered if r.interval[0] > _LIMIT]
    halves = [float(np.median(r.half_chi2)) for r in results if r.half_chi2]
    good = sum(r.good for r in results if r.full_weight >= 0)
    full = sum(r.full_weight for r in results if r.full_weight >= 0)
    refused = [r.name for r in results if r not in answered or r.full_weight < 0]
    summary = table(
        ["figure", "value", "goal"],
        [
            ["ours / best peer, geometric mean, real sets", f"{real:.2f}", "≤ 0.65"],
            ["the same, all sets without the best one", f"{rest:.2f}", "≤ 0.75"],
            [f"sets above {_LIMIT} beyond chance", ", ".join(above) or "none", "none"],
            ["sets that ours refuses, whole or in most folds", ", ".join(refused) or "none", "none"],
            ["split halves, median of the sets' median chi²/6", f"{np.median(halves):.2f}", "0.5 … 1.5"],
            ["good views with full weight", f"{full / max(good, 1):.1%} of {good}", "≥ 97 %"],
        ],
    )
    return "\n\n".join([RULE, summary, _by_set(results), _methods(results)])


def _by_set(results: list[SetResult]) -> str:
    header = ["set", "views", "ours mm", "best peer", "mm", "ratio", "95 %", "ours charged", "halves chi²/6",
        "halves mm", "full weight", "ours on the whole set"]  # fmt: skip
    rows = [
        [
            r.name if r.real else f"{r.name} (rendered)",
            r.views,
            _mm(r.rms_m.get(OURS)),
            r.best_peer,
            _mm(r.rms_m[r.best_peer]),
            f"{r.ratio:.2f}",
            f"{r.interval[0]:.2f} … {r.interval[1]:.2f}",
            r.charged[OURS],
            f"{np.median(r.half_chi2):.2f}" if r.half_chi2 else "-",
            _mm(float(np.median(r.half_m))) if r.half_m else "-",
            f"{r.full_weight} of {r.good}" if r.full_weight >= 0 else "-",
            r.note,
        ]
        for r in results
    ]
    return table(header, rows)


def _methods(results: list[SetResult]) -> str:
    """All methods, rms mm; the better of the two lenses for OpenCV's."""
    names = dict.fromkeys(name.removesuffix(" (lens given)") for r in results for name in r.rms_m)
    rows = []
    for name in names:
        rows.append([name])
        for r in results:
            found = [v for k, v in r.rms_m.items() if k.removesuffix(" (lens given)") == name]
            rows[-1].append(_mm(min(found)) if found else "-")
    return table(["left-out board centre, rms mm", *(r.name for r in results)], rows)


def _mm(value_m: float | None) -> str:
    return "-" if value_m is None else f"{1e3 * value_m:.3g}"
