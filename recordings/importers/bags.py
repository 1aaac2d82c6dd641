"""Bags on the disk: MCAP files of anyone by this room's own reader, ROS 2 sqlite3 bags by `rosbags`."""

from __future__ import annotations

import os
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

from recordings.errors import ImportSourceError, RecordingError
from recordings.importers import foxglove_messages, ros_messages
from recordings.importers.ros_messages import RosDecoder
from recordings.importers.values import Bag, ImageMessage, Kind, Progress, Topic, Value
from recordings.mcap import Contents, Message, Source, open_file, scan_file
from recordings.schema.definitions import SESSION_RECORDS

_RESCUE = "mcap recover FILE, with the mcap command line tool"
_CDR, _PROTOBUF = "cdr", "protobuf"
_SHOWN_EVERY = 64
"""Messages between two reports of progress."""
T = TypeVar("T")


def open_bag(path: Path, progress: Progress = lambda text, done, total: None) -> Bag:
    """A bag's folder, or one file; MCAP is proven first. Raises ImportSourceError or RecordingError."""
    if path.suffix == ".bag":
        raise ImportSourceError(
            f"{path} is a ROS 1 bag. Convert it first: rosbags-convert --src {path} --dst BAG"
        )
    if path.is_dir():
        mcap, sqlite = sorted(path.glob("*.mcap")), sorted(path.glob("*.db3"))
        packed = [file.name for file in path.glob("*.zstd")]
        if mcap:
            return McapBag(mcap, progress)
        if sqlite or packed:
            return SqliteBag(path)
        raise ImportSourceError(
            f"{path} holds neither dataset.yaml with poses.csv, nor a bag (*.mcap, *.db3). Name another"
        )
    if not path.exists():
        raise ImportSourceError(f"{path} does not exist")
    return SqliteBag(path) if path.suffix == ".db3" else McapBag([path], progress)


class McapBag:
    """One or several MCAP files, with ROS 2 messages, foxglove's, or both."""

    def __init__(self, paths: list[Path], progress: Progress) -> None:
        self._files: list[tuple[Contents, Source, Path]] = []
        self._ros: RosDecoder | None = None
        self._encodings: dict[str, tuple[str, str]] = {}
        """Topic → (encoding, schema)."""
        counts: dict[str, int] = {}
        self.others: list[str] = []
        try:
            for path in paths:
                self._files.append((Contents(), Source(open_file(path)), path))
            before, total = 0, sum(source.size_bytes for _, source, _ in self._files)
            for place, (_, source, path) in enumerate(self._files):

                def scanned(bytes_done: int, before: int = before) -> None:
                    progress("checking the bag", before + bytes_done, total)

                contents, source, _ = scan_file(source.descriptor, path, _RESCUE, scanned)
                self._files[place] = (contents, source, path)
                before += source.size_bytes
                if SESSION_RECORDS[0] in contents.metadata:
                    raise ImportSourceError(f"{path} is a recording already: calibrate solve {path}")
                self._note_topics(contents, counts)
        except BaseException:
            self.close()
            raise
        self.topics = [
            Topic(name, kind, schema, counts[name])
            for name, (encoding, schema) in self._encodings.items()
            if (kind := _kind(encoding, schema)) is not None
        ]

    def _note_topics(self, contents: Contents, counts: dict[str, int]) -> None:
        for number, channel in contents.channels.items():
            schema = contents.schema_of(channel).name
            if channel.encoding == "cdr" and "/msg/" not in schema:  # as some bridges write it
                schema = "/msg/".join(schema.split("/", 1))
            counts[channel.topic] = counts.get(channel.topic, 0) + len(contents.messages[number])
            if _kind(channel.encoding, schema) is None:
                self.others.append(f"{channel.topic} ({schema or 'no schema'}, {channel.encoding})")
            else:
                self._encodings[channel.topic] = (channel.encoding, schema)

    def close(self) -> None:
        for _, source, _ in self._files:
            os.close(source.descriptor)
        self._files = []

    def _addresses(self, topic: str) -> Iterator[tuple[Source, array[int]]]:
        for contents, source, _ in self._files:
            for number, channel in contents.channels.items():
                if channel.topic == topic:
                    yield source, contents.messages[number].addresses

    def _messages(self, topic: str) -> Iterator[Message]:
        for source, addresses in self._addresses(topic):
            yield from source.messages(addresses)

    def values(self, topic: str) -> Iterator[Value]:
        encoding, schema = self._encodings[topic]
        for message in self._messages(topic):
            yield self._decoded(encoding, schema, message)

    def _decoded(self, encoding: str, schema: str, message: Message) -> Value:
        if encoding == _PROTOBUF:
            return foxglove_messages.value(schema, message.data, message.time_ns)
        self._ros = self._ros or RosDecoder()
        return self._ros.value(schema, message.data, message.time_ns)

    def image_stamps(self, topic: str) -> Iterator[int]:
        encoding, schema = self._encodings[topic]
        for source, addresses in self._addresses(topic):
            for address in addresses:
                if encoding == _CDR:
                    beginning = source.beginning(address, ros_messages.STAMP_BYTES)
                    yield ros_messages.image_stamp_ns(beginning.data, beginning.time_ns)
                else:
                    message = source.message(address)
                    image = foxglove_messages.value(schema, message.data, message.time_ns)
                    assert isinstance(image, ImageMessage)
                    yield image.stamp_ns

    def images(self, topic: str, places: list[int]) -> Iterator[ImageMessage]:
        encoding, schema = self._encodings[topic]
        first, wanted = 0, list(places)
        for source, addresses in self._addresses(topic):
            while wanted and wanted[0] < first + len(addresses):
                message = source.message(addresses[wanted.pop(0) - first])
                image = self._decoded(encoding, schema, message)
                assert isinstance(image, ImageMessage)
                yield image
            first += len(addresses)


