"""What a power loss may take away: the order in which a program asks for things to be on the disk."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest


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
