"""One row a cell: what the solver answered, what it stated, and how far off it was; as a line of JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from benchmarks.judge import solver
from benchmarks.judge.arms import ARMS
from benchmarks.judge.cell import MOUNTS, Name, NoCellError, make
from benchmarks.judge.frames import Array, Flags, difference
from benchmarks.judge.placed_point import (
    arm_error,
    errors,
    recorded_postures,
    told_camera,
    workspace_postures,
)

FORM = 1
"""Of a row. A file of another form is not continued."""
_BEYOND = 3.0


@dataclass(frozen=True)
class Row:
    """A cell as it was judged. Lengths in millimetres; None where there was no answer."""

    kind: str
    arm: str
    mount: str
    joints: bool
    draw: int
    seed: int
    told: bool = True
    """The arm's class was told."""
    form: int = FORM
    refused: str = ""
    """Code of the refusal, `no-cell` where the generator found none; empty where there was an answer."""
    named: str = ""
    """The same, or the reading that the session gate names."""
    closed: tuple[str, ...] = ()
    passed: bool = False
    stated: float | None = None
    stated_workspace: float | None = None
    stated_p95: float | None = None
    at_m: float | None = None
    stated_parts: dict[str, float] | None = None
    stated_arm: str = ""
    rms: float | None = None
    """Of |e|, at recorded postures."""
    median: float | None = None
    beyond: float | None = None
    """Share of |e| above three times what is stated."""
    within_p95: float | None = None
    """Share of |e| within the stated 95 % distance."""
    one: float | None = None
    """|e| of one pair of postures: independent from cell to cell."""
    rms_workspace: float | None = None
    median_workspace: float | None = None
    beyond_workspace: float | None = None
    one_workspace: float | None = None
    square: float | None = None
    """χ² of the fit's X, which goes with the corrected arm where there is one, against the real camera, by
    its covariance."""
    square_installed: float | None = None
    """The same of the X that is installed."""
    square_told: float | None = None
    """The same of the X that is installed, against the X that the told flanges imply."""
    threshold: float | None = None
    shift: float | None = None
    """Distance of X from the real camera."""
    told_shift: float | None = None
    """Distance of the X that the told flanges imply from the real camera."""
    arm_rms: float | None = None
    """Of the real flange against the told one over the workspace, in space."""
    price: float | None = None
    """What the same solver states where it is told the size of this arm's errors; None: not asked."""
    cpu_s: float | None = None

    @property
    def key(self) -> tuple[object, ...]:
        """The cell's name."""
        return self.kind, self.arm, self.mount, self.joints, self.draw, self.seed, self.told


def measure(name: Name, price: bool) -> Row:
    """Make the cell of this name, have it solved, and measure.

    price: have it solved once more by the solver that is told the size of this arm's errors.
    """
    whose = (name.kind, name.arm, name.mount, name.joints, name.draw, name.seed, name.told)
    try:
        cell = make(name)
    except NoCellError:
        return Row(*whose, refused="no-cell", named="no-cell")
    answered = solver.answer(cell)
    if answered.X is None or answered.covariance is None or answered.stated is None:
        return Row(*whose, refused=answered.refused, named=answered.named, cpu_s=round(answered.cpu_s, 4))
    rng = np.random.default_rng([*name.numbers, 1])
    stated = answered.stated
    at = np.array([0.0, 0.0, stated.at_m])
    recorded = _lengths_mm(errors(cell, answered.X, at, recorded_postures(cell, rng), rng))
    over_all = _lengths_mm(errors(cell, answered.X, at, workspace_postures(cell, at, rng), rng))
    X_told = told_camera(cell)
    accuracy_m, accuracy_rad = arm_error(cell, rng)
    within = None if stated.p95_mm is None else _share(recorded <= stated.p95_mm)
    asked = solver.answer_with_arm_told(cell, accuracy_m, accuracy_rad) if price else None
    return Row(
        *whose,
        named=answered.named,
        closed=answered.closed,
        passed=answered.passed,
        stated=_short(stated.error_mm),
        stated_workspace=_short(stated.workspace_mm),
        stated_p95=None if stated.p95_mm is None else _short(stated.p95_mm),
        at_m=_short(stated.at_m),
        stated_parts={part: _short(size) for part, size in stated.parts_mm.items()} or None,
        stated_arm=stated.arm,
        rms=_rms(recorded),
        median=_short(float(np.median(recorded))),
        beyond=_share(recorded > _BEYOND * stated.error_mm),
        within_p95=within,
        one=_short(float(recorded[0])),
        rms_workspace=_rms(over_all) if len(over_all) else None,
        median_workspace=_short(float(np.median(over_all))) if len(over_all) else None,
        beyond_workspace=_share(over_all > _BEYOND * stated.workspace_mm) if len(over_all) else None,
        one_workspace=_short(float(over_all[0])) if len(over_all) else None,
        square=_square(answered.X_corrected, answered.covariance_corrected, cell.X),
        square_installed=_square(answered.X, answered.covariance, cell.X),
        square_told=_square(answered.X, answered.covariance, X_told),
        threshold=_short(answered.threshold),
        shift=_shift_mm(answered.X, cell.X),
        told_shift=_shift_mm(X_told, cell.X),
        arm_rms=_short(1e3 * np.sqrt(3.0) * accuracy_m),
        price=None if asked is None or asked.stated is None else _short(asked.stated.error_mm),
        cpu_s=round(answered.cpu_s, 4),
    )


