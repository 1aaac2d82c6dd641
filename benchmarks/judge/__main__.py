"""`python -m benchmarks.judge`: cells by a generator of its own, solved and held against what is stated.

    python -m benchmarks.judge --out rows.jsonl --cells 600
    python -m benchmarks.judge --out rows.jsonl --table

A run goes on where it was stopped: a cell that the file has is not judged again. Draw 0 are the sizes of
`kinds.KINDS`; `--draw 1 2` are other seeds and other sizes. docs/contributor/judge.md tells what the columns
mean.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.judge.kinds import EVERY, KINDS, UNSEEN
from benchmarks.judge.rows import names, read
from benchmarks.judge.run import run
from benchmarks.judge.tables import tables

_GROUPS = {
    "named": [kind.name for kind in KINDS],
    "unseen": [kind.name for kind in UNSEEN],
    "all": list(EVERY),
}


def main() -> int:
    """Run what is asked, then print the tables."""
    asked = _asked()
    kinds = [kind for given in asked.kinds for kind in _GROUPS.get(given, [given])]
    if not asked.table:
        wanted = list(names(kinds, asked.draw or [0], asked.cells, asked.seed, not asked.untold))
        run(asked.out, wanted, asked.price, asked.workers)
    rows = [row for row in read(asked.out) if row.kind in kinds and row.told != asked.untold]
    if asked.draw:
        rows = [row for row in rows if row.draw in asked.draw]
    print(tables(rows))
    return 0


def _asked() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.judge",
        description="Cells by a generator of its own, solved and held against what is stated.",
    )
    parser.add_argument("--out", type=Path, default=Path("judge.jsonl"), help="the rows, one a line")
    parser.add_argument("--cells", type=int, default=640, help="how many, over all kinds evenly")
    parser.add_argument(
        "--kinds",
        nargs="+",
        default=["all"],
        choices=[*_GROUPS, *EVERY],
        metavar="KIND",
        help=f"of kinds.py, or {', '.join(_GROUPS)}",
    )
    parser.add_argument("--draw", type=int, nargs="+", help="numbers that draw seeds and sizes; 0: as tabled")
    parser.add_argument("--seed", type=int, default=0, help="of the first cells")
    parser.add_argument("--untold", action="store_true", help="the arm's class is not told")
    parser.add_argument("--price", type=float, default=0.2, help="share of cells solved with the arm told")
    parser.add_argument("--workers", type=int, default=2, help="processes, each with one thread")
    parser.add_argument("--table", action="store_true", help="only print the tables of --out")
    return parser.parse_args()


if __name__ == "__main__":
    raise SystemExit(main())
