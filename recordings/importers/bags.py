"""Bags on the disk: MCAP files of anyone by this room's own reader, ROS 2 sqlite3 bags by `rosbags`."""

from __future__ import annotations

import os
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from recordings.errors import RecordingError
from recordings.importers import foxglove_messages, ros_messages
from recordings.importers.ros_messages import RosDecoder
from recordings.importers.values import Bag, Image, ImportSourceError, Kind, Topic, Value
from recordings.mcap import Contents, Message, Source, open_file, scan_file
from recordings.schema import SESSION_RECORDS

_RESCUE = "mcap recover FILE, with the mcap command line tool"
_CDR, _PROTOBUF = "cdr", "protobuf"


def open_bag(path: Path) -> Bag:
    """A bag's folder, or one file. Raises ImportSourceError or RecordingError."""
    if path.suffix == ".bag":
        raise ImportSourceError(
            f"{path} is a ROS 1 bag. Convert it first: rosbags-convert --src {path} --dst BAG"
        )
    if path.is_dir():
        mcap, sqlite = sorted(path.glob("*.mcap")), sorted(path.glob("*.db3"))
        packed = [file.name for file in path.glob("*.zstd")]
        if mcap:
            return McapBag(mcap)
        if sqlite or packed:
            return SqliteBag(path)
        raise ImportSourceError(
            f"{path} holds neither dataset.yaml with poses.csv, nor a bag (*.mcap, *.db3). Name another"
        )
    if not path.exists():
        raise ImportSourceError(f"{path} does not exist")
    return SqliteBag(path) if path.suffix == ".db3" else McapBag([path])


class McapBag:
    """One or several MCAP files, with ROS 2 messages, foxglove's, or both."""

    def __init__(self, paths: list[Path]) -> None:
        self._files: list[tuple[Contents, Source, Path]] = []
        self._ros: RosDecoder | None = None
        self._encodings: dict[str, tuple[str, str]] = {}
        """Topic → (encoding, schema)."""
        counts: dict[str, int] = {}
        self.others: list[str] = []
        try:
            for path in paths:
                descriptor = open_file(path)
                self._files.append((Contents(), Source(descriptor), path))
                contents, source, _ = scan_file(descriptor, path, _RESCUE)
                self._files[-1] = (contents, source, path)
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
                    assert isinstance(image, Image)
                    yield image.stamp_ns

    def images(self, topic: str, places: list[int]) -> Iterator[Image]:
        encoding, schema = self._encodings[topic]
        first, wanted = 0, list(places)
        for source, addresses in self._addresses(topic):
            while wanted and wanted[0] < first + len(addresses):
                message = source.message(addresses[wanted.pop(0) - first])
                image = self._decoded(encoding, schema, message)
                assert isinstance(image, Image)
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

    def images(self, topic: str, places: list[int]) -> Iterator[Image]:
        wanted = set(places)
        for place, (schema, time_ns, data) in enumerate(self._messages(topic)):
            if place in wanted:
                image = self._decoder.value(schema, data, time_ns)
                assert isinstance(image, Image)
                yield image