def names(
    kinds: list[str], draws: list[int], count: int, first_seed: int = 0, told: bool = True
) -> Iterator[Name]:
    """The first `count` names: every kind in turn, so that any number of cells covers them evenly.

    Class, mount and joints go through their sixteen combinations, another one for each kind; then the next
    seed. With several draws each combination has them all.
    """
    combinations = [
        (arm, mount, joints, draw)
        for draw in draws
        for joints in (True, False)
        for mount in MOUNTS
        for arm in ARMS
    ]
    for i in range(count):
        turn, place = divmod(i, len(kinds))
        seed, part = divmod(turn, len(combinations))
        arm, mount, joints, draw = combinations[(part + 5 * place) % len(combinations)]
        yield Name(kinds[place], arm, mount, joints, draw, first_seed + seed, told)


def read(path: Path) -> list[Row]:
    """The rows of a file, none where there is no file; a last line that was cut short is left out."""
    if not path.exists():
        return []
    known = {field.name for field in fields(Row)}
    rows = []
    for line in path.read_text().splitlines():
        try:
            told = json.loads(line)
        except json.JSONDecodeError:
            continue
        if told.get("form") != FORM:
            raise SystemExit(f"{path}: a row of form {told.get('form')}, not {FORM}. Give another --out.")
        told["closed"] = tuple(told["closed"])
        rows.append(Row(**{name: value for name, value in told.items() if name in known}))
    return rows


def key(name: Name) -> tuple[object, ...]:
    """As `Row.key`."""
    return name.kind, name.arm, name.mount, name.joints, name.draw, name.seed, name.told


def line(row: Row) -> str:
    """The row as JSON, without its newline."""
    return json.dumps({name: value for name, value in asdict(row).items() if value is not None})


def _lengths_mm(errors_m: Array) -> Array:
    return np.asarray(1e3 * np.linalg.norm(errors_m, axis=1))


def _rms(lengths_mm: Array) -> float:
    return _short(float(np.sqrt((lengths_mm**2).mean())))


def _share(true: Flags) -> float:
    return _short(float(np.mean(true)))


def _square(X: Array | None, covariance: Array | None, truth: Array) -> float | None:
    if X is None or covariance is None:
        return None
    delta = difference(X, truth)
    return _short(float(delta @ np.linalg.solve(covariance, delta)))


def _shift_mm(X: Array, truth: Array) -> float:
    return _short(1e3 * float(np.linalg.norm(X[:3, 3] - truth[:3, 3])))


def _short(value: float) -> float:
    """Five digits: enough for every table, and a file of half the size."""
    return float(f"{value:.5g}")
