"""The trigger box on a pty: its answers, and what the operator reads when it misbehaves."""

from __future__ import annotations

import os
import time
from collections.abc import AsyncIterator, Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from station.cell.config import TriggerConfig
from station.devices import serial_trigger
from station.devices.serial_trigger import LINE_LIMIT, LineReader, SerialTrigger, checksum, frame
from station.simulation.trigger import SimulatedTriggerBox
from tests.codes import raises


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_trigger, "HANDSHAKE_TIMEOUT_S", 0.3)
    monkeypatch.setattr(serial_trigger.SerialTrigger._ask, "__defaults__", (0.3,))


@pytest.fixture
def box() -> Iterator[SimulatedTriggerBox]:
    with SimulatedTriggerBox() as simulated:
        yield simulated


@pytest.fixture
async def trigger(box: SimulatedTriggerBox) -> AsyncIterator[SerialTrigger]:
    device = SerialTrigger(TriggerConfig(port=box.port))
    await device.open()
    yield device
    await device.close()


async def test_a_pulse_has_a_count_and_both_times(box: SimulatedTriggerBox, trigger: SerialTrigger) -> None:
    pulses = []
    box.on_pulse = lambda: pulses.append(time.monotonic_ns())
    first, second = await trigger.fire(), await trigger.fire()
    assert (first.count, second.count) == (1, 2) and len(pulses) == 2
    assert abs(first.host_monotonic_ns - pulses[0]) < 50_000_000


async def test_the_box_says_who_it_is(trigger: SerialTrigger) -> None:
    assert await trigger.open() == "calibration-trigger SIM1"


@pytest.mark.parametrize(("level", "permille"), [(0.4, 400), (7.0, 1000), (0.0, 0)])
async def test_the_configured_light_is_on_from_the_start(
    box: SimulatedTriggerBox, level: float, permille: int
) -> None:
    device = SerialTrigger(TriggerConfig(port=box.port, light_level=level))
    await device.open()
    assert box.light_permille == permille
    await device.close()


async def test_a_missing_port_names_port_and_remedy() -> None:
    with raises("trigger-port"):
        await SerialTrigger(TriggerConfig(port="/dev/no-such-box")).open()


async def test_a_closed_box_is_refused_and_can_be_opened_again(trigger: SerialTrigger) -> None:
    await trigger.close()
    with raises("trigger-not-open"):
        await trigger.fire()
    await trigger.open()
    assert (await trigger.fire()).count == 1


async def test_the_port_is_ours_alone(box: SimulatedTriggerBox, trigger: SerialTrigger) -> None:
    with raises("trigger-port"):
        await SerialTrigger(TriggerConfig(port=box.port)).open()


async def test_an_answer_cut_short_is_settled_by_the_boxs_own_count(
    box: SimulatedTriggerBox, trigger: SerialTrigger
) -> None:
    await trigger.fire()
    box.cut_answers = 1
    assert (await trigger.fire()).count == 2, "it did fire: the status says so"
    assert (await trigger.fire()).count == 3


async def test_a_pulse_width_the_box_cannot_do_is_refused(box: SimulatedTriggerBox) -> None:
    device = SerialTrigger(TriggerConfig(port=box.port, pulse_us=5))
    await device.open()
    with raises("trigger-refused"):
        await device.fire()
    await device.close()


def test_checksum_of_a_known_sentence() -> None:
    assert checksum("GPGLL,5300.97914,N,00259.98174,E,125926,A") == "28"  # NMEA 0183's usual example


@given(st.lists(st.binary(max_size=300), max_size=8), st.integers(1, 7))
def test_no_garbage_hides_the_good_lines_after_it(garbage: list[bytes], step: int) -> None:
    reader = LineReader()
    stream = b"".join(garbage) + b"\n" + frame("FIRED 1 2 3") + frame("ID x 1 y")
    lines: list[str] = []
    for i in range(0, len(stream), step):
        lines += reader.feed(stream[i : i + step])
    assert lines[-2:] == ["FIRED 1 2 3", "ID x 1 y"]
    assert len(reader._pending) <= LINE_LIMIT + 1


@given(st.text(st.characters(codec="ascii", exclude_characters="\r\n*"), min_size=1, max_size=60), st.data())
def test_a_changed_byte_is_noticed(text: str, data: st.DataObject) -> None:
    line = bytearray(frame(text))
    place = data.draw(st.integers(0, len(line) - 2))
    line[place] ^= 1 << data.draw(st.integers(0, 6))
    assert LineReader().feed(bytes(line)) == []


def test_a_space_is_under_the_checksum_as_all_else() -> None:
    assert LineReader().feed(b" 00*00\n") == []
    assert LineReader().feed(b" 00*20\r\n") == [" 00"]


def test_an_endless_line_takes_no_memory() -> None:
    reader = LineReader()
    for _ in range(1000):
        assert reader.feed(os.urandom(1000).replace(b"\n", b"")) == []
    assert len(reader._pending) <= LINE_LIMIT + 1
    assert reader.feed(b"\n" + frame("OK")) == ["OK"] and reader.bad_lines == 1
