"""Calibrations of one cell over time: camera pose, its uncertainty, and when it moved."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise, zip_longest

import numpy as np
from scipy import special

from calibrate.batch.storage import BatchResult
from calibrate.geometry import Array, difference, matrix_from_quaternion, pose

_FALSE_ALARM = 1e-4
"""Probability that two sessions of an untouched camera are told apart: one in 10 000 comparisons."""


@dataclass(frozen=True)
class Move:
    """Move from one session's X to another's, in X's parent frame (flange or base)."""

    earlier: BatchResult
    later: BatchResult
    distance_mm: float
    angle_deg: float
    sigmas: float
    """Mahalanobis length of the difference, the two sessions taken as independent."""
    real: bool
    """Beyond what chance explains (see `_FALSE_ALARM`)."""
    creep: bool = False
    """No single step stands out between the two sessions."""

    @property
    def text(self) -> str:
        where = "on the flange" if self.later.mount == "eye-in-hand" else "in the base frame"
        return (
            f"Camera {'crept' if self.creep else 'moved'} {self.distance_mm:.2f} mm, {self.angle_deg:.3f}° "
            f"{where} between {label(self.earlier)} and {label(self.later)} ({self.sigmas:.0f}σ)"
        )


_UNNAMED_ROBOT = ("", "unknown")
NOT_FOLLOWED = (
    "These recordings do not say of which robot they are, so nobody can tell whether one camera moved "
    "between them. Name it in dataset.yaml (robot: NAME) and import again."
)


@dataclass(frozen=True)
class CellHistory:
    """One robot with one camera in one mount, by their serial numbers."""

    name: str
    sessions: tuple[BatchResult, ...]
    """Solved ones, oldest first."""
    moves: tuple[Move, ...]
    """From each session to the next; none where the robot is not named."""
    followed: bool
    """False: the robot is not named, these may be sessions of many cells."""

    @property
    def findings(self) -> list[Move]:
        """Real moves; a creep that no single step shows is found between the first and the last."""
        jumps = [move for move in self.moves if move.real]
        if jumps or len(self.sessions) < 3 or not self.followed:
            return jumps
        whole = replace(_move(self.sessions[0], self.sessions[-1]), creep=True)
        return [whole] if whole.real else []


def cells(results: Iterable[BatchResult]) -> tuple[CellHistory, ...]:
    """Solved results grouped by robot, camera and mount; by name."""
    groups: dict[str, list[BatchResult]] = {}
    for result in results:
        if result.solved:
            name = f"{result.robot or 'robot unknown'}, {result.camera or 'camera unknown'}, {result.mount}"
            groups.setdefault(name, []).append(result)
    found = []
    for name in sorted(groups):
        sessions = sorted(groups[name], key=lambda r: (r.recorded_wall_ns, r.recording))
        followed = sessions[0].robot not in _UNNAMED_ROBOT
        steps = pairwise(sessions) if followed else ()
        found.append(CellHistory(name, tuple(sessions), tuple(_move(a, b) for a, b in steps), followed))
    return tuple(found)


def label(result: BatchResult) -> str:
    """Name and day of a session."""
    return f"{result.session or result.recording} ({day(result)})"


def day(result: BatchResult) -> str:
    if not result.recorded_wall_ns:
        return "day unknown"
    return datetime.fromtimestamp(result.recorded_wall_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M")


def place(result: BatchResult) -> Array:
    """X, (4, 4)."""
    return pose(matrix_from_quaternion(np.array(result.rotation_xyzw)), np.array(result.translation_m))


def quiet_text(found: Sequence[CellHistory]) -> str:
    """Say that nobody's camera moved, or that nothing could be compared."""
    if found and not any(cell.followed for cell in found):
        return "No camera was followed."
    return "No camera moved by more than chance explains."


def trends_text(found: Sequence[CellHistory]) -> str:
    """Plain text: findings first, then one table per cell."""
    lines = [f"{cell.name}: {finding.text}" for cell in found for finding in cell.findings]
    lines = lines or [quiet_text(found)]
    for cell in found:
        lines += [
            "",
            cell.name,
            *([] if cell.followed else [NOT_FOLLOWED]),
            _row(HEAD),
            *(_row(row) for row in rows(cell)),
        ]
    return "\n".join(lines) + "\n"


HEAD = (
    *("recorded (UTC)", "session", "x mm", "y mm", "z mm", "1σ mm", "1σ °"),
    *("moved mm", "turned °", "sigmas", ""),
)


def rows(cell: CellHistory) -> list[tuple[str, ...]]:
    """Table rows under HEAD; the last column holds MOVED and the gates that failed."""
    found: list[tuple[str, ...]] = []
    for session, move in zip_longest(cell.sessions, (None, *cell.moves)):
        x, y, z = (f"{v * 1000:.3f}" for v in session.translation_m)
        sigma = (f"{session.sigma_mm or 0:.3f}", f"{session.sigma_deg or 0:.4f}")
        step = ("", "", "")
        if move is not None:
            step = (f"{move.distance_mm:.3f}", f"{move.angle_deg:.4f}", f"{move.sigmas:.1f}")
        notes = ["MOVED"] if move is not None and move.real else []
        if session.failed_gates:
            notes.append(f"failed: {', '.join(session.failed_gates)}")
        found.append((day(session), session.session, x, y, z, *sigma, *step, "; ".join(notes)))
    return found


def _row(cells_of_row: Sequence[str]) -> str:
    when, session, *numbers, note = cells_of_row
    return f"{when:16}  {session[:28]:28}" + "".join(f"{n:>10}" for n in numbers) + f"  {note}".rstrip()


def _move(earlier: BatchResult, later: BatchResult) -> Move:
    """Both covariances add. If nothing moved, δᵀ C⁻¹ δ follows 6 F(6, ν) as in `drift`; ν = 3n - 6 is that of
    the session of fewer views."""
    delta = difference(place(later), place(earlier))
    covariance = np.array(earlier.covariance) + np.array(later.covariance)
    square = max(0.0, float(delta @ np.linalg.pinv(covariance, hermitian=True) @ delta))
    freedom = max(3 * min(earlier.views, later.views) - 6, 3)
    limit = float(6 * special.fdtri(6, freedom, 1 - _FALSE_ALARM))
    distance_mm, angle_deg = np.linalg.norm(delta[:3]) * 1e3, np.degrees(np.linalg.norm(delta[3:]))
    return Move(earlier, later, float(distance_mm), float(angle_deg), float(np.sqrt(square)), square > limit)
