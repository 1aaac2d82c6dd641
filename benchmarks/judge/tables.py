"""The tables of a file of rows, as markdown."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from scipy import stats

from benchmarks.judge.kinds import EVERY
from benchmarks.judge.rows import Row

_ABOVE = 2.0
"""A cell's rms above so many times what is stated counts as understated."""
_NAMED = 0.5
"""A kind of which more than this share is refused is one that is refused by name."""
_MOUNTS = {"eye-in-hand": "in hand", "eye-to-hand": "fixed"}


def tables(rows: list[Row]) -> str:
    """All tables of the rows."""
    draws = ", ".join(str(draw) for draw in sorted({row.draw for row in rows}))
    parts = [f"{len(rows)} cells, draw {draws}, {len({row.kind for row in rows})} kinds."]
    pools = _pools(rows)
    sections: list[tuple[str, str]] = [
        ("Placed point: error over what is stated", _points(pools, "cells")),
        ("The same by class", _points(_grouped(rows, lambda row: f"{row.arm}, {_joints(row)}"), "class")),
        ("The same by kind", _points(_grouped(rows, lambda row: row.kind), "kind")),
        ("95 % region of X", _regions(pools)),
        ("Passes: placed point beyond three times what is stated", _wrong_passes(pools)),
        ("The distance that holds 95 of 100", _p95(pools)),
        ("Parts of what is stated", _parts(pools)),
        ("Price of honesty", _prices(pools)),
        ("Refusals and verdicts by kind", _verdicts(rows)),
        ("Gates that are closed", _gates(rows)),
        ("CPU of a solve", _cpu(pools)),
    ]
    parts += [f"## {title}\n{body}" for title, body in sections if body]
    return "\n\n".join(parts)


def interval(count: int, of: int) -> tuple[float, float]:
    """95 % interval of a share by the binomial distribution (C. J. Clopper, E. S. Pearson, 1934)."""
    low = stats.beta.ppf(0.025, count, of - count + 1) if count else 0.0
    high = stats.beta.ppf(0.975, count + 1, of - count) if count < of else 1.0
    return float(low), float(high)


def _joints(row: Row) -> str:
    return "joints" if row.joints else "none"


def _grouped(rows: Iterable[Row], by: Callable[[Row], str]) -> dict[str, list[Row]]:
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(by(row), []).append(row)
    order = {kind: place for place, kind in enumerate(EVERY)}
    return dict(sorted(groups.items(), key=lambda item: (order.get(item[0], 0), item[0])))


def _pools(rows: list[Row]) -> dict[str, list[Row]]:
    """By mount and joints, and all together."""
    pools = _grouped(rows, lambda row: f"{_MOUNTS[row.mount]}, {_joints(row)}")
    return pools | {"all": rows}


def _points(groups: dict[str, list[Row]], title: str) -> str:
    header = [title, "answers"]
    for place in ("recorded", "workspace"):
        header += [f"{place}: rms/stated", "median/stated", f"rms above {_ABOVE:g} × %"]
    header += ["stated mm", "rms mm", "workspace rms mm"]
    lines = []
    for name, group in groups.items():
        solved = [row for row in group if row.rms is not None and row.stated and row.stated_workspace]
        cells: list[str] = [name, f"{len(solved)} of {len(group)}"]
        cells += _ratios([(row.rms, row.median, row.stated) for row in solved])
        cells += _ratios([(row.rms_workspace, row.median_workspace, row.stated_workspace) for row in solved])
        cells += [_middle([row.stated for row in solved])]
        cells += [_middle([row.rms for row in solved]), _middle([row.rms_workspace for row in solved])]
        lines.append(cells)
    return _table(header, lines)


def _ratios(values: list[tuple[float | None, float | None, float | None]]) -> list[str]:
    whole = np.array([value for value in values if None not in value], dtype=float)
    if not len(whole):
        return ["–", "–", "–"]
    rms = whole[:, 0] / whole[:, 2]
    median = whole[:, 1] / whole[:, 2]
    return [f"{np.median(rms):.2f}", f"{np.median(median):.2f}", f"{100 * (rms > _ABOVE).mean():.0f}"]


def _regions(pools: dict[str, list[Row]]) -> str:
    header = [
        "cells", "answers", "holds the real X", "95 % interval", "median χ²/6",
        "installed X holds the real one", "median χ²/6", "installed X holds the told one", "median χ²/6",
    ]  # fmt: skip
    lines = []
    for name, group in pools.items():
        solved = [row for row in group if row.square is not None]
        cells = [name, str(len(solved))]
        for column in ("square", "square_installed", "square_told"):
            squares = np.array([getattr(row, column) for row in solved], dtype=float)
            limits = np.array([row.threshold for row in solved], dtype=float)
            held = int((squares <= limits).sum())
            cells.append(f"{held / max(len(solved), 1):.3f}")
            if column == "square":
                low, high = interval(held, max(len(solved), 1))
                cells.append(f"{low:.3f} … {high:.3f}")
            cells.append(f"{np.median(squares) / 6:.2f}" if len(solved) else "–")
        lines.append(cells)
    return _table(header, lines)


