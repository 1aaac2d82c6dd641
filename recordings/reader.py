"""Opens a recording: one file, or a session folder whose segments belong together."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recordings.errors import (
    CorruptRecordingError,
    MissingSegmentError,
    RecordingError,
    UnfinishedRecordingError,
    disk_error,
    recover_line,
)
from recordings.files import PART_SUFFIX
from recordings.images import Pixels, viewable
from recordings.manifest import PARTS_LIMIT, Manifest, missing_parts, read_manifest
from recordings.same_session import difference
from recordings.schema.messages import (
    BoardSpec,
    CameraModel,
    CaptureEvent,
    Image,
    Mount,
    RobotState,
    SessionInfo,
    View,
    without_picture,
)
from recordings.segment import RecordingSegment


class Pictures(NamedTuple):
    """Images and poses of n views, in the order in which `calibrate.solve` takes them."""

    images: list[Pixels]
    """n of (h, w) or (h, w, 3) BGR"""
    base_from_flange: NDArray[np.float64]
    """(n, 4, 4), metres"""
    board: BoardSpec
    mount: Mount
    camera: CameraModel | None
    """None: the lens is not known."""
    joints_rad: NDArray[np.float64] | None
    """(n, k); None where a view has none."""
    robot_model: str


class RobotSamples(NamedTuple):
    """What the controller told in a session: m samples."""

    stamps_ns: NDArray[np.int64]
    """(m,) on the clock of `View.stamps.host_monotonic_ns`"""
    joints_rad: NDArray[np.float64]
    """(m, k); k = 0 where not every state tells as many"""
    tcp_pose: NDArray[np.float64]
    """(m, 6) base_from_tcp: x y z [m], rotation vector [rad]"""


class Recording:
    """A proven recording. Iterators raise CorruptRecordingError at a message wrong in itself."""

    def __init__(
        self,
        path: Path,
        segments: list[RecordingSegment],
        missing: tuple[str, ...] = (),
        losses: tuple[str, ...] = (),
    ) -> None:
        self.path = path
        self.segments = segments
        """In the order they were recorded."""
        self.missing = missing
        """A sentence for each segment of the session that should be there and is not."""
        self.losses = losses
        """A sentence for everything that recovery could not save, or that nobody can rule out."""
        self._by_number = {segment.info.part: segment for segment in segments}

    @property
    def info(self) -> SessionInfo:
        """Description of the session, from the first segment."""
        return self.segments[0].info

    @property
    def sha256(self) -> str:
        """Hash of the file; of the segments' hashes, one after the other, when there are several."""
        if len(self.segments) == 1:
            return self.segments[0].sha256
        return hashlib.sha256("".join(segment.sha256 for segment in self.segments).encode()).hexdigest()

    def views(self) -> list[View]:
        """The latest attempt of every pose that was not taken back, in the order of their index."""
        latest: dict[int, View] = {}
        for view in chain.from_iterable(segment.views for segment in self.segments):
            before = latest.get(view.index)
            if before is None or (view.part, view.attempt) >= (before.part, before.attempt):
                latest[view.index] = view
        return [latest[index] for index in sorted(latest) if not latest[index].taken_back]

    def image(self, view: View) -> Image:
        """The view's image; its array is read-only."""
        if without_picture(view):
            raise RecordingError("pairs-only", path=self.path)
        try:
            return self._by_number[view.part].image(view.picture_sequence)
        except KeyError as error:
            raise RecordingError(
                "no-image", path=self.path, view=view.index, image=view.picture_sequence
            ) from error

    def stored_image(self, view: View) -> tuple[str, bytes] | None:
        """(format, file bytes) of an image that is kept compressed; None when it is kept raw."""
        return self._by_number[view.part].stored_image(view.picture_sequence)

    def images(self) -> Iterator[tuple[View, Image]]:
        """One at a time, in the order of `views`."""
        for view in self.views():
            yield view, self.image(view)

    def pictures(self) -> Pictures:
        """All views as arrays: `calibrate.solve(*recording.pictures())`."""
        views, info = self.views(), self.info
        images = [(image.pixels, image.pixel_format) for image in map(self.image, views)]
        joints = [view.joints_rad for view in views]
        return Pictures(
            [viewable(*image) for image in images],
            np.array([view.base_from_flange for view in views]),
            info.board,
            info.mount,
            info.camera if info.camera.matrix is not None else None,
            None if None in joints else np.array(joints),
            info.robot.model,
        )

    def robot_samples(self) -> RobotSamples:
        """All robot states as arrays, to be interpolated at any time.

        RecordingError where the computer restarted between two segments: their stamps are of two clocks.
        """
        states = list(self.robot_states())
        counts = {len(state.joints_rad) for state in states}
        count = counts.pop() if len(counts) == 1 else 0
        joints = np.array([state.joints_rad[:count] for state in states], dtype=float)
        stamps = np.array([state.stamps.host_monotonic_ns for state in states], np.int64)
        if len(self.segments) > 1 and (np.diff(stamps) < 0).any():
            raise RecordingError("clock-restarted", path=self.path)
        poses = np.array([state.tcp_pose for state in states]).reshape(-1, 6)
        return RobotSamples(stamps, joints.reshape(len(states), count), poses)

    def robot_states(self) -> Iterator[RobotState]:
        return chain.from_iterable(segment.robot_states() for segment in self.segments)

    def events(self) -> Iterator[CaptureEvent]:
        return chain.from_iterable(segment.events() for segment in self.segments)

    def attachments(self) -> dict[str, bytes]:
        """Return the attachments of all segments; the latest where a name is in several."""
        return {name: a.data for segment in self.segments for name, a in segment.attachments.items()}

    def media_types(self) -> dict[str, str]:
        """Media types of the attachments."""
        return {name: a.media_type for segment in self.segments for name, a in segment.attachments.items()}


