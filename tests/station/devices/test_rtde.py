"""The RTDE codec against packets as they were seen on the wire, and as properties."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from station.devices.rtde import DATA_TYPES, PacketReader, PacketType, Recipe, packet
from tests.codes import raises

MOVE = Recipe(
    1,
    ("input_int_register_0", *(f"input_double_register_{i}" for i in range(8)), "input_int_register_1"),
    ("INT32", *("DOUBLE",) * 8, "INT32"),
)


SLIDER = Recipe(
    4,
    ("input_int_register_23", "speed_slider_mask", "speed_slider_fraction"),
    ("INT32", "UINT32", "DOUBLE"),
)


@pytest.mark.parametrize(
    ("sent", "seen"),
    [
        (
            MOVE.pack([1, 0.0, -1.0, 1.5, 0.0, 0.0, 0.25, 1.05, 1.4, 1]),
            "004C5501" + struct.pack(">i8di", 1, 0.0, -1.0, 1.5, 0.0, 0.0, 0.25, 1.05, 1.4, 1).hex(),
        ),
        (SLIDER.pack([22, 1, 0.5]), "00145504" + struct.pack(">iId", 22, 1, 0.5).hex()),
        (packet(PacketType.CONTROLLER_VERSION), "000376"),
    ],
)
def test_packets_are_as_seen_on_the_wire(sent: bytes, seen: str) -> None:
    assert sent == bytes.fromhex(seen)


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
    elements = [data.draw(strategies[code]) for name in types for code in DATA_TYPES[name]]
    recipe = Recipe(1, tuple(f"v{i}" for i in range(len(types))), tuple(types))
    assert recipe.unpack_elements(recipe.pack(elements)[3:]) == tuple(elements)


def test_a_packet_of_the_wrong_length_is_refused() -> None:
    with raises("rtde-size"):
        MOVE.unpack_elements(b"\x01\x00")


def test_a_refused_variable_is_named() -> None:
    with raises("rtde-variables"):
        Recipe(1, ("timestamp", "nonsense"), ("DOUBLE", "NOT_FOUND"))
