"""Global minimum of the pair objective: how often the robust solver reaches and proves it.

Each problem is solved by `calibrate.handeye.axxb.robust.solve_global`. The oracle is the lowest of 40 starts
polished by Newton on the same objective; "worse" counts problems in which it found a lower value.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from benchmarks.scene import HIGH, LOW, MID, make_cell
from benchmarks.trials import percentiles, table, trials
from calibrate.geometry import Array, inverse, perturb, pose, random_rotation, rotation_exp
from calibrate.handeye.axxb.pairs import Pairs, all_pairs, consecutive_pairs, mount_poses
from calibrate.handeye.axxb.robust import polish, solve_global

PER_FAMILY = 350
_SAME = 1e-7
"""Relative difference of objectives that counts as the same minimum."""

Family = Callable[[np.random.Generator], Pairs]


def run() -> str:
    count = trials(PER_FAMILY)
    rows, totals = [], np.zeros(4)
    for name, family in FAMILIES.items():
        worse, certified, gaps, times, restarts = _solve_all(family, count, name)
        rows.append([name, count, worse, f"{100 * certified / count:.2f}", f"{gaps.max():.1e}", restarts,
                     percentiles(times)])  # fmt: skip
        totals += [count, worse, certified, restarts]
    share = 100 * totals[2] / totals[0]
    text = f"{totals[0]:.0f} problems: {totals[1]:.0f} worse than the oracle, {share:.2f} % certified."
    header = [
        "family",
        "problems",
        "worse",
        "certified %",
        "largest gap",
        "restarts",
        "CPU ms, median (5 … 95 %)",
    ]
    return text + " CPU time of evolution, polish and certificate.\n\n" + table(header, rows)


def _solve_all(family: Family, count: int, name: str) -> tuple[int, int, Array, Array, int]:
    rng = np.random.default_rng([len(name), count, *name.encode()])
    worse = certified = restarts = 0
    gaps, times = np.zeros(count), np.zeros(count)
    for k in range(count):
        pairs = family(rng)
        start = time.process_time()
        result = solve_global(pairs, seed=k)
        times[k] = 1e3 * (time.process_time() - start)
        gaps[k] = result.certificate.relative_gap
        certified += result.certificate.certified
        restarts += result.certificate.restarts
        starts = np.array([random_rotation(rng) for _ in range(40)])
        lowest = float(polish(result.objective, starts)[1].min())
        own = float(result.objective.gram[12, 12])
        worse += own > lowest + _SAME * max(lowest, result.certificate.floor)
    return worse, certified, gaps, times, restarts


def _paper(noise: object, views: int = 25) -> Family:
    def family(rng: np.random.Generator) -> Pairs:
        cell = make_cell(rng, views, noise)  # type: ignore[arg-type]
        return all_pairs(cell.views.base_from_flange, cell.views.camera_from_board)

    return family


def _motions(
    rng: np.random.Generator, views: int, sigma: tuple[float, float], angle_rad: float | None = None
) -> tuple[Array, Array]:
    """H and C of a camera anywhere, rotations anywhere or within `angle_rad` of a start."""
    X = pose(random_rotation(rng), 0.3 * rng.normal(size=3))
    if angle_rad is None:
        R = np.array([random_rotation(rng) for _ in range(views)])
    else:
        R = rotation_exp(angle_rad * rng.uniform(-1, 1, (views, 3))) @ random_rotation(rng)
    H = pose(R, 0.4 * rng.normal(size=(views, 3)))
    C = inverse(X) @ inverse(H) @ pose(random_rotation(rng), rng.normal(size=3))
    noise = rng.normal(size=(2, views, 6)) * np.repeat(sigma, 3)
    return perturb(H, noise[0]), perturb(C, noise[1])


def _anywhere(views: int, sigma: tuple[float, float], angle_rad: float | None = None) -> Family:
    return lambda rng: all_pairs(*_motions(rng, views, sigma, angle_rad))


def _two_pairs(rng: np.random.Generator) -> Pairs:
    return consecutive_pairs(*_motions(rng, 3, (1e-3, 2e-3)))


def _pure_noise(rng: np.random.Generator) -> Pairs:
    H, _ = _motions(rng, 8, (0, 0))
    C, _ = _motions(rng, 8, (0, 0))
    return all_pairs(H, C)


def _near_pi(rng: np.random.Generator) -> Pairs:
    """Every relative rotation within 2° of a half turn or small."""
    H, _ = _motions(rng, 12, (0, 0))
    axes = rng.normal(size=(12, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angle = np.where(np.arange(12) % 2 == 0, 0.05, np.pi - 0.035 * rng.uniform(0, 1, 12))
    H[:, :3, :3] = rotation_exp(axes * angle[:, None])
    X = pose(random_rotation(rng), 0.3 * rng.normal(size=3))
    C = inverse(X) @ inverse(H) @ pose(random_rotation(rng), rng.normal(size=3))
    return all_pairs(perturb(H, 1e-3 * rng.normal(size=(12, 6))), C)


def _nearly_one_axis(rng: np.random.Generator) -> Pairs:
    X = pose(random_rotation(rng), 0.3 * rng.normal(size=3))
    R = rotation_exp(rng.normal(size=(15, 3)) * [0.02, 0.02, 0.8])
    H = pose(R, 0.4 * rng.normal(size=(15, 3)))
    C = inverse(X) @ inverse(H) @ pose(random_rotation(rng), rng.normal(size=3))
    return all_pairs(perturb(H, 1e-3 * rng.normal(size=(15, 6))), C)


def _wrong_poses(rng: np.random.Generator) -> Pairs:
    H, C = _motions(rng, 20, (5e-4, 1e-3))
    bad = rng.choice(20, 7, replace=False)
    H[bad] = H[np.roll(bad, 1)]
    return all_pairs(H, C)


def _millimetres(rng: np.random.Generator) -> Pairs:
    """Lengths a thousand times too large: the translation outweighs the rotation by a million."""
    H, C = _motions(rng, 10, (1e-3, 2e-3))
    H[:, :3, 3] *= 1e3
    C[:, :3, 3] *= 1e3
    return all_pairs(H, C)


def _far_camera(rng: np.random.Generator) -> Pairs:
    cell = make_cell(rng, 20, MID, mount="eye-to-hand", X=pose(random_rotation(rng), 2 * rng.normal(size=3)))
    return all_pairs(mount_poses(cell.views.base_from_flange, "eye-to-hand"), cell.views.camera_from_board)


FAMILIES: dict[str, Family] = {
    "paper's cell, low noise": _paper(LOW),
    "paper's cell, mid noise": _paper(MID),
    "paper's cell, high noise": _paper(HIGH),
    "paper's cell, 5 views, high noise": _paper(HIGH, 5),
    "eye-to-hand, camera metres away": _far_camera,
    "camera anywhere, clean": _anywhere(10, (0.0, 0.0)),
    "camera anywhere, 25 views": _anywhere(25, (5e-4, 1e-3)),
    "camera anywhere, noise 20 mm, 3°": _anywhere(10, (0.02, 0.05)),
    "small turns (5°)": _anywhere(15, (2e-4, 5e-4), np.radians(5)),
    "two pairs": _two_pairs,
    "near half turns": _near_pi,
    "nearly one axis": _nearly_one_axis,
    "a third of the poses swapped": _wrong_poses,
    "millimetre units": _millimetres,
    "A and B unrelated": _pure_noise,
}
