"""Bags on the disk: MCAP files of anyone, proven first; other ROS bags by `rosbags`."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from recordings.errors import ImportSourceError
from recordings.files import open_file
from recordings.importers.messages import (
    CDR,
    ImageMessage,
    Kind,
    Progress,
    Value,
    decoded,
    kind_of,
    ros_types,
)
from recordings.mcap.contents import Contents
from recordings.mcap.scan import scan_file
from recordings.mcap.source import Source
from recordings.schema.definitions import SESSION_RECORDS

_RESCUE = "mcap recover FILE, with the mcap command line tool"
_SHOWN_EVERY = 64
"""Messages between two reports of progress."""


@dataclass(frozen=True)
class BagTopic:
    """A topic with messages of a kind that an import can use."""

    name: str
    kind: Kind
    encoding: str
    schema: str
    messages: int


_Messages = Iterator[tuple[int, bytes]]
"""(time in ns, data)"""


class _Storage(Protocol):
    declared: list[tuple[str, str, str, int]]
    """Topic, encoding, schema and messages of each channel."""

    def read(self, topic: str, places: list[int] | None) -> _Messages:
        """A topic's messages, or those at the ascending places, in file order."""
        ...

    def deserialize(self, data: bytes, schema: str) -> Any:
        """A ROS message."""
        ...

    def close(self) -> None: ...


class Bag:
    """A source that is read topic by topic, as often as needed, one message in memory at a time."""

    def __init__(self, storage: _Storage, progress: Progress) -> None:
        self._storage, self._progress = storage, progress
        topics: dict[str, BagTopic] = {}
        self.others: list[str] = []
        """Topics of kinds that are not used here."""
        for name, encoding, schema, messages in storage.declared:
            if (kind := kind_of(encoding, schema)) is None:
                self.others.append(f"{name} ({schema or 'no schema'}, {encoding})")
            else:
                before = topics[name].messages if name in topics else 0
                topics[name] = BagTopic(name, kind, encoding, schema, before + messages)
        self.topics = list(topics.values())
        self._by_name = topics
        self._total = sum(topic.messages for topic in self.topics)
        self._done = 0

    def close(self) -> None:
        self._storage.close()

    def values(self, topic: str, places: list[int] | None = None) -> Iterator[Value]:
        """Yield the values, or those at the ascending places, in the order of the file.

        The first pass over a topic tells how far it is. Raises ImportSourceError.
        """
        told = self._by_name[topic]
        for time_ns, data in self._storage.read(topic, places):
            yield decoded(told.encoding, told.schema, data, time_ns, self._storage.deserialize)
            self._done += 1
            if self._done <= self._total and self._done % _SHOWN_EVERY == 0:
                self._progress(self._done, self._total, "reading the bag")

    def images(self, topic: str, places: list[int] | None = None) -> Iterator[ImageMessage]:
        return (image for image in self.values(topic, places) if isinstance(image, ImageMessage))


def open_bag(path: Path, progress: Progress = lambda done, total, text: None) -> Bag:
    """A bag's folder, or one file; MCAP is proven first. Raises ImportSourceError or RecordingError."""
    if not path.exists():
        raise ImportSourceError("no-file", path=path)
    if path.is_dir():
        mcap, ros = sorted(path.glob("*.mcap")), sorted(path.glob("*.bag"))
        if not ros and any(file.suffix in (".db3", ".zstd") for file in path.iterdir()):
            ros = [path]
    else:
        mcap, ros = ([], [path]) if path.suffix in (".bag", ".db3") else ([path], [])
    if not mcap and not ros:
        raise ImportSourceError("no-bag", path=path)
    return Bag(_McapBag(mcap, progress) if mcap else _RosBag(ros), progress)


class _McapBag:
    """One or several MCAP files, with ROS 2 messages, foxglove's, or both."""

    def __init__(self, paths: list[Path], progress: Progress) -> None:
        self._descriptors: list[int] = []
        self._files: list[tuple[Contents, Source]] = []
        self.declared: list[tuple[str, str, str, int]] = []
        done, total = 0, sum(path.stat().st_size for path in paths)
        try:
            for path in paths:
                self._descriptors.append(open_file(path))

                def scanned(bytes_done: int, before: int = done) -> None:
                    progress(before + bytes_done, total, "checking the bag")

                contents, source, _ = scan_file(self._descriptors[-1], path, _RESCUE, scanned)
                self._files.append((contents, source))
                done += source.size_bytes
                if SESSION_RECORDS[0] in contents.metadata:
                    raise ImportSourceError("a-recording", path=path)
                declared: dict[str, tuple[str, str]] = {}
                for channel in contents.channels.values():
                    schema, encoding = contents.schema_of(channel).name, channel.message_encoding
                    if encoding == CDR and "/msg/" not in schema:  # as some bridges write it
                        schema = "/msg/".join(schema.split("/", 1))
                    declared[channel.topic] = encoding, schema
                for topic, (encoding, schema) in declared.items():
                    self.declared.append((topic, encoding, schema, len(contents.messages[topic])))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        while self._descriptors:
            os.close(self._descriptors.pop())

    def deserialize(self, data: bytes, schema: str) -> Any:
        return ros_types().deserialize_cdr(data, schema)

    def read(self, topic: str, places: list[int] | None) -> _Messages:
        wanted = None if places is None else set(places)
        for place, (source, address) in enumerate(self._addresses(topic)):
            if wanted is None or place in wanted:
                found = source.message(address)
                yield found.log_time, found.data

    def _addresses(self, topic: str) -> Iterator[tuple[Source, int]]:
        for contents, source in self._files:
            for address in contents.messages[topic].addresses if topic in contents.messages else ():
                yield source, address


class _RosBag:
    """A ROS 2 bag in sqlite3, whole or a single file, or ROS 1 bags."""

    def __init__(self, paths: Sequence[Path]) -> None:
        types = ros_types()
        from rosbags.highlevel import AnyReader

        self._path = paths[0]
        for path in paths:  # the library opens a pipe and waits
            for file in filter(Path.exists, path.iterdir() if path.is_dir() else [path]):
                if not file.is_dir():
                    os.close(open_file(file))
        try:
            self._reader: Any = AnyReader(paths, default_typestore=types)
            self._reader.open()
        except Exception as error:  # sqlite's, yaml's and the library's own
            raise self._unreadable(error) from error
        self.declared = [(c.topic, CDR, c.msgtype, c.msgcount) for c in self._reader.connections]

    def _unreadable(self, error: Exception) -> ImportSourceError:
        return ImportSourceError("unreadable-bag", path=self._path, reason=str(error))

    def close(self) -> None:
        self._reader.close()

    def deserialize(self, data: bytes, schema: str) -> Any:
        return self._reader.deserialize(data, schema)

    def read(self, topic: str, places: list[int] | None) -> _Messages:
        chosen = [c for c in self._reader.connections if c.topic == topic]
        wanted = None if places is None else set(places)
        messages = enumerate(self._reader.messages(connections=chosen))
        while True:
            try:
                place, (_, time_ns, data) = next(messages)
            except StopIteration:
                return
            except Exception as error:
                raise self._unreadable(error) from error
            if wanted is None or place in wanted:
                yield time_ns, bytes(data)
