"""The schema in the files: frozen numbers, older files readable, newer ones refused clearly."""

from __future__ import annotations

from contextlib import suppress

import msgspec
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from hypothesis import given
from hypothesis import strategies as st

from recordings.schema.definitions import (
    ClockReading,
    PictureFacts,
    SchemaError,
    decode,
    encode,
    message_class,
    schema_difference,
)
from recordings.schema.messages import (
    CaptureEvent,
    FrameTime,
    RobotState,
    Stamps,
    Stillness,
    View,
)
from recordings.schema.topics import Topic, schema_bytes
from tests.recordings.small_recording import make_state

FROZEN = {
    Stamps: "host_monotonic_ns host_wall_ns controller_s device_ns",
    Stillness: "window_s max_joint_speed_rad_s position_scatter_m rotation_scatter_rad image_motion_px",
    RobotState: (
        "stamps joints_rad joint_speeds_rad_s target_joints_rad tcp_pose robot_mode safety_mode "
        "safety_status_bits runtime_state robot_status_bits speed_scaling target_speed_fraction"
    ),
    PictureFacts: "stamps frame_id sequence width height exposure_us gain_db pixel_format trigger_count time",
    FrameTime: "host_monotonic_ns bound_s source",
    ClockReading: "asked_monotonic_ns answered_monotonic_ns device_ns host_wall_ns synchronized",
    View: (
        "index name picture_sequence base_from_flange joints_rad attempt stamps time_bound_s stillness "
        "source_file note camera_from_board taken_back"
    ),
    CaptureEvent: "stamps kind pose_index detail level",
}


@pytest.mark.parametrize("struct", FROZEN)
def test_field_numbers_never_change(struct: type[msgspec.Struct]) -> None:
    """A new field may follow these; moving one would give old files another meaning."""
    fields = message_class(struct).DESCRIPTOR.fields_by_number
    frozen = FROZEN[struct].split()
    assert [fields[number].name for number in range(1, len(frozen) + 1)] == frozen


numbers = st.floats(allow_nan=False)
counts = st.integers(-(2**63), 2**63 - 1)
texts = st.text(st.characters(codec="utf-8"), max_size=30)
stamps = st.builds(Stamps, counts, counts, numbers, counts)
vectors = st.tuples(*[numbers] * 6)
matrices = st.tuples(*[st.tuples(*[numbers] * 4)] * 4)
stillness = st.builds(Stillness, numbers, numbers, numbers, numbers, st.none() | numbers)
views = st.builds(
    View,
    counts,
    texts,
    counts,
    matrices,
    st.none() | vectors,
    counts,
    stamps,
    st.none() | numbers,
    st.none() | stillness,
    texts,
    texts,
)
levels = st.sampled_from(["debug", "info", "warning", "error"])


@given(st.one_of(views, st.builds(CaptureEvent, stamps, texts, st.none() | counts, texts, levels), stamps))
def test_every_message_survives_the_file(message: msgspec.Struct) -> None:
    assert decode(type(message), encode(message)) == message


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_a_schema_error(data: bytes) -> None:
    with suppress(SchemaError):
        assert isinstance(decode(View, data), View)


def test_a_vector_of_the_wrong_length_is_refused() -> None:
    message = message_class(RobotState).FromString(encode(make_state(0)))
    message.tcp_pose.append(1.0)
    with pytest.raises(SchemaError):
        decode(RobotState, message.SerializeToString())


def edited(change: str) -> bytes:
    files = FileDescriptorSet.FromString(schema_bytes(Topic.VIEW))
    message = next(m for f in files.file for m in f.message_type if m.name == "View")
    if change == "newer":
        message.field.add(name="colour", number=99, type=1, label=1)
    elif change == "older":
        del message.field[-1]
    elif change == "renamed":
        message.field[0].name = "number"
    else:
        message.field[0].type = 1
    return files.SerializeToString()


@pytest.mark.parametrize("change", ["older", "newer", "renamed", "retyped"])
def test_other_versions_are_told_apart(change: str) -> None:
    """An older one, which lacks fields at the end, is read."""
    assert bool(schema_difference(schema_bytes(Topic.VIEW), edited(change))) == (change != "older")
