"""File of the corners and poses that a monitor has seen, so that it continues after a restart.

    ROOT/calibrations/…/watch.jsonl     first line: the tag that is watched; then one line for each image

Each line is durable once added. Above `_MOST` lines the file is replaced atomically by the learning images
and the latest ones.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path

import msgspec
import numpy as np

from calibrate.boards.model import board_points
from calibrate.files.lines import append_line, read_lines
from calibrate.quality.movement.monitor import MovementEvent, MovementMonitor
from calibrate.quality.movement.pictures import CellModel, Picture
from recordings.files import write_atomically
from recordings.schema.messages import BoardSpec, Joints, Matrix4

FILE = "watch.jsonl"
_MOST, _LATEST = 12_000, 3_000


class WatchedTag(msgspec.Struct, frozen=True):
    """The tag that is watched, and the installed version whose camera pose is monitored."""

    version: int
    tag: BoardSpec
    pose: Matrix4 | None = None
    """base_from_tag (eye-in-hand) or flange_from_tag; given where the first images are deleted."""


class WatchEntry(msgspec.Struct, frozen=True, omit_defaults=True):
    """Line of the file: a start (`begun`), a `gap`, or an image; an image without the tag has no pixels."""

    begun: WatchedTag | None = None
    key: str = ""
    """Source and number of the image, so that none is counted twice."""
    name: str = ""
    wall_s: float = 0.0
    base_from_flange: Matrix4 | None = None
    joints_rad: Joints | None = None
    corners: tuple[int, ...] = ()
    pixels: tuple[tuple[float, float], ...] = ()
    gap: bool = False
    """Images were deleted here, between the learning images and the latest ones."""

    def picture(self, tag: BoardSpec) -> Picture:
        """Convert to the monitor's input."""
        return Picture(
            self.name,
            np.array(self.base_from_flange),
            None if self.joints_rad is None else np.array(self.joints_rad),
            self.corners,
            board_points(tag)[list(self.corners)],
            np.array(self.pixels),
        )


class MonitorLog:
    """A monitor with the file that keeps its input; without a file nothing is kept."""

    def __init__(self, path: Path | None, watched: WatchedTag, cell: CellModel) -> None:
        """Read the file, where there is one for this tag and version. Raises OSError."""
        self._path, self._watched, self._cell = path, watched, cell
        self.monitor = MovementMonitor(cell)
        self._keys: deque[str] = deque(maxlen=_MOST)
        self._known: set[str] = set()
        entries = [] if path is None else read_lines(path, WatchEntry)
        begun = [place for place, entry in enumerate(entries) if entry.begun is not None]
        last = entries[begun[-1]].begun if begun else None
        if last is None or (last.version, last.tag) != (watched.version, watched.tag):
            self.begin_anew()
            return
        self._replay(last, entries[begun[-1] + 1 :])

    def _replay(self, watched: WatchedTag, entries: list[WatchEntry]) -> None:
        self.monitor = MovementMonitor(self._cell, None if watched.pose is None else np.array(watched.pose))
        seen: list[Picture] = []
        for entry in entries:
            self._remember(entry.key)
            if entry.pixels:
                seen.append(entry.picture(watched.tag))
            if entry.gap:
                list(self.monitor.add(seen))
                self.monitor.forget()
                seen = []
        list(self.monitor.add(seen))
        self._lines = len(entries)

    def begin_anew(self) -> None:
        """Forget everything and learn again, for instance after a passed drift check. Raises OSError."""
        self.monitor, self._lines = MovementMonitor(self._cell), 0
        if self._path is not None:
            append_line(self._path, WatchEntry(begun=self._watched))

    def knows(self, key: str) -> bool:
        """Tell whether this picture was taken in before."""
        return key in self._known

    def add(self, entry: WatchEntry) -> list[MovementEvent]:
        """Keep a picture, then judge it. Raises OSError."""
        self._remember(entry.key)
        if self._path is not None:
            append_line(self._path, entry)
            self._lines += 1
            if self._lines > _MOST:
                self._shorten(self._path)
        if not entry.pixels:
            return list(self.monitor.miss(entry.name))
        return list(self.monitor.add([entry.picture(self._watched.tag)]))

    def _remember(self, key: str) -> None:
        if len(self._keys) == self._keys.maxlen:
            self._known.discard(self._keys[0])
        self._keys.append(key)
        self._known.add(key)

    def _shorten(self, path: Path) -> None:
        """Replace the file by the learning images, the tag's pose and the latest images."""
        if self.monitor.P is None:
            return
        rows = tuple(tuple(row) for row in self.monitor.P.tolist())
        begun = WatchEntry(begun=msgspec.structs.replace(self._watched, pose=rows))
        entries = [entry for entry in read_lines(path, WatchEntry) if entry.begun is None]
        count = self._learned(entries)
        latest = [entry for entry in entries[count:] if not entry.gap][-_LATEST:]
        kept = [begun, *entries[:count], WatchEntry(gap=True), *latest]
        write_atomically(path, b"".join(msgspec.json.encode(entry) + b"\n" for entry in kept))
        self._lines = len(kept)

    def _learned(self, entries: list[WatchEntry]) -> int:
        """Count the entries that were learned from."""
        for place, entry in enumerate(entries):
            if entry.gap:
                return place
        with_tag = [place for place, entry in enumerate(entries) if entry.pixels]
        return min(with_tag[self.monitor.learned - 1] + 1 if self.monitor.learned else 0, _LATEST)
