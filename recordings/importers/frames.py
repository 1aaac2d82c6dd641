"""A bag's frames over time: which chain leads from the base to the flange, and where the flange was when."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recordings.errors import ImportSourceError
from recordings.geometry import matrix_from_quaternion
from recordings.importers.messages import Array, FrameMessage

SAMPLES_LIMIT = 4_000_000
"""Limit over all frames together: 64 bytes each."""
KNOWN_PAIRS = (
    ("base", "tool0"), ("base_link", "tool0"), ("base", "flange"), ("base_link", "flange"),
    ("base_link", "ee_link"), ("base_link", "wrist_3_link"), ("panda_link0", "panda_link8"),
    ("fr3_link0", "fr3_link8"), ("world", "tool0"), ("world", "flange"), ("base", "tool0_controller"),
)  # fmt: skip
"""(base, flange) as robots' drivers name them, best first.

`tool0` is the controller's flange, against which ROS's `flange` is turned. `tool0_controller` of a UR is its
TCP, which holds the pendant's tool.
"""
_TURNED = {"base_link": "base", "flange": "tool0"}
"""Frames of ROS → the controller's, which exports name."""
_UNIT_TOLERANCE = 0.01


@dataclass
class Edge:
    """parent_from_child over time."""

    latched: bool
    """Told once and whenever it changes: it holds until it is told anew."""
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    numbers: array[float] = field(default_factory=lambda: array("d"))
    """Seven a sample: position, quaternion x y z w."""

    def sorted(self) -> tuple[NDArray[np.int64], Array]:
        """(stamps, (n, 7)) in time order, the last of equal stamps; unit quaternions."""
        stamps = np.frombuffer(self.stamps_ns, np.int64)
        table = np.frombuffer(self.numbers).reshape(-1, 7)
        order = np.argsort(stamps, kind="stable")
        stamps, table = stamps[order], table[order]
        last = np.append(np.diff(stamps) > 0, True)
        stamps, table = stamps[last], table[last].copy()
        table[:, 3:] /= np.linalg.norm(table[:, 3:], axis=1, keepdims=True)
        return stamps, table


class FrameTree:
    """All frames of a bag."""

    def __init__(self) -> None:
        self.edges: dict[tuple[str, str], Edge] = {}
        self._samples = 0

    def add(self, frames: Iterable[FrameMessage], latched: bool = False) -> None:
        """Take in frames; `latched`: those of a topic of static transforms."""
        for frame in frames:
            numbers = (*frame.position_m, *frame.rotation_xyzw)
            length = float(np.linalg.norm(frame.rotation_xyzw))
            if not np.isfinite(numbers).all() or abs(length - 1) > _UNIT_TOLERANCE:
                raise ImportSourceError(
                    "not-rigid", parent=frame.parent, child=frame.child, at_ns=frame.stamp_ns
                )
            self._samples += 1
            if self._samples > SAMPLES_LIMIT:
                raise ImportSourceError("too-many-frames", limit=SAMPLES_LIMIT)
            edge = self.edges.setdefault((frame.parent.lstrip("/"), frame.child.lstrip("/")), Edge(latched))
            edge.latched &= latched
            edge.stamps_ns.append(frame.stamp_ns)
            edge.numbers.extend(numbers)

    def chain(self, base: str, flange: str) -> list[tuple[tuple[str, str], bool]]:
        """The edges from base to flange, each with whether it is walked from parent to child; [] if none.

        Up to a common parent, then down: never down to what two parents carry, such as a board, and up again.
        """
        up, down = self._above(base), self._above(flange)
        common = [name for name in up if name in down]
        if not common:
            return []
        top = min(common, key=lambda name: len(up[name]) + len(down[name]))
        return [*((pair, False) for pair in up[top]), *((pair, True) for pair in reversed(down[top]))]

    def _above(self, name: str) -> dict[str, list[tuple[str, str]]]:
        """Frames above one, itself included, and the edges that lead up to each."""
        found: dict[str, list[tuple[str, str]]] = {name: []}
        waiting = [name]
        for child in waiting:
            for pair in self.edges:
                if pair[1] == child and pair[0] not in found:
                    found[pair[0]] = [*found[child], pair]
                    waiting.append(pair[0])
        return found

    def find(self, base: str | None, flange: str | None) -> tuple[str, str]:
        """The names of base and flange, given or known, that a moving chain joins, as the controller's."""
        for known_base, known_flange in KNOWN_PAIRS:
            pair = self._own(base or known_base), self._own(flange or known_flange)
            if any(self.moves(edge) for edge, _ in self.chain(*pair)):
                return pair
        raise self._no_chain(base or "a known base", flange or "a known flange")

    def _own(self, name: str) -> str:
        """The controller's frame, where it stands still to this one of ROS; else the frame itself."""
        for turned, own in _TURNED.items():
            beside = name.removesuffix(turned) + own
            links = self.chain(name, beside) if name.endswith(turned) else []
            if links and not any(self.moves(edge) for edge, _ in links):
                return beside
        return name

    def _no_chain(self, base: str, flange: str) -> ImportSourceError:
        names = ", ".join(sorted({name for pair in self.edges for name in pair})) or "none"
        return ImportSourceError("no-frames", base=base, flange=flange, frames=names)

    def moves(self, pair: tuple[str, str]) -> bool:
        """Tell whether a link moves between the times at which it is told."""
        table = np.frombuffer(self.edges[pair].numbers).reshape(-1, 7)
        return not self.edges[pair].latched and bool(np.ptp(table, axis=0).max() > 0)

    def track(self, base: str, flange: str) -> Track:
        """base_from_flange over time. ImportSourceError when a chain is not there."""
        path = self.chain(base, flange)
        if not path:
            raise self._no_chain(base, flange)
        links = [_Link(*self.edges[pair].sorted(), forward, self.moves(pair)) for pair, forward in path]
        return Track(links)


