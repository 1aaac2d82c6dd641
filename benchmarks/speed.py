"""Gain of the collapsed objective, sameness of its search, and shares of a solve's time."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy import optimize
from scipy.spatial.transform import Rotation

from benchmarks.imperfect_cells import BOARD, Imperfection, Known, imperfect_cell
from benchmarks.scene import LOW, make_cell, pose_arrays
from benchmarks.trials import percentiles, table, trials
from calibrate.geometry import Array
from calibrate.handeye.axxb.evolution import Evaluate, evolve
from calibrate.handeye.axxb.objective import build_objective
from calibrate.handeye.axxb.pairs import Pairs, all_pairs, consecutive_pairs
from calibrate.handeye.axxb.paper import BOX, SETTINGS, paper_evaluate, solve_paper
from calibrate.handeye.axxb.robust import solve_global
from calibrate.handeye.fit import fit_cell
from calibrate.handeye.poses import pose_views
from calibrate.handeye.priors import LensPrior, Priors
from calibrate.handeye.readings import explain_recording
from calibrate.handeye.solve import SolveOptions, solve_views
from calibrate.lens.intrinsics import calibrate_intrinsics
from calibrate.lens.pnp import solve_pnp
from recordings.schema.messages import CameraModel

SEEDS = 1000
REPEATED = 100
SOLVES = 60


def run() -> str:
    return "\n\n".join([_runs(), _same_search(), _stages()])


def _pairs(n: int) -> Pairs:
    rng = np.random.default_rng(n)
    if n == 18:
        cell = make_cell(rng, 19, LOW)
        return consecutive_pairs(cell.views.base_from_flange, cell.views.camera_from_board)
    cell = make_cell(rng, 25 if n == 300 else 100, LOW)
    return all_pairs(cell.views.base_from_flange, cell.views.camera_from_board)


def over_pairs(pairs: Pairs) -> Evaluate:
    """Candidate by candidate, each with numpy over the pairs: how one would write eq. 16."""
    D, b_A, b_B = pairs.A[:, :3, :3] - np.eye(3), pairs.A[:, :3, 3], pairs.B[:, :3, 3]
    alpha, beta = pairs.alpha, pairs.beta

    def one(x: Array) -> float:
        R = Rotation.from_rotvec(x[:3]).as_matrix()
        turn = alpha - beta @ R.T
        shift = D @ x[3:] + b_A - b_B @ R.T
        return float((turn**2).sum() + (shift**2).sum())

    return lambda population: np.array([one(x) for x in population])


def pair_loops(pairs: Pairs) -> Evaluate:
    """Pair by pair, the population at once: the reference of the same-search count."""
    D, b_A, b_B = pairs.A[:, :3, :3] - np.eye(3), pairs.A[:, :3, 3], pairs.B[:, :3, 3]

    def evaluate(x: Array) -> Array:
        R = Rotation.from_rotvec(x[:, :3]).as_matrix()
        total = np.zeros(len(x))
        for i in range(len(pairs)):
            turn = pairs.alpha[i] - R @ pairs.beta[i]
            shift = x[:, 3:] @ D[i].T + b_A[i] - R @ b_B[i]
            total += (turn**2).sum(axis=1) + (shift**2).sum(axis=1)
        return total

    return evaluate


def _best_ms(work: Callable[[], object], repeats: int) -> float:
    """Processor time, one thread: a busy machine does not count."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - start))
    return min(times)


def _scipy(evaluate: Evaluate) -> object:
    """The same evolution by scipy."""
    return optimize.differential_evolution(
        lambda x: evaluate(x.T), list(zip(-BOX, BOX, strict=True)), popsize=5, maxiter=100, mutation=0.5,
        recombination=0.9, polish=False, tol=0, vectorized=True, updating="deferred", rng=0,
    )  # fmt: skip