def _kind(encoding: str, schema: str) -> Kind | None:
    if encoding == _PROTOBUF:
        return foxglove_messages.KINDS.get(schema)
    return ros_messages.KINDS.get(schema) if encoding == _CDR else None


class SqliteBag:
    """A ROS 2 bag in sqlite3, whole or a single file."""

    def __init__(self, path: Path) -> None:
        self._decoder = RosDecoder()
        from rosbags.rosbag2 import Reader

        self._path = path
        try:
            self._reader: Any = Reader(path)
            self._reader.open()
        except Exception as error:  # sqlite's, yaml's and the library's own
            raise ImportSourceError(f"{path} is no ROS 2 bag that can be read: {error}") from error
        self.topics: list[Topic] = []
        self.others: list[str] = []
        for connection in self._reader.connections:
            kind = ros_messages.KINDS.get(connection.msgtype)
            if kind is None:
                self.others.append(f"{connection.topic} ({connection.msgtype})")
            elif connection.topic not in [topic.name for topic in self.topics]:
                count = self._reader.topics[connection.topic].msgcount
                self.topics.append(Topic(connection.topic, kind, connection.msgtype, count))

    def close(self) -> None:
        self._reader.close()

    def _messages(self, topic: str) -> Iterator[tuple[str, int, bytes]]:
        chosen = [c for c in self._reader.connections if c.topic == topic]
        try:
            for connection, time_ns, data in self._reader.messages(connections=chosen):
                yield connection.msgtype, time_ns, bytes(data)
        except RecordingError:
            raise
        except Exception as error:
            raise ImportSourceError(f"{self._path} cannot be read: {error}") from error

    def values(self, topic: str) -> Iterator[Value]:
        for schema, time_ns, data in self._messages(topic):
            yield self._decoder.value(schema, data, time_ns)

    def image_stamps(self, topic: str) -> Iterator[int]:
        for _, time_ns, data in self._messages(topic):
            yield ros_messages.image_stamp_ns(data, time_ns)

    def images(self, topic: str, places: list[int]) -> Iterator[ImageMessage]:
        wanted = set(places)
        for place, (schema, time_ns, data) in enumerate(self._messages(topic)):
            if place in wanted:
                image = self._decoder.value(schema, data, time_ns)
                assert isinstance(image, ImageMessage)
                yield image


class CountedBag:
    """A bag whose first pass tells how far it is: in messages, topic by topic."""

    def __init__(self, bag: Bag, progress: Progress) -> None:
        self._bag, self._progress = bag, progress
        self.topics, self.others = bag.topics, bag.others
        self._total = sum(topic.messages for topic in bag.topics)
        self._done = 0

    def close(self) -> None:
        self._bag.close()

    def values(self, topic: str) -> Iterator[Value]:
        return self._counted(self._bag.values(topic))

    def image_stamps(self, topic: str) -> Iterator[int]:
        return self._counted(self._bag.image_stamps(topic))

    def images(self, topic: str, places: list[int]) -> Iterator[ImageMessage]:
        return self._counted(self._bag.images(topic, places))

    def _counted(self, messages: Iterator[T]) -> Iterator[T]:
        for message in messages:
            yield message
            self._done += 1
            if self._done % _SHOWN_EVERY == 0:
                self._progress("reading the bag", self._done, self._total)