@dataclass(frozen=True, eq=False)
class _Link:
    stamps_ns: NDArray[np.int64]
    table: Array
    forward: bool
    moving: bool

    def at(self, times_ns: NDArray[np.int64]) -> tuple[Array, Array]:
        """(positions (n, 3), rotations (n, 3, 3)) of this link, interpolated; the ends are held."""
        if not self.moving:
            row = self.table[np.maximum(np.searchsorted(self.stamps_ns, times_ns, "right") - 1, 0)]
        else:
            after = np.clip(np.searchsorted(self.stamps_ns, times_ns), 1, len(self.stamps_ns) - 1)
            t0, t1 = self.stamps_ns[after - 1], self.stamps_ns[after]
            share = np.clip((times_ns - t0) / (t1 - t0), 0.0, 1.0)[:, None]
            a, b = self.table[after - 1], self.table[after].copy()
            b[:, 3:] *= np.where((a[:, 3:] * b[:, 3:]).sum(axis=1) < 0, -1.0, 1.0)[:, None]
            row = (1 - share) * a + share * b
        position = row[:, :3]
        R = matrix_from_quaternion(row[:, 3:])
        if self.forward:
            return position, R
        R = np.swapaxes(R, 1, 2)
        return -np.einsum("nij,nj->ni", R, position), R


@dataclass(frozen=True, eq=False)
class Track:
    """The flange in the base, wherever its frames are known."""

    links: list[_Link]

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """Stamps of the link that is reported most often, (n,) ns."""
        return max((link.stamps_ns for link in self.links if link.moving), key=len)

    def at(self, times_ns: NDArray[np.int64]) -> Array:
        """(n, 4, 4)."""
        T = np.broadcast_to(np.eye(4), (len(times_ns), 4, 4)).copy()
        for link in self.links:
            position, R = link.at(times_ns)
            T[:, :3, 3] += np.einsum("nij,nj->ni", T[:, :3, :3], position)
            T[:, :3, :3] = T[:, :3, :3] @ R
        return T

    def gap_s(self, time_ns: int) -> float:
        """Return the time to the farthest of the moving links' nearest samples; infinite outside them."""
        worst = 0.0
        for link in self.links:
            if link.moving:
                if not link.stamps_ns[0] <= time_ns <= link.stamps_ns[-1]:
                    return float("inf")
                after = int(np.searchsorted(link.stamps_ns, time_ns))
                near = link.stamps_ns[max(0, after - 1) : after + 1]
                worst = max(worst, float(np.abs(near - time_ns).min()) / 1e9)
        return worst