def _runs() -> str:
    rows = []
    for n in (18, 300, 4950):
        given = _pairs(n)

        def fresh(given: Pairs = given) -> Pairs:
            return Pairs(given.A, given.B, given.first, given.second)  # logarithms not cached yet

        def de(evaluate: Evaluate) -> object:
            return evolve(evaluate, -BOX, BOX, np.random.default_rng(0), SETTINGS)

        ours = _best_ms(lambda: solve_paper(fresh(), 0), 15)
        setup = _best_ms(lambda: build_objective(fresh(), "log"), 15)
        numpy = _best_ms(lambda: de(over_pairs(fresh())), 3)
        loops = _best_ms(lambda: de(pair_loops(fresh())), 1)
        evaluate = paper_evaluate(build_objective(given, "log"))
        scipy = _best_ms(partial(_scipy, evaluate), 3)
        rows.append([n, f"{ours:.1f}", f"{setup:.1f}", f"{numpy:.0f}", f"{loops:.0f}", f"{scipy:.1f}",
                     f"{numpy / ours:.0f} ×", f"{loops / ours:.0f} ×"])  # fmt: skip
    header = ["pairs", "ours, all", "of it set-up", "numpy over pairs", "loop over pairs",
              "scipy DE on the form", "against numpy", "against loops"]  # fmt: skip
    text = "One whole DE run of the paper (M = 30, 100 generations), CPU ms, best of 15 / 15 / 3 / 1 / 3."
    return text + "\n\n" + table(header, rows)


def _same_search() -> str:
    """Same seed, same draws: does any comparison inside the search come out differently?"""
    count = trials(SEEDS)
    given = _pairs(18)
    form, loops = paper_evaluate(build_objective(given, "log")), pair_loops(given)
    different, largest = 0, 0.0
    repeated = trials(REPEATED)
    unlike = 0
    for seed in range(count):
        by_form, by_loops = _best(form, seed), _best(loops, seed)
        different += not np.array_equal(by_form, by_loops)
        largest = max(largest, float(np.abs(by_form - by_loops).max()))
        if seed < repeated:
            unlike += not np.array_equal(by_form, _best(form, seed))
            unlike += not np.array_equal(by_loops, _best(loops, seed))
    return (
        f"Same search, {count} seeds, 18 pairs: final X by the form and by pair loops is different "
        f"in {different} (largest difference {largest:.1e}). Of {2 * repeated} repeated runs {unlike} did "
        "not give the same bits."
    )


def _best(evaluate: Evaluate, seed: int) -> Array:
    return evolve(evaluate, -BOX, BOX, np.random.default_rng(seed), SETTINGS).best


def _stages() -> str:
    count = trials(SOLVES)
    rows = []
    for name, known in (("arm unknown", Known()), ("arm and joints known", Known(arm=True, joints=True))):
        spent: dict[str, list[float]] = {}

        def took(stage: str, work: Callable[[], object], spent: dict[str, list[float]] = spent) -> None:
            start = time.process_time()
            work()
            spent.setdefault(stage, []).append(1e3 * (time.process_time() - start))

        for seed in range(count):
            cell = imperfect_cell(
                np.random.default_rng([42, seed]), wrong=Imperfection(bend_m=3e-4), known=known
            )
            views = cell.views
            blank = replace(views, camera=CameraModel(views.camera.width, views.camera.height))
            priors = Priors(LensPrior.unknown(views.camera))
            took("lens from the pictures", partial(calibrate_intrinsics, blank))
            took("board poses", partial(solve_pnp, views, BOARD))
            took("certified optimum", partial(solve_global, all_pairs(*pose_arrays(views)), seed))
            took("estimate, start and certificate included", partial(fit_cell, views, priors, seed))
            took("other readings of the recording, where they are asked",
                 partial(explain_recording, pose_views(views, 0.02, 0.003), seed))  # fmt: skip
            took("whole solve", partial(solve_views, views, SolveOptions(intrinsics_from_same_pictures=True)))
        rows += [[name, stage, percentiles(np.array(ms))] for stage, ms in spent.items()]
    text = (
        f"After detection: {count} cells of 25 views (63 corners each, lens from the same pictures, board "
        "bent by 0.3 mm). CPU time; the whole solve is `solve_views` with cross-validation and hold-out. "
        f"Load of the machine meanwhile: {_load()}."
    )
    return text + "\n\n" + table(["cells", "stage", "CPU ms, median (5 … 95 %)"], rows)


def _load() -> str:
    return f"{os.getloadavg()[1]:.1f} on {os.cpu_count()} cores"
