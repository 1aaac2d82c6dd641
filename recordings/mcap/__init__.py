"""MCAP as bytes: writing it, proving it in one pass, and finding what is whole in a damaged file.

Nothing here knows what a recording is. Source: the MCAP format specification, version 0 (mcap.dev/spec).
"""

from __future__ import annotations

from recordings.mcap.contents import Contents, MessageIndex
from recordings.mcap.records import MAGIC, BadRecordError
from recordings.mcap.salvage import Salvage, salvage
from recordings.mcap.scan import open_file, scan_file
from recordings.mcap.source import Message, Source
from recordings.mcap.writer import McapFile, Piece

__all__ = [
    "MAGIC",
    "BadRecordError",
    "Contents",
    "McapFile",
    "Message",
    "MessageIndex",
    "Piece",
    "Salvage",
    "Source",
    "open_file",
    "salvage",
    "scan_file",
]
