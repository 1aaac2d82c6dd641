"""Exports come back through other readers' own rules."""

from __future__ import annotations

import errno
import re
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from recordings.cli import main
from recordings.cli.commands import ExportJson
from recordings.exporters.export import export_recording
from recordings.geometry import base_from_flange
from recordings.images import encode_png
from recordings.importers.bags import open_bag
from recordings.importers.folder import import_folder
from recordings.importers.messages import Kind
from recordings.mcap.output import OutputFile
from recordings.reader import open_recording
from recordings.schema.messages import RobotIdentity, Stamps
from recordings.writer import RecordingWriter
from tests.command_line import call
from tests.recordings.small_recording import (
    START_NS,
    make_image,
    make_info,
    make_picture,
    make_state,
    make_view,
    refused,
)


def test_a_folder_export_imports_as_the_same_views(small: Path, tmp_path: Path) -> None:
    original = open_recording(small)
    folder = tmp_path / "out"
    assert call(main, "export", small, "--to", "folder", "-o", folder).returncode == 0
    again = open_recording(import_folder(folder, tmp_path / "again.mcap").path)
    assert (again.info.board, again.info.mount, again.info.camera) == (
        original.info.board,
        original.info.mount,
        original.info.camera,
    )
    for (a, picture_a), (b, picture_b) in zip(original.images(), again.images(), strict=True):
        np.testing.assert_allclose(a.base_from_flange, b.base_from_flange, atol=1e-12)
        np.testing.assert_array_equal(picture_a.pixels, picture_b.pixels)


def test_an_imported_file_is_exported_byte_for_byte(folder: Path, tmp_path: Path) -> None:
    (folder / "kinematics.yaml").write_bytes(b"kinematics: {}\n")
    recording = open_recording(import_folder(folder, tmp_path / "a.mcap").path)
    out = export_recording(recording, tmp_path / "out", "folder")
    for index in range(3):
        assert (out / f"images/{index:03d}.png").read_bytes() == (folder / f"images/{index}.png").read_bytes()
    assert (out / "kinematics.yaml").read_bytes() == b"kinematics: {}\n", "the arm's own table"


def test_nothing_is_overwritten_and_nothing_left_behind(small: Path, tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.mkdir()
    with refused("exists"):
        export_recording(open_recording(small), taken, "folder")
    with refused("disk", errno=errno.ENOENT):
        export_recording(open_recording(small), tmp_path / "no" / "out", "folder")
    assert list(taken.iterdir()) == []
    assert not (tmp_path / "no").exists()
    (tmp_path / "out.part").mkdir()
    with refused("export-begun"):
        export_recording(open_recording(small), tmp_path / "out", "folder")


def test_a_full_disk_leaves_no_half_of_a_recording_that_can_be_made_again(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real_write = OutputFile.write

    def write(file: OutputFile, data: bytes) -> int:
        if file.size_bytes > 2000:
            raise OSError(28, "No space left on device")
        return real_write(file, data)

    monkeypatch.setattr(OutputFile, "write", write)
    output = tmp_path / "out.mcap"
    with refused("disk", errno=errno.ENOSPC):
        import_folder(folder, output)
    assert not list(tmp_path.glob("out*"))


def test_an_image_of_a_format_that_names_no_file_is_written_as_png(small: Path, tmp_path: Path) -> None:
    recording = open_recording(small)
    png = encode_png(recording.image(recording.views()[0]).pixels)
    recording.stored_image = lambda view: ("../p\0", png)
    out = export_recording(recording, tmp_path / "out", "folder")
    assert {path.name for path in (out / "images").iterdir()} == {"000.png", "001.png", "002.png"}


def test_images_of_no_pose_that_counts_stay_out_of_a_bag_and_their_number_is_told(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.image(make_picture(2))  # as where no board was found
        for index in range(2):
            writer.image(make_picture(index))
            writer.view(make_view(index))
        writer.view(msgspec.structs.replace(make_view(1), taken_back=True, attempt=2))
        writer.finish()
    done = call(main, "export", tmp_path / "a.mcap", "--to", "ros2", "-o", tmp_path / "out")
    assert re.findall(r"\d+", done.stdout.removeprefix(str(tmp_path))) == ["1", "2"]
    bag = open_bag(tmp_path / "out")
    assert [topic.messages for topic in bag.topics.values() if topic.kind is Kind.IMAGE] == [1]
    done = call(main, "export", tmp_path / "a.mcap", "--to", "folder", "-o", tmp_path / "folder", "--json")
    told = msgspec.json.decode(done.stdout, type=ExportJson)
    assert told == ExportJson(str(tmp_path / "folder"), 1, 2)


def test_a_bag_tells_flange_and_images_as_they_were_recorded(tmp_path: Path) -> None:
    tool = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
    info = make_info(robot=RobotIdentity(tcp_offset=tool))
    with RecordingWriter(tmp_path / "a.mcap", info) as writer:
        for count in range(10):
            writer.robot_state(make_state(count))
        mosaic = msgspec.structs.replace(make_picture(1), pixel_format="BayerGR8")
        for index, each in enumerate([(make_picture(0),), (mosaic, encode_png(make_image(1)))]):
            writer.image(*each)
            stamps = Stamps() if index else Stamps(1, START_NS + 2 * 10**9)  # as imported, or taken again
            writer.view(msgspec.structs.replace(make_view(index), stamps=stamps))
        recording = open_recording(writer.finish())
    bag = open_bag(export_recording(recording, tmp_path / "out", "ros2"))
    (raw,), (file,) = map(bag.images, ("/camera/image_raw", "/camera/image_raw/compressed"))
    assert (raw.encoding, file.encoding) == ("mono8", "bayer_grbg8")
    assert [raw.stamp_ns, file.stamp_ns] == [START_NS + 2 * 10**9, START_NS + 10**9]
    first, *others = (frame for told in bag.values("/tf") for frame in told)
    assert [frame.stamp_ns - START_NS for frame in others] == [10**7, 10**9, 2 * 10**9]
    flange = base_from_flange(make_state(0).tcp_pose, tool)
    np.testing.assert_allclose(first.position_m, [row[3] for row in flange[:3]])
    assert len(others) == 3, "at 0 and 10 ms, and of two views"


@pytest.mark.parametrize("encoded", [None, encode_png(make_image(0))])
def test_a_colour_mosaic_leaves_in_colours(tmp_path: Path, encoded: bytes | None) -> None:
    """Nothing in a folder could say that it is one."""
    with RecordingWriter(tmp_path / "a.mcap", make_info()) as writer:
        writer.image(msgspec.structs.replace(make_picture(0), pixel_format="BayerGR8"), encoded)
        writer.view(make_view(0))
        recording = open_recording(writer.finish())
    folder = export_recording(recording, tmp_path / "out", "folder")
    shown = cv2.imread(str(folder / "images/000.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(shown, cv2.cvtColor(make_image(0), cv2.COLOR_BayerGRBG2BGR))