def open_recording(path: Path, *, incomplete: bool = False) -> Recording:
    """Reads and proves the whole recording. At most 256 MiB of memory, whatever the file says.

    Raises UnfinishedRecordingError for one that was never finished or is cut, CorruptRecordingError for one
    that breaks a rule of the format, MissingSegmentError when segments of the session are not there (unless
    `incomplete`: then `missing` names them), RecordingError when there is none.
    """
    path = Path(path)
    if path.is_dir():
        recording = _open_folder(path)
        advice = f"Copy it back beside the others; if it is lost for good: {recover_line(path)}"
    else:
        recording = _open_file(path)
        advice = f"If the other segments are lost for good: {recover_line(path.parent)}"
    if recording.missing and not incomplete:
        said = "; ".join(recording.missing)
        raise MissingSegmentError(lacks=said, advice=advice, missing=len(recording.missing))
    return recording


def _open_file(path: Path) -> Recording:
    """One file that is the whole session, or says of which session it is a segment."""
    unfinished = path if path.name.endswith(PART_SUFFIX) else path.with_name(path.name + PART_SUFFIX)
    if unfinished.is_file() and (unfinished == path or not path.exists()):
        raise _unfinished(unfinished)
    segment = RecordingSegment(path)
    info = segment.info
    manifest = read_manifest(path.parent)
    if manifest is not None and (manifest.session, manifest.parts.get(info.part)) != (info.name, path.name):
        manifest = None  # it lists other files of this folder
    missing: tuple[str, ...] = ()
    if missing_parts(path.parent, manifest, {info.part}):
        count = str(len(manifest.parts)) if manifest else f"at least {info.part}"
        text = f"{path} is segment {info.part} of {count} of session '{info.name}'"
        missing = (f"{text}: give the session's folder ({path.parent}) instead of the file",)
    return Recording(path, [segment], missing, _losses([segment], manifest))


def _open_folder(folder: Path) -> Recording:
    """Every segment in the folder. RecordingError when they are of different sessions, or one twice."""
    try:
        names = sorted(entry.name for entry in folder.iterdir())
    except OSError as error:
        raise disk_error("open", folder, error) from error
    unfinished = [name for name in names if name.endswith(".mcap" + PART_SUFFIX)]
    if unfinished:
        raise _unfinished(folder / unfinished[0], folder)
    files = [name for name in names if name.endswith(".mcap")]
    manifest = read_manifest(folder)
    if not files and manifest is None:
        raise RecordingError("no-recording", folder=folder)
    if not files and manifest is not None:
        raise MissingSegmentError(
            lacks=f"{folder} holds none of the segments of session '{manifest.session}'",
            advice=f"Copy back {', '.join(filter(None, manifest.parts.values()))}.",
            missing=len(manifest.parts),
        )
    if len(files) > PARTS_LIMIT:
        raise RecordingError("several-sessions", difference=f"{folder} holds {len(files)} recordings")
    segments = sorted((RecordingSegment(folder / name) for name in files), key=lambda found: found.info.part)
    _check_one_session(segments, manifest)
    missing = missing_parts(folder, manifest, {segment.info.part for segment in segments})
    sentences = tuple(
        f"{folder} lacks segment {n}{f' ({name})' if name else ''} of session '{segments[0].info.name}'"
        for n, name in missing.items()
    )
    return Recording(folder, segments, sentences, _losses(segments, manifest))


def _unfinished(path: Path, recover: Path | None = None) -> UnfinishedRecordingError:
    return UnfinishedRecordingError(
        path=path, reason="it was never finished", rescue=recover_line(recover or path)
    )


def _check_one_session(segments: list[RecordingSegment], manifest: Manifest | None) -> None:
    first, path = segments[0].info, segments[0].path
    if manifest is not None and manifest.session != first.name:
        text = f"{path} is of session '{first.name}', its folder of '{manifest.session}'"
        raise RecordingError("several-sessions", difference=text)
    for segment in segments:
        if segment.info.name != first.name:
            text = f"{segment.path} is of session '{segment.info.name}', {path} of '{first.name}'"
            raise RecordingError("several-sessions", difference=text)
        if (found := difference(first, segment.info)) is not None:
            text = f"the {found.what} of {segment.path} is {found.other}, that of {path} {found.first}"
            raise RecordingError("several-sessions", difference=text, **found._asdict())
    for before, segment in pairwise(segments):
        if before.info.part == (part := segment.info.part):
            raise CorruptRecordingError("segment-twice", path=before.path, other=segment.path, segment=part)


def _losses(segments: list[RecordingSegment], manifest: Manifest | None) -> tuple[str, ...]:
    found = [
        f"{segment.path.name} was cut or damaged: {segment.lost_bytes} bytes were lost when it was recovered"
        for segment in segments
        if segment.lost_bytes
    ]
    present = {segment.info.part for segment in segments}
    if manifest is not None:
        found += [f"segment {n} of the session was lost" for n in manifest.given_up if n not in present]
    elif segments[-1].recovered:
        found.append(
            f"{segments[-1].path.name} was interrupted, and no parts.json beside it says whether the session "
            "went on: a later segment may be missing"
        )
    return tuple(found)
