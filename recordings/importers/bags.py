"""Bags on the disk: MCAP files of anyone by this package's own reader, ROS 2 sqlite3 bags by `rosbags`."""

from __future__ import annotations

import os
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from recordings.errors import ImportSourceError
from recordings.files import open_file
from recordings.importers.messages import (
    CDR,
    STAMP_BYTES,
    ImageMessage,
    Kind,
    Progress,
    Value,
    decoded,
    kind_of,
    ros_image_stamp_ns,
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

    def read(self, topic: str, places: list[int] | None, limit_bytes: int | None) -> _Messages:
        """A topic's messages, or those at the ascending places, in file order.

        `limit_bytes`: only the beginning is needed.
        """
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

    def _read(self, topic: str, places: list[int] | None = None, limit_bytes: int | None = None) -> _Messages:
        """The first pass over a topic tells how far it is."""
        for message in self._storage.read(topic, places, limit_bytes):
            yield message
            self._done += 1
            if self._done <= self._total and self._done % _SHOWN_EVERY == 0:
                self._progress(self._done, self._total, "reading the bag")

    def values(self, topic: str) -> Iterator[Value]:
        """Yield the values in the order of the file. Raises ImportSourceError."""
        told = self._by_name[topic]
        for time_ns, data in self._read(topic):
            yield decoded(told.encoding, told.schema, data, time_ns)

    def image_stamps(self, topic: str) -> Iterator[int]:
        """Yield the stamp of every image, ns, without decoding pixels."""
        if self._by_name[topic].encoding == CDR:
            for time_ns, data in self._read(topic, limit_bytes=STAMP_BYTES):
                yield ros_image_stamp_ns(data, time_ns)
        else:
            yield from (image.stamp_ns for image in self.values(topic) if isinstance(image, ImageMessage))

    def images(self, topic: str, places: list[int]) -> Iterator[ImageMessage]:
        """Those at these places (ascending) of the topic."""
        told = self._by_name[topic]
        for time_ns, data in self._read(topic, places):
            image = decoded(told.encoding, told.schema, data, time_ns)
            assert isinstance(image, ImageMessage)
            yield image


def open_bag(path: Path, progress: Progress = lambda done, total, text: None) -> Bag:
    """A bag's folder, or one file; MCAP is proven first. Raises ImportSourceError or RecordingError."""
    if path.suffix == ".bag":
        remedy = f"Convert it first: rosbags-convert --src {path} --dst BAG"
        raise ImportSourceError(f"{path} is a ROS 1 bag", code="ros1-bag", remedy=remedy)
    if not path.exists():
        raise ImportSourceError(f"{path} does not exist", code="no-file")
    mcap, sqlite = [path], path.suffix == ".db3"
    if path.is_dir():
        mcap = sorted(path.glob("*.mcap"))
        sqlite = not mcap and bool([*path.glob("*.db3"), *path.glob("*.zstd")])
    if sqlite:
        return Bag(_SqliteBag(path), progress)
    if not mcap:
        text = f"{path} holds neither dataset.yaml with poses.csv, nor a bag (*.mcap, *.db3)"
        raise ImportSourceError(text, code="no-bag", remedy="Name another folder.")
    return Bag(_McapBag(mcap, progress), progress)


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
                    remedy = f"Solve it: calibrate solve {path}"
                    raise ImportSourceError(
                        f"{path} is a recording already", code="a-recording", remedy=remedy
                    )
                for number, channel in contents.channels.items():
                    schema, encoding = contents.schema_of(channel).name, channel.message_encoding
                    if encoding == CDR and "/msg/" not in schema:  # as some bridges write it
                        schema = "/msg/".join(schema.split("/", 1))
                    count = len(contents.messages[number])
                    self.declared.append((channel.topic, encoding, schema, count))
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        while self._descriptors:
            os.close(self._descriptors.pop())

    def read(self, topic: str, places: list[int] | None, limit_bytes: int | None) -> _Messages:
        first, wanted = 0, None if places is None else list(places)
        for source, addresses in self._addresses(topic):
            chosen: list[int] | array[int] = addresses
            if wanted is not None:
                chosen = [addresses[place - first] for place in wanted if place < first + len(addresses)]
                wanted, first = wanted[len(chosen) :], first + len(addresses)
            for address in chosen:
                found = source.message(address, limit_bytes)
                yield found.log_time, found.data

    def _addresses(self, topic: str) -> Iterator[tuple[Source, array[int]]]:
        for contents, source in self._files:
            for number, channel in contents.channels.items():
                if channel.topic == topic:
                    yield source, contents.messages[number].addresses


class _SqliteBag:
    """A ROS 2 bag in sqlite3, whole or a single file."""

    def __init__(self, path: Path) -> None:
        ros_types()
        from rosbags.rosbag2 import Reader

        self._path = path
        try:
            self._reader: Any = Reader(path)
            self._reader.open()
        except Exception as error:  # sqlite's, yaml's and the library's own
            raise ImportSourceError(
                f"{path} is no ROS 2 bag that can be read: {error}", code="no-bag"
            ) from error
        self.declared = [(c.topic, CDR, c.msgtype, c.msgcount) for c in self._reader.connections]

    def close(self) -> None:
        self._reader.close()

    def read(self, topic: str, places: list[int] | None, limit_bytes: int | None) -> _Messages:
        chosen = [c for c in self._reader.connections if c.topic == topic]
        wanted = None if places is None else set(places)
        messages = enumerate(self._reader.messages(connections=chosen))
        while True:
            try:
                place, (_, time_ns, data) = next(messages)
            except StopIteration:
                return
            except Exception as error:
                raise ImportSourceError(f"{self._path} cannot be read: {error}", code="no-bag") from error
            if wanted is None or place in wanted:
                yield time_ns, bytes(data if limit_bytes is None else data[:limit_bytes])
