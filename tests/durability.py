"""A disk that is full or fails once; what a power loss may take away: what is asked of the disk, in order."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest


def full(*_: object) -> int:
    """In place of a call that writes."""
    raise OSError(28, "No space left on device")


@contextmanager
def disk_order(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """`sync NAME`, `rename FROM TO` and `remove NAME`, in order, of whatever the block does."""
    order: list[str] = []

    def synced(descriptor: int) -> str:
        return f"sync {Path(f'/proc/self/fd/{descriptor}').readlink().name}"

    def renamed(source: Any, target: Any, **_: Any) -> str:
        return f"rename {Path(source).name} {Path(target).name}"

    def noting(name: str, words: Any) -> Any:
        real = getattr(os, name)

        def call(*arguments: Any, **options: Any) -> Any:
            order.append(words(*arguments))
            return real(*arguments, **options)

        return call

    with monkeypatch.context() as patch:
        for name, words in (("fsync", synced), ("rename", renamed), ("replace", renamed)):
            patch.setattr(os, name, noting(name, words))
        yield order


# --- every request to the disk ---
@dataclass(frozen=True)
class Request:
    """One request to the disk, as it was made."""

    kind: str
    """write, truncate, sync, create, rename, link or remove"""
    path: Path
    content: bytes = b""
    """Of a write."""
    place: int = 0
    """Where a write begins; length after truncation."""
    other: Path = Path()
    """New name of a rename; what a link points to."""


@dataclass
class Disk:
    """Requests of a block of code, the `fails`th of which is refused; counted from 0, -1: none."""

    fails: int = -1
    half: bool = False
    """A refused write has written half of its bytes."""
    requests: list[Request] = field(default_factory=list)
    quiet: bool = False

    def ask(self, request: Request, do: Callable[[], Any], do_half: Callable[[], Any] | None = None) -> Any:
        if self.quiet:
            return do()
        self.requests.append(request)
        if len(self.requests) - 1 == self.fails:
            if self.half and do_half is not None:
                do_half()
            full()
        return do()

    @property
    def failed(self) -> bool:
        return len(self.requests) > self.fails >= 0


class _File:
    """An open file whose writes are asked of the disk."""

    def __init__(self, disk: Disk, file: Any, path: Path) -> None:
        self._disk, self._file, self._path = disk, file, path

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def __enter__(self) -> _File:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, content: Any) -> Any:
        content = bytes(content)
        request = Request("write", self._path, content, self._file.tell())
        half = content[: len(content) // 2]
        return self._disk.ask(request, lambda: self._put(content), lambda: self._put(half))

    def _put(self, content: bytes) -> Any:
        written = self._file.write(content)
        self._file.flush()
        return written

    def truncate(self, size: int) -> Any:
        request = Request("truncate", self._path, place=size)
        return self._disk.ask(request, lambda: self._file.truncate(size))


@contextmanager
def watched_disk(monkeypatch: pytest.MonkeyPatch, fails: int = -1, half: bool = False) -> Iterator[Disk]:
    """The disk for the block: `os` and the files that `os.fdopen` opens."""
    disk = Disk(fails, half)
    real = {
        name: getattr(os, name)
        for name in ("open", "fdopen", "fsync", "rename", "replace", "symlink", "unlink")
    }

    def opened(path: Any, flags: int, *arguments: Any, **options: Any) -> int:
        def do() -> int:
            number: int = real["open"](path, flags, *arguments, **options)
            return number

        new = flags & os.O_CREAT and not os.path.lexists(path)
        return disk.ask(Request("create", Path(path)), do) if new else do()

    def as_file(descriptor: int, *arguments: Any, **options: Any) -> _File:
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        return _File(disk, real["fdopen"](descriptor, *arguments, **options), path)

    def synced(descriptor: int) -> None:
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        disk.ask(Request("sync", path), lambda: real["fsync"](descriptor))

    def renamed(source: Any, target: Any, **options: Any) -> None:
        request = Request("rename", Path(source), other=Path(target))
        disk.ask(request, lambda: real["rename"](source, target, **options))

    def linked(target: Any, path: Any, *arguments: Any, **options: Any) -> None:
        request = Request("link", Path(path), other=Path(target))
        disk.ask(request, lambda: real["symlink"](target, path, *arguments, **options))

    def removed(path: Any, **options: Any) -> None:
        if not os.path.lexists(path):
            real["unlink"](path, **options)
        disk.ask(Request("remove", Path(path)), lambda: real["unlink"](path, **options))

    with monkeypatch.context() as patch:
        patch.setattr(os, "open", opened)
        patch.setattr(os, "fdopen", as_file)
        patch.setattr(os, "fsync", synced)
        patch.setattr(os, "rename", renamed)
        patch.setattr(os, "replace", renamed)
        patch.setattr(os, "symlink", linked)
        patch.setattr(os, "unlink", removed)
        yield disk


def after_power_cut(before: Path, live: Path, requests: list[Request], target: Path, lost: bool) -> None:
    """Write to `target` what a disk holds that lost its power behind `requests`.

    `before`: copy of the folder `live` from before them. `lost`: contents that nobody asked to be on the disk
    are gone, though names that were made later are there, as some file systems do it. Else half of the last
    write is there.
    """
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(before, target, symlinks=True)
    contents: dict[Path, bytes] = {}
    """What was asked of each file, by its path in `target`."""
    synced: dict[Path, bytes] = {}
    for number, request in enumerate(requests):
        path = target / request.path.relative_to(live)
        if request.kind in ("write", "truncate") and path not in contents:
            contents[path] = synced[path] = path.read_bytes()
        if request.kind == "create":
            path.touch()
            contents[path] = synced[path] = b""
        elif request.kind == "write":
            torn = not lost and number == len(requests) - 1
            content = request.content[: len(request.content) // 2] if torn else request.content
            old = contents[path]
            contents[path] = old[: request.place] + content + old[request.place + len(content) :]
        elif request.kind == "truncate":
            contents[path] = contents[path][: request.place]
        elif request.kind == "sync" and path in contents:
            synced[path] = contents[path]
        elif request.kind == "rename":
            other = target / request.other.relative_to(live)
            path.rename(other)
            for kept in (contents, synced):
                if path in kept:
                    kept[other] = kept.pop(path)
        elif request.kind == "link":
            path.symlink_to(request.other)
        elif request.kind == "remove":
            path.unlink()
            contents.pop(path, None)
    for path, content in (synced if lost else contents).items():
        if path in contents:
            path.write_bytes(content)
