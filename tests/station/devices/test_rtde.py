"""The RTDE codec against packets as they were seen on the wire, and as properties."""

from __future__ import annotations

import struct

from hypothesis import given
from hypothesis import strategies as st

from station.devices.rtde import (
    DATA_TYPES,
    PacketReader,
    PacketType,
    Recipe,
    join_names,
    packet,
    split_names,
)
from tests.codes import raises

MOVE = Recipe(
    1,
    ("input_int_register_0", *(f"input_double_register_{i}" for i in range(8)), "input_int_register_1"),
    ("INT32", *("DOUBLE",) * 8, "INT32"),
)


def test_a_joint_move_is_76_bytes() -> None:
    data = MOVE.pack([1, 0.0, -1.0, 1.5, 0.0, 0.0, 0.25, 1.05, 1.4, 1])
    assert len(data) == 76
    assert data[:8] == bytes.fromhex("004C5501") + struct.pack(">i", 1)
    assert data[8:16] == struct.pack(">d", 0.0)
    assert data[-12:] == struct.pack(">di", 1.4, 1)


def test_clear_is_8_bytes() -> None:
    assert Recipe(4, ("input_int_register_0",), ("INT32",)).pack([0]) == bytes.fromhex("0008550400000000")


def test_stop_joint_is_20_bytes() -> None:
    stop = Recipe(
        19, ("input_int_register_0", "input_double_register_0", "input_int_register_1"),
        ("INT32", "DOUBLE", "INT32"),
    )  # fmt: skip
    assert stop.pack([34, 2.0, 0]) == bytes.fromhex("00145513") + struct.pack(">idi", 34, 2.0, 0)


def test_speed_slider_is_20_bytes() -> None:
    slider = Recipe(
        4, ("input_int_register_23", "speed_slider_mask", "speed_slider_fraction"),
        ("INT32", "UINT32", "DOUBLE"),
    )  # fmt: skip
    assert slider.pack([22, 1, 0.5]) == bytes.fromhex("00145504") + struct.pack(">iId", 22, 1, 0.5)


def test_controller_version_request_is_a_bare_header() -> None:
    assert packet(PacketType.CONTROLLER_VERSION) == bytes.fromhex("000376")


@given(
    packets=st.lists(st.tuples(st.sampled_from(list(PacketType)), st.binary(max_size=300)), max_size=12),
    cuts=st.lists(st.integers(1, 200), max_size=40),
)
def test_packets_survive_any_segmentation(packets: list[tuple[PacketType, bytes]], cuts: list[int]) -> None:
    stream = b"".join(packet(kind, payload) for kind, payload in packets)
    reader, seen = PacketReader(), []
    for cut in [*cuts, len(stream)]:
        seen += reader.feed(stream[:cut])
        stream = stream[cut:]
    assert seen == packets


def test_an_impossible_size_is_refused() -> None:
    with raises("rtde"):
        PacketReader().feed(b"\x00\x02U")


@given(types=st.lists(st.sampled_from(sorted(DATA_TYPES)), min_size=1, max_size=12), data=st.data())
def test_recipes_round_trip(types: list[str], data: st.DataObject) -> None:
    strategies = {
        "?": st.booleans(), "B": st.integers(0, 255),
        "I": st.integers(0, 2**32 - 1), "Q": st.integers(0, 2**64 - 1),
        "i": st.integers(-(2**31), 2**31 - 1), "d": st.floats(allow_nan=False),
    }  # fmt: skip
    kinds = [DATA_TYPES[name] for name in types]
    elements = [data.draw(strategies[kind.code]) for kind in kinds for _ in range(kind.count)]
    recipe = Recipe(1, tuple(f"v{i}" for i in range(len(types))), tuple(types))
    assert recipe.unpack_elements(recipe.pack(elements)[3:]) == tuple(elements)


def test_a_packet_of_the_wrong_length_is_refused() -> None:
    with raises("rtde-size"):
        MOVE.unpack_elements(b"\x01\x00")


def test_a_refused_variable_is_named() -> None:
    with raises("rtde-variables"):
        Recipe(1, ("timestamp", "nonsense"), ("DOUBLE", "NOT_FOUND"))


def test_a_trailing_comma_is_no_name() -> None:
    assert split_names(b"timestamp,actual_q,") == ("timestamp", "actual_q")
    assert join_names(["timestamp", "actual_q"]) == b"timestamp,actual_q"
