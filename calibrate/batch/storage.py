"""Recordings, cells and results that lie elsewhere: URLs that fsspec knows (s3://, sftp://, …; optional)."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

import msgspec

from calibrate.batch.workers import BatchError
from calibrate.files.calibration import write_output
from calibrate.files.lines import S, append_line, parse_lines, read_lines
from calibrate.files.proof import read_bounded
from calibrate.files.validity import FILE as VALIDITY_FILE
from calibrate.files.versions import LOG, LogEntry, content_name
from calibrate.quality.checks import FILE as CHECKS_FILE
from recordings.errors import CodedError

_SMALL = (VALIDITY_FILE, CHECKS_FILE, LOG, "current")


def is_url(place: str) -> bool:
    return "://" in place


@contextmanager
def _storage(url: str) -> Iterator[tuple[Any, str]]:
    """(file system, path on it). Whatever its driver raises becomes a BatchError."""
    import fsspec

    try:
        fs, path = fsspec.core.url_to_fs(url)
        fs.invalidate_cache()  # workers live long, and other machines write there
        yield fs, path
    except CodedError:
        raise
    except ImportError as missing:
        scheme = url.partition("://")[0]
        raise BatchError(
            f"{url}: {missing}.",
            code="package-missing",
            remedy="pip install 'calibration-station[s3]'" if scheme in ("s3", "s3a") else "",
        ) from None
    except Exception as problem:  # every driver has its own
        reason = f"{type(problem).__name__}: {problem}"
        raise BatchError(
            f"{url} cannot be read or written ({reason}).",
            code="storage",
            remedy="Check the address, and the keys that the store's own tools use.",
        ) from None


def expand(place: str) -> list[str]:
    """List what a URL with `*` matches, sorted; other places as they are. BatchError: nothing."""
    if not is_url(place) or "*" not in place:
        return [place]
    with _storage(place) as (fs, path):
        found = sorted(fs.unstrip_protocol(name) for name in fs.glob(path))
    if not found:
        raise BatchError(f"{place} matches nothing.", code="storage-empty", remedy="Check the address.")
    return found


def facts(url: str) -> list[str]:
    """Return a value that changes when any file below the URL does."""
    with _storage(url) as (fs, path):
        return [fs.ukey(name) for name in sorted(fs.find(path))]


@contextmanager
def local_copy(place: str) -> Iterator[Path]:
    """The file or folder itself, or a copy of what a URL names, under its own name."""
    if not is_url(place):
        yield Path(place)
        return
    with TemporaryDirectory(prefix="calibrate-") as folder:
        with _storage(place) as (fs, path):
            target = Path(folder) / PurePosixPath(path).name
            fs.get(path, str(target), recursive=True)
        yield target


@contextmanager
def cell_folder(root: str) -> Iterator[Path]:
    """A cell's state folder, or a copy of what tells the state of its cameras.

    Object stores know no links: `current` is a copy of the installed file there, and becomes a link again.
    """
    if not is_url(root):
        yield Path(root)
        return
    with TemporaryDirectory(prefix="calibrate-") as folder:
        with _storage(root) as (fs, path):
            base = path.rstrip("/") + "/calibrations"
            there = {name: Path(folder, "calibrations", name[len(base) + 1 :]) for name in fs.find(base)}
            for place in there.values():
                place.parent.mkdir(parents=True, exist_ok=True)
            small = [name for name, place in there.items() if place.name in _SMALL]
            if small:
                fs.get(small, [str(there[name]) for name in small])
        for place in there.values():
            if place.name == "current":
                _link_again(place, [other.name for other in there.values() if other.parent.name == "gen"])
        yield Path(folder)


def _link_again(current: Path, names: Sequence[str]) -> None:
    """The copy becomes its version's file again, and `current` a link to it; `names` of the versions."""
    tail = f"-{content_name(read_bounded(current))}.yaml"
    switched = [f"{entry.generation:04d}{tail}" for entry in read_lines(current.parent / LOG, LogEntry)]
    name = max((n for n in names if n.endswith(tail)), key=lambda n: (n in switched[-1:], n), default="")
    if name:
        current.rename(current.parent / "gen" / name)
        current.symlink_to(Path("gen") / name)


@dataclass(frozen=True)
class Results:
    """Place of a batch's results: a folder here, or below a URL."""

    place: str

    def prepare(self) -> None:
        """Make the folder. Raises OSError, BatchError."""
        if not is_url(self.place):
            Path(self.place).mkdir(parents=True, exist_ok=True)

    def write(self, name: str, content: bytes) -> None:
        """Replace a file at once. Raises CalibrationFileError, BatchError."""
        if not is_url(self.place):
            write_output(Path(self.place, name), content)
            return
        with _storage(f"{self.place.rstrip('/')}/{name}") as (fs, path):
            fs.makedirs(path.rpartition("/")[0], exist_ok=True)
            fs.pipe_file(path, content)

    def add(self, name: str, key: str, entry: object) -> None:
        """Add a line to a file of JSON lines; stores of whole objects get one for each line, NAME.d/KEY."""
        if is_url(self.place):
            self.write(f"{name}.d/{key}", msgspec.json.encode(entry) + b"\n")
        else:
            append_line(Path(self.place, name), entry)

    def read(self, name: str, kind: type[S]) -> list[S]:
        """Read what `add` added: oldest first here, sorted by key elsewhere."""
        if not is_url(self.place):
            return read_lines(Path(self.place, name), kind)
        with _storage(f"{self.place.rstrip('/')}/{name}.d") as (fs, path):
            names = sorted(fs.find(path))
            found = fs.cat(names) if names else {}
            return parse_lines(b"".join(found[each] for each in names), kind)


class BatchResult(msgspec.Struct, frozen=True, omit_defaults=True):
    """One recording of a batch: its camera pose and how good it is, or why it could not be solved."""

    recording: str
    key: str
    """Key of recording and options: a finished one is not solved again."""
    solved: bool
    passed: bool = False
    error: str = ""
    session: str = ""
    robot: str = ""
    camera: str = ""
    recorded_wall_ns: int = 0
    mount: str = ""
    translation_m: tuple[float, ...] = ()
    rotation_xyzw: tuple[float, ...] = ()
    covariance: tuple[tuple[float, ...], ...] = ()
    sigma_mm: float | None = None
    sigma_deg: float | None = None
    e_t_mm: float | None = None
    rms_px: float | None = None
    views: int = 0
    rejected: int = 0
    failed_gates: tuple[str, ...] = ()
    calibration: str = ""
    """File name in the output folder."""
    content_sha256: str = ""
    """Hash of the calibration: equal for equal results, whoever computed them."""


def whole(place: Path | str) -> str:
    """An absolute path, or the URL as it is."""
    return str(place) if is_url(str(place)) else os.path.realpath(place)
