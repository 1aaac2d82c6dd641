"""A ROS bag, or any MCAP with images and poses → a recording like the station's own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from recordings.images import Pixels
from recordings.importers.dataset import DATASET_FILE
from recordings.importers.folder import Imported
from recordings.importers.messages import Progress
from recordings.importers.reader import Frame, read_bag, unexpected
from recordings.importers.reader_messages import BagRead, SessionRead, StatesRead, ViewRead
from recordings.importers.selection import Wanted
from recordings.importers.stops import StandstillLimits
from recordings.schema.messages import Image
from recordings.writer import RecordingWriter, derived_recording

PAIR_WITHIN_S = 0.05


def import_bag(
    source: Path,
    output: Path | None,
    description: Path | None = None,
    wanted: Wanted = Wanted(),  # noqa: B008 - frozen
    limits: StandstillLimits = StandstillLimits(),  # noqa: B008 - frozen
    pair_within_s: float = PAIR_WITHIN_S,
    progress: Progress = lambda done, total, text: None,
    arm_class: str | None = None,
) -> Imported:
    """`output` None: says what would be taken and writes nothing. Raises ImportSourceError or RecordingError.

    `description`: a dataset.yaml with mount and board (default: the one in or beside the source).
    `arm_class`: the class of the arm, as a person tells it; None: as dataset.yaml tells it.
    The bag is read in a process of its own.
    """
    views = output is not None
    with read_bag(source, description, wanted, limits, pair_within_s, views, progress) as answers:
        bag, _ = next(answers, (None, []))
        if not isinstance(bag, BagRead):
            raise unexpected(source)
        robot = bag.robot
        if arm_class is not None:
            robot = msgspec.structs.replace(robot, arm_class=arm_class)
        done = Imported(source, bag.stops, bag.facts, robot=robot, with_joints=bag.with_joints)
        if output is None:
            return done
        session, attached = next(answers, (None, []))
        if not isinstance(session, SessionRead) or len(attached) != 1:
            raise unexpected(source)
        info = session.info
        if arm_class is not None:
            robot = msgspec.structs.replace(info.robot, arm_class=arm_class)
            info = msgspec.structs.replace(info, robot=robot)
        with derived_recording(output, info) as writer:
            writer.attach(DATASET_FILE, "application/yaml", attached[0])
            writer.attach("import.json", "application/json", msgspec.json.encode(bag.facts))
            _write(writer, source, answers, bag.stops, progress)
            return replace(done, path=writer.finish())


def _write(
    writer: RecordingWriter, source: Path, answers: Iterator[Frame], stops: int, progress: Progress
) -> None:
    """Write states and views as they come. RecordingError where they are not those of so many stops."""
    done = 0
    for answer, blobs in answers:
        match answer:
            case StatesRead():
                for state in answer.states:
                    writer.robot_state(state)
            case ViewRead():
                pixels = _pixels(answer, blobs, source)
                view = answer.view
                place = view.picture_sequence
                image = Image(pixels, answer.stamps, place, place, pixel_format=answer.pixel_format)
                writer.image(image, None if answer.raw else blobs[1])
                writer.view(view)
                done += 1
                progress(done, stops, "importing")
            case _:
                raise unexpected(source)
    if done != stops:
        raise unexpected(source)


def _pixels(answer: ViewRead, blobs: list[bytes], source: Path) -> Pixels:
    """The array of an image. RecordingError where its bytes are not of its shape."""
    if len(blobs) != (1 if answer.raw else 2):
        raise unexpected(source)
    try:
        if answer.deep:
            return np.frombuffer(blobs[0], np.uint16).reshape(answer.shape)
        return np.frombuffer(blobs[0], np.uint8).reshape(answer.shape)
    except ValueError as error:
        raise unexpected(source) from error
