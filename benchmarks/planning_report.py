"""Figures of one cell of the planning benchmark, and the tables of all."""

from __future__ import annotations

import msgspec
import numpy as np

from benchmarks.trials import percentiles, rms, rms_spread, table
from calibrate.geometry import Array


class CellResult(msgspec.Struct):
    seed: int
    drawn: int
    """Cells drawn until one was reasonable"""
    squares: dict[str, tuple[float, float, float]] = {}
    """Mean squared errors of X by set of poses: translation mm², rotation degrees², a point ahead mm²"""
    achieved: list[float] = []
    """Translation errors over the predicted sigma"""
    planned: bool = False
    unseen: int = 0
    moves: int = 0
    colliding: int = 0
    narrow: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    motion_s: float = 0.0
    motion_random_s: float = 0.0
    failures: list[str] = []


def report(cells: list[CellResult]) -> str:
    seen = f"{sum(c.drawn for c in cells)} drawn; the rest has no room by an independent check"
    text = (
        f"{len(cells)} random cells ({seen}), 5 visits with new noise per cell to each kind of pose set; "
        "random poses drawn anew for each visit. Root mean square errors of X; ± is over the cells. Point: "
        "the place in `flange` of a point that the camera sees 0.5 m ahead, where translation and rotation "
        "count as they do in use.\n\n"
    )
    heads = ["pool", "poses", "translation, mm", "ratio", "goal"]
    heads += ["rotation, °", "ratio", "point, mm", "ratio"]
    text += table(heads, _error_rows(cells)) + "\n\n" + table(["what", "measured", "goal"], _facts(cells))
    failures = [failure for cell in cells for failure in cell.failures]
    return text + ("\n\nFailures: " + "; ".join(failures) if failures else "")


def _error_rows(cells: list[CellResult]) -> list[list[str]]:
    """Planned against random; spreads over the cells."""
    rows = []
    for pool, goals in (("moderate", ("0.70", "1.0")), ("wide", ("0.78", "1.0"))):
        base = _squares(cells, f"{pool} random 25")
        rows.append([pool, "random 25", _root(base[0]), "1", "", _root(base[1]), "1", _root(base[2]), "1"])
        for number, goal in zip((25, 12), goals, strict=True):
            mine = _squares(cells, f"{pool} planned {number}")
            row = [pool, f"planned {number}"]
            for squares, against in zip(mine, base, strict=True):
                row += [_root(squares), _ratio(squares, against)]
            rows.append([*row[:4], f"≤ {goal}", *row[4:]])
    return rows


def _squares(cells: list[CellResult], name: str) -> Array:
    """(3, cells): translation, rotation, point."""
    return np.array([cell.squares[name] for cell in cells if cell.squares]).T


def _root(square: Array) -> str:
    return f"{np.sqrt(square.mean()):.3g}"


def _ratio(mine: Array, base: Array) -> str:
    """Root of the ratio of sums, ± its standard error with the cell as the unit (delta method)."""
    ratio = np.sqrt(mine.sum() / base.sum())
    spread = np.std(mine - ratio**2 * base) * np.sqrt(len(mine)) / base.sum() / (2 * ratio)
    return f"{ratio:.3f} ± {spread:.3f}"


def _facts(cells: list[CellResult]) -> list[list[str]]:
    planned = [cell for cell in cells if cell.planned]
    by_cell = np.array([rms(np.array(cell.achieved)) for cell in planned])
    moves = sum(cell.moves for cell in cells)
    seconds, cpu = (np.array([getattr(c, n) for c in planned]) for n in ("seconds", "cpu_seconds"))
    motion, other = (np.array([getattr(c, n) for c in planned]) for n in ("motion_s", "motion_random_s"))
    ratio = rms(by_cell)
    return [
        ["full plan of 25", f"{len(planned)} of {len(cells)}", "≥ 99 %"],
        [
            "planned poses from which the true camera misses a corner",
            f"{sum(cell.unseen for cell in cells)} of {25 * len(planned)}",
            "0",
        ],
        [
            "moves that touch something or halve the wanted clearance to table or board",
            f"{sum(cell.colliding for cell in cells)} of {moves}",
            "0",
        ],
        [
            "moves that come nearer than the wanted clearance",
            f"{sum(cell.narrow for cell in cells)} of {moves}",
            "",
        ],
        ["planning, s on the loaded machine", f"{percentiles(seconds)}, most {seconds.max():.1f}", "≤ 20"],
        ["planning, s of CPU", f"{percentiles(cpu)}, most {cpu.max():.1f}", "≤ 20"],
        ["arm motion, s", percentiles(motion), ""],
        ["motion time / random order", f"{motion.mean() / other.mean():.3f}", "≤ 0.6"],
        [
            "predicted / achieved sigma, pooled",
            f"{1 / ratio:.3f} ± {rms_spread(by_cell) / ratio**2:.3f}",
            "0.9-1.1",
        ],
    ]
