"""A disk that is full; what a power loss may take away: in which order things are asked to be on the disk."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
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
