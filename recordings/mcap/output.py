"""The file under the library's writer: new, locked, and never continued after a failed write."""

from __future__ import annotations

import os
from pathlib import Path
from typing import IO, cast

from mcap.writer import CompressionType, Writer

from recordings.files import create_exclusively

CHUNK_BYTES = 1024 * 1024


class OutputFile:
    """What the library writes to: every write reaches the operating system whole, or raises OSError."""

    def __init__(self, path: Path) -> None:
        """Creates the empty file exclusively. RecordingError when that fails."""
        self.descriptor = create_exclusively(path)
        self.closed = False
        self.size_bytes = 0

    def writer(self) -> Writer:
        """A library writer into this file: no compression, every checksum and index."""
        return Writer(
            cast(IO[bytes], self),
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.NONE,
            enable_data_crcs=True,
        )

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            done = os.write(self.descriptor, rest)
            self.size_bytes += done
            rest = rest[done:]
        return len(data)

    def tell(self) -> int:
        return self.size_bytes

    def flush(self) -> None:
        """Nothing waits here."""

    def close(self) -> None:
        """Idempotent; what the library still holds is thrown away."""
        if not self.closed:
            self.closed = True
            os.close(self.descriptor)
