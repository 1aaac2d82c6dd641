"""Bags on the disk: MCAP files of anyone, proven first; other ROS bags by `rosbags`."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from recordings.errors import ImportSourceError
from recordings.files import PART_SUFFIX, open_file
from recordings.importers.messages import ImageMessage, Kind, Progress, Value, decoded, kind_of, ros_types
from recordings.mcap.contents import Contents, MessageIndex
from recordings.mcap.scan import scan_file
from recordings.mcap.source import Source
from recordings.schema.definitions import SESSION_RECORDS

UNFINISHED = ".mcap" + PART_SUFFIX
"""End of the name of a recording that was not finished."""
BAGS = (".mcap", ".bag", ".db3", ".zstd")
"""Suffixes of files of bags."""
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


class Bag(ABC):
    """A source that is read topic by topic, as often as needed, one message in memory at a time."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self.topics: dict[str, BagTopic] = {}
        """By name."""
        self.others: list[str] = []
        """Topics of kinds that are not used here."""
        self._done = 0

    def _declare(self, name: str, encoding: str, schema: str, messages: int) -> None:
        if (kind := kind_of(encoding, schema)) is None:
            self.others.append(f"{name} ({schema or 'no schema'}, {encoding})")
        else:
            before = self.topics[name].messages if name in self.topics else 0
            self.topics[name] = BagTopic(name, kind, encoding, schema, before + messages)

    @abstractmethod
    def close(self) -> None: ...

    @abstractmethod
    def _read(self, topic: str, places: Collection[int] | None) -> Iterator[tuple[int, bytes]]:
        """(time in ns, data) of a topic's messages, or of those at these places, in file order."""

    @abstractmethod
    def _deserialize(self, data: bytes, schema: str) -> Any:
        """A ROS message."""

    def values(self, topic: str, places: Collection[int] | None = None) -> Iterator[Value]:
        """Yield the values, or those at these places, in the order of the file.

        The first pass over a topic tells how far it is. Raises ImportSourceError.
        """
        told, total = self.topics[topic], sum(known.messages for known in self.topics.values())
        for time_ns, data in self._read(topic, places):
            yield decoded(told.encoding, told.schema, data, time_ns, self._deserialize)
            self._done += 1
            if self._done <= total and self._done % _SHOWN_EVERY == 0:
                self._progress(self._done, total, "reading the bag")

    def images(self, topic: str, places: Collection[int] | None = None) -> Iterator[ImageMessage]:
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
    return _McapBag(mcap, progress) if mcap else _RosBag(ros, progress)


class _McapBag(Bag):
    """One or several MCAP files, with ROS 2 messages, foxglove's, or both."""

    def __init__(self, paths: list[Path], progress: Progress) -> None:
        super().__init__(progress)
        self._files: list[tuple[int, Contents, Source]] = []
        done, total = 0, sum(path.stat().st_size for path in paths)
        for path in paths:
            descriptor = open_file(path)
            try:
                told = partial(self._checked, done, total)
                rescue = "" if path.name.endswith(UNFINISHED) else _RESCUE
                contents, source, _ = scan_file(descriptor, path, rescue, told)
                if SESSION_RECORDS[0] in contents.metadata:
                    raise ImportSourceError("a-recording", path=path)
            except BaseException:
                os.close(descriptor)
                self.close()
                raise
            self._files.append((descriptor, contents, source))
            done += source.size_bytes
            for channel in {channel.topic: channel for channel in contents.channels.values()}.values():
                schema, encoding = contents.schema_of(channel).name, channel.message_encoding
                if encoding == "cdr" and "/msg/" not in schema:  # as some bridges write it
                    schema = "/msg/".join(schema.split("/", 1))
                self._declare(channel.topic, encoding, schema, len(contents.messages[channel.topic]))

    def _checked(self, before: int, total: int, done: int) -> None:
        self._progress(before + done, total, "checking the bag")

    def close(self) -> None:
        while self._files:
            os.close(self._files.pop()[0])

    def _read(self, topic: str, places: Collection[int] | None) -> Iterator[tuple[int, bytes]]:
        place = -1
        for _, contents, source in self._files:
            for address in contents.messages.get(topic, MessageIndex()).addresses:
                place += 1
                if places is None or place in places:
                    found = source.message(address)
                    yield found.log_time, found.data

    def _deserialize(self, data: bytes, schema: str) -> Any:
        return ros_types().deserialize_cdr(data, schema)


class _RosBag(Bag):
    """A ROS 2 bag in sqlite3, whole or a single file, or ROS 1 bags."""

    def __init__(self, paths: list[Path], progress: Progress) -> None:
        super().__init__(progress)
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
        for c in self._reader.connections:
            self._declare(c.topic, "cdr", c.msgtype, c.msgcount)

    def _unreadable(self, error: Exception) -> ImportSourceError:
        return ImportSourceError("unreadable-bag", path=self._path, reason=str(error))

    def close(self) -> None:
        self._reader.close()

    def _read(self, topic: str, places: Collection[int] | None) -> Iterator[tuple[int, bytes]]:
        chosen = [c for c in self._reader.connections if c.topic == topic]
        try:
            for place, (_, time_ns, data) in enumerate(self._reader.messages(connections=chosen)):
                if places is None or place in places:
                    yield time_ns, data
        except Exception as error:
            raise self._unreadable(error) from error

    def _deserialize(self, data: bytes, schema: str) -> Any:
        return self._reader.deserialize(data, schema)