def _wrong_passes(pools: dict[str, list[Row]]) -> str:
    header = [
        "cells", "passes", "one point a cell: beyond", "95 % interval", "all points beyond %",
        "workspace: beyond", "95 % interval", "all points beyond %", "cells with rms beyond",
    ]  # fmt: skip
    lines = []
    for name, group in pools.items():
        passed = [row for row in group if row.passed and row.one is not None and row.stated]
        cells = [name, str(len(passed))]
        cells += _beyond([(row.one, row.stated, row.beyond) for row in passed])
        cells += _beyond([(row.one_workspace, row.stated_workspace, row.beyond_workspace) for row in passed])
        cells.append(str(sum((row.rms or 0.0) > 3.0 * (row.stated or np.inf) for row in passed)))
        lines.append(cells)
    return _table(header, lines)


def _beyond(values: list[tuple[float | None, float | None, float | None]]) -> list[str]:
    whole = np.array([value for value in values if None not in value], dtype=float)
    if not len(whole):
        return ["–", "–", "–"]
    count = int((whole[:, 0] > 3.0 * whole[:, 1]).sum())
    low, high = interval(count, len(whole))
    return [
        f"{count} of {len(whole)}",
        f"{100 * low:.2f} … {100 * high:.2f} %",
        f"{100 * whole[:, 2].mean():.2f}",
    ]


def _p95(pools: dict[str, list[Row]]) -> str:
    lines = []
    for name, group in pools.items():
        shares = [row.within_p95 for row in group if row.within_p95 is not None]
        if shares:
            lines.append([name, str(len(shares)), f"{100 * np.mean(shares):.1f}"])
    return _table(["cells", "answers", "points within it %"], lines) if lines else ""


def _parts(pools: dict[str, list[Row]]) -> str:
    """Medians of the parts in millimetres, and where the arm's comes from."""
    lines = []
    parts = sorted({part for row in pools["all"] for part in row.stated_parts or {}})
    for name, group in pools.items():
        told = [row for row in group if row.stated_parts]
        arms = Counter(row.stated_arm for row in told)
        sizes = [_middle([(row.stated_parts or {}).get(part) for row in told]) for part in parts]
        lines.append([name, *sizes, ", ".join(f"{arm} {count}" for arm, count in arms.most_common())])
    return _table(["cells", *(f"{part} mm" for part in parts), "arm"], lines) if parts else ""


def _prices(pools: dict[str, list[Row]]) -> str:
    lines = []
    for name, group in pools.items():
        ratios = np.array([row.stated / row.price for row in group if row.price and row.stated])
        if len(ratios):
            low, middle, high = np.percentile(ratios, [10, 50, 90])
            lines.append([name, str(len(ratios)), f"{middle:.2f}", f"{low:.2f} … {high:.2f}"])
    return _table(["cells", "asked", "stated over stated with the arm told, median", "10 … 90 %"], lines)


def _verdicts(rows: list[Row]) -> str:
    lines = []
    refused_kinds = []
    elsewhere = [0, 0]
    for kind, group in _grouped(rows, lambda row: row.kind).items():
        names = Counter(row.named for row in group if row.named)
        share = sum(names.values()) / len(group)
        if share > _NAMED:
            refused_kinds.append(kind)
        else:
            elsewhere[0] += sum(names.values())
            elsewhere[1] += len(group)
        passes = sum(row.passed for row in group)
        told = ", ".join(f"{name} {count}" for name, count in names.most_common())
        lines.append([kind, str(len(group)), str(passes), f"{100 * share:.0f}", told])
    all_elsewhere = 100 * elsewhere[0] / max(elsewhere[1], 1)
    summary = (
        f"Refused by name (more than half of the cells): {', '.join(refused_kinds) or 'none'}. Refused of "
        f"the other kinds: {elsewhere[0]} of {elsewhere[1]}, {all_elsewhere:.1f} %."
    )
    return _table(["kind", "cells", "passes", "refused %", "as what"], lines) + "\n\n" + summary


def _gates(rows: list[Row]) -> str:
    closed = Counter(gate for row in rows for gate in row.closed)
    alone = Counter(row.closed[0] for row in rows if len(row.closed) == 1)
    lines = [[gate, str(count), str(alone[gate])] for gate, count in closed.most_common()]
    return _table(["gate", "closed", "alone"], lines)


def _cpu(pools: dict[str, list[Row]]) -> str:
    lines = []
    for name, group in pools.items():
        seconds = np.array([row.cpu_s for row in group if row.cpu_s is not None])
        if len(seconds):
            middle, high = np.percentile(seconds, [50, 95])
            lines.append([name, f"{seconds.mean():.2f}", f"{middle:.2f}", f"{high:.2f}"])
    return _table(["cells", "mean s", "median s", "95 % s"], lines)


def _middle(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{np.median(known):.3g}" if known else "–"


def _table(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    rows = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    rows += ["| " + " | ".join(line) + " |" for line in lines]
    return "\n".join(rows)
