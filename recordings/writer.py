"""Writes one recording file, synchronously: `.mcap.part` until it is finished, synced and renamed.

Values go in as the devices gave them, with all clocks; whoever reads them applies the geometry.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec

from recordings.errors import RecordingError, disk_error, exists_error, recover_line, wrong_size_error
from recordings.files import PART_SUFFIX, is_attachment_name, is_session_name, rename_new, sync_folder
from recordings.geometry import base_from_flange
from recordings.image_headers import ImageError, read_header
from recordings.manifest import PARTS_LIMIT
from recordings.mcap.ending import check_ending
from recordings.mcap.output import OutputFile
from recordings.mcap.records import BadRecordError, with_crc
from recordings.schema import viewing
from recordings.schema.definitions import CHANNEL_RECORDS, FORMATS, SESSION_RECORDS, PictureFacts, encode
from recordings.schema.messages import (
    CameraModel,
    CaptureEvent,
    Image,
    Matrix4,
    RobotState,
    SessionInfo,
    Stamps,
    View,
    without_picture,
)
from recordings.schema.rules import VIEWS_LIMIT, has_rigid_poses
from recordings.schema.topics import Topic, schema_bytes, schema_name

ATTACHMENT_LIMIT_BYTES = 16 * 1024 * 1024
SHOWN_PERIOD_NS = 40_000_000
"""Viewers get the arm at 25 Hz; the states themselves are kept at their full rate."""
KEPT_IN_MEMORY_BYTES = 256 * 2**20
"""Newest part of a file that stays in memory, so that the solve after a session need not read the disk."""
_FREE_SPACE = "Nothing was kept: free space or name another disk, and begin again."
_SECOND_NS = 1_000_000_000


class RecordingWriter:
    """One file, one thread. The first error of the disk is final: the file is closed as it is.

    Raises RecordingError from every method; after a write error `recordings recover` takes the `.part` file.
    """

    def __init__(self, path: Path, info: SessionInfo) -> None:
        """Creates `path` + '.part'."""
        if path.suffix != ".mcap":
            raise RecordingError("recording-name", path=path)
        if not is_session_name(info.name):
            raise RecordingError("session-name", name=info.name)
        if not 1 <= info.part <= PARTS_LIMIT:
            raise RecordingError("too-many-segments", path=path, part=info.part, limit=PARTS_LIMIT)
        if os.path.lexists(path):
            raise exists_error(path)
        self.path = path
        self.part_path = path.with_name(path.name + PART_SUFFIX)
        self.info = info
        self.error: RecordingError | None = None
        self._start_ns = info.created_wall_ns or time.time_ns()
        self._channels: dict[Topic, int] = {}
        self._images: dict[int, int] = {}
        """Sequence → time in the file."""
        self._views = 0
        self._shown_ns = 0
        """Time of the newest state that viewers get."""
        self._attachments: set[str] = set()
        self._session = with_crc({"format": FORMATS[-1], "session": msgspec.json.encode(info).decode()})
        """The session's facts, written at the file's beginning; empty once `_copy_session` did it again."""
        self._file = OutputFile(self.part_path)
        self._mcap = self._file.writer()
        try:
            self._mcap.start(library="calibration-station")
            self._mcap.add_metadata(SESSION_RECORDS[0], self._session)
            sync_folder(path.parent)
        except OSError as error:
            self._file.close()
            # Nothing is in it, and its name is wanted for the next try.
            self.part_path.unlink(missing_ok=True)
            raise disk_error("begin", path, error, _FREE_SPACE) from error
        self.camera_model(info.camera)

    def robot_state(self, state: RobotState) -> None:
        time_ns = self._time_ns(state.stamps)
        self._add(Topic.ROBOT_STATE, encode(state), time_ns)
        due = not 0 <= time_ns - self._shown_ns < SHOWN_PERIOD_NS  # a clock that was set back counts, too
        if due and all(map(math.isfinite, state.tcp_pose)):
            self._shown_ns = time_ns
            T = base_from_flange(state.tcp_pose, self.info.robot.tcp_offset)
            self._show(Topic.TRANSFORM, viewing.frame_transform("base", "flange", T, time_ns), time_ns)
            self._show(Topic.JOINTS, viewing.joint_states(state, time_ns), time_ns)

    def image(self, image: Image, encoded: bytes | None = None) -> None:
        """`encoded`: the same image's PNG or JPEG bytes, stored instead of the array (imported files)."""
        if image.sequence in self._images or image.sequence < 0:
            raise RecordingError("sequence-twice", image=image.sequence)
        height, width = image.pixels.shape[:2]
        camera = self.info.camera
        if (width, height) != (camera.width, camera.height):
            raise wrong_size_error(f"Image {image.sequence}", (width, height), (camera.width, camera.height))
        told = msgspec.structs.asdict(image)
        del told["pixels"]
        facts = PictureFacts(width=width, height=height, **told)
        time_ns = self._time_ns(image.stamps, image.sequence)
        try:
            topic, message = self._image(image, encoded, time_ns)
        except ImageError as error:
            raise RecordingError(
                "bad-image", place=str(self.path), image=image.sequence, reason=str(error)
            ) from error
        self._add(Topic.PICTURE_FACTS, encode(facts), time_ns, image.sequence)
        self._show(topic, message, time_ns, image.sequence)
        self._images[image.sequence] = time_ns
        self.flush()

    def _image(self, image: Image, encoded: bytes | None, time_ns: int) -> tuple[Topic, Any]:
        if encoded is None:
            return Topic.RAW_IMAGE, viewing.raw_image(image.pixels, image.pixel_format, time_ns)
        return Topic.COMPRESSED_IMAGE, viewing.compressed_image(encoded, read_header(encoded).format, time_ns)

    def view(self, view: View) -> None:
        """The image must have been recorded before: a view never points at nothing."""
        if view.picture_sequence not in self._images and not without_picture(view):
            raise RecordingError("no-image", path=self.path, view=view.index, image=view.picture_sequence)
        if self._views == VIEWS_LIMIT:
            raise RecordingError("too-many-views", path=self.path, limit=VIEWS_LIMIT)
        if not has_rigid_poses(view):
            raise RecordingError("view-not-rigid", path=self.path, view=view.index)
        self._views += 1
        time_ns = self._time_ns(view.stamps, view.index)
        self._add(Topic.VIEW, encode(view), time_ns)
        if not self._shown_ns:  # imported, say: nothing else tells viewers where the flange is
            T = view.base_from_flange
            self._show(Topic.TRANSFORM, viewing.frame_transform("base", "flange", T, time_ns), time_ns)
        self.flush()
        with self._disk():
            self._copy_session()

    def _copy_session(self) -> None:
        """Write facts and channels again, behind the first view: damage at the beginning loses neither."""
        if self._session:
            self._mcap.add_metadata(SESSION_RECORDS[1], self._session)
            self._session = {}
            for topic in self._channels:
                self._name_channel(topic)

    def marks(self, sequence: int, marks: Sequence[viewing.Marks], text: str = "") -> None:
        """Write marks that viewers draw over an image: corners, residuals. Nothing for an unknown image."""
        if (time_ns := self._images.get(sequence)) is not None:
            self._show(Topic.ANNOTATIONS, viewing.image_annotations(marks, text, time_ns), time_ns)

    def frame(
        self, parent: str, child: str, parent_from_child: Matrix4, stamps: Stamps | None = None
    ) -> None:
        """A transform of what does not move, as known from then on (None: from the start), for viewers."""
        time_ns = self._start_ns if stamps is None else self._time_ns(stamps)
        message = viewing.frame_transform(parent, child, parent_from_child, time_ns)
        self._show(Topic.BOARD_TRANSFORM if child == "board" else Topic.FIXED_TRANSFORM, message, time_ns)

    def _show(self, topic: Topic, message: Any, time_ns: int, sequence: int = 0) -> None:
        self._add(topic, message.SerializeToString(), time_ns, sequence)

    def event(self, event: CaptureEvent) -> None:
        time_ns = self._time_ns(event.stamps)
        self._add(Topic.EVENT, encode(event), time_ns)
        self._show(Topic.LOG, viewing.log_line(event, time_ns), time_ns)

    def camera_model(self, model: CameraModel) -> None:
        """Intrinsics for viewers, where they are known; what calibrate uses is `SessionInfo.camera`."""
        if model.matrix is not None:
            message = viewing.camera_calibration(model, self._start_ns)
            self._show(Topic.CAMERA_CALIBRATION, message, self._start_ns)

    def attach(self, name: str, media_type: str, content: bytes) -> None:
        """Add a small file to the recording, such as `plan.yaml`."""
        if not is_attachment_name(name) or name in self._attachments:
            raise RecordingError("attachment-name", name=name)
        if len(content) > ATTACHMENT_LIMIT_BYTES:
            size, limit = len(content), ATTACHMENT_LIMIT_BYTES
            raise RecordingError("attachment-size", name=name, size_bytes=size, limit_bytes=limit)
        with self._disk():
            self._mcap.add_attachment(self._start_ns, self._start_ns, name, media_type, content)
        self._attachments.add(name)

    def flush(self) -> None:
        """Ends the open chunk and hands everything to the operating system: survives a killed process."""
        with self._disk():
            self._mcap.flush()

    def sync(self) -> None:
        """Everything so far is on the disk when this returns: survives a power loss.

        Then all but the newest part leaves the page cache: gigabytes there, which nobody read, once made the
        daemon fall silent for tenths of a second.
        """
        self.flush()
        with self._disk():
            getattr(os, "fdatasync", os.fsync)(self._file.descriptor)  # macOS has no fdatasync
            surplus = self._file.size_bytes - KEPT_IN_MEMORY_BYTES
            if surplus > 0 and hasattr(os, "posix_fadvise"):  # a length of 0 would mean all of it
                os.posix_fadvise(self._file.descriptor, 0, surplus, os.POSIX_FADV_DONTNEED)

    def finish(self) -> Path:
        """Finishes the file, reads its end back, renames it, and returns its final path."""
        with self._disk():
            self._mcap.finish()
            os.fsync(self._file.descriptor)
            try:
                check_ending(self._file.descriptor)
            except BadRecordError as problem:
                self.close()
                rescue = recover_line(self.part_path)
                self.error = RecordingError(
                    "unreadable-end", path=self.part_path, reason=str(problem), rescue=rescue
                )
                raise self.error from problem
            rename_new(self.part_path, self.path)
        self.close()
        return self.path

    def close(self) -> None:
        """Closes the file unfinished; the `.part` file stays for `recordings recover`. Idempotent."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _time_ns(self, stamps: Stamps, place: int = 0) -> int:
        """Wall time where there is one; imported images have none and follow each other by a second."""
        return stamps.host_wall_ns or self._start_ns + place * _SECOND_NS

    def _add(self, topic: Topic, data: bytes, time_ns: int, sequence: int = 0) -> None:
        """`sequence`: an image's; of other messages MCAP's number says nothing."""
        with self._disk():
            channel = self._channels.get(topic) or self._channel(topic)
            self._mcap.add_message(channel, time_ns, data, time_ns, sequence)

    def _channel(self, topic: Topic) -> int:
        schema = self._mcap.register_schema(schema_name(topic), "protobuf", schema_bytes(topic))
        self._channels[topic] = self._mcap.register_channel(topic.value, "protobuf", schema)
        if not self._session:
            self._name_channel(topic)
        return self._channels[topic]

    def _name_channel(self, topic: Topic) -> None:
        name = f"{CHANNEL_RECORDS}{self._channels[topic]}"
        self._mcap.add_metadata(name, with_crc({"topic": topic.value}))

    @contextmanager
    def _disk(self) -> Iterator[None]:
        """Guard a write: the first OSError closes the file, and every later write raises that error again.

        What is still in memory is dropped, as a writer that failed cannot be trusted.
        """
        if self.error is not None:
            raise self.error
        if self._file.closed:
            raise RecordingError("closed", path=self.path)
        try:
            yield
        except OSError as error:
            remedy = "What was synced before is safe: free space or replace the disk, then "
            self.error = disk_error("write", self.part_path, error, remedy + recover_line(self.part_path))
            self._file.close()
            raise self.error from error


@contextmanager
def derived_recording(path: Path, info: SessionInfo) -> Iterator[RecordingWriter]:
    """Write what is made from something that stays: nothing is left behind when the block fails."""
    writer = RecordingWriter(path, info)
    try:
        yield writer
    except BaseException as problem:
        writer.part_path.unlink(missing_ok=True)
        if problem is writer.error and isinstance(problem.__cause__, OSError):
            raise disk_error("write", path, problem.__cause__, _FREE_SPACE) from problem
        raise
    finally:
        writer.close()
