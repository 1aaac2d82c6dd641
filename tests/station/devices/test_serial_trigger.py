"""The trigger box on a pty: its answers, and faults 20 to 22, what is said when it misbehaves."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from station.cell.config import TriggerConfig
from station.devices import serial_trigger
from station.devices.serial_trigger import SerialTrigger, checksum, frame, unframe
from tests.codes import raises
from tests.trigger_box import SimulatedTriggerBox


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_trigger, "HANDSHAKE_TIMEOUT_S", 0.2)
    monkeypatch.setattr(serial_trigger.SerialTrigger._ask, "__defaults__", (0.3,))


@pytest.fixture
def box() -> Iterator[SimulatedTriggerBox]:
    with SimulatedTriggerBox() as simulated:
        yield simulated


@pytest.fixture
async def trigger(box: SimulatedTriggerBox) -> AsyncIterator[SerialTrigger]:
    device = SerialTrigger(TriggerConfig(port=box.port))
    assert await device.open() == "calibration-trigger SIM1"
    yield device
    await device.close()


async def test_a_pulse_has_a_count_and_both_times(box: SimulatedTriggerBox, trigger: SerialTrigger) -> None:
    pulses = []
    box.on_pulse = lambda: pulses.append(time.monotonic_ns())
    first, second = await trigger.fire(), await trigger.fire()
    assert (first.count, second.count) == (1, 2) and len(pulses) == 2
    assert abs(first.host_monotonic_ns - pulses[0]) < 50_000_000


async def test_a_closed_box_is_refused_and_can_be_opened_again(trigger: SerialTrigger) -> None:
    await trigger.close()
    with raises("trigger-not-open"):
        await trigger.fire()
    await trigger.open()
    assert (await trigger.fire()).count == 1


@pytest.mark.parametrize("held", [True, False], ids=["another program's", "no port at all"])
async def test_the_port_must_be_there_and_ours_alone(trigger: SerialTrigger, held: bool) -> None:
    port = trigger._config.port if held else "/dev/no-such-box"
    with raises("trigger-port"):
        await SerialTrigger(TriggerConfig(port=port)).open()


async def test_a_pulse_width_the_box_cannot_do_is_refused(box: SimulatedTriggerBox) -> None:
    device = SerialTrigger(TriggerConfig(port=box.port, pulse_us=5))
    await device.open()
    with raises("trigger-refused", reason="FIRE 5"):
        await device.fire()
    await device.close()


async def test_20_the_count_wraps_without_a_gap(box: SimulatedTriggerBox, trigger: SerialTrigger) -> None:
    box.count = 2**32 - 2
    await trigger.open()
    counts = [(await trigger.fire()).count for _ in range(4)]
    assert counts == list(range(2**32 - 1, 2**32 + 3)) and box.count == 2


async def test_20_a_restarted_box_is_a_fault_not_a_negative_gap(
    box: SimulatedTriggerBox, trigger: SerialTrigger
) -> None:
    await trigger.fire()
    box.reset()
    with raises("trigger-restarted"):
        await trigger.fire()
    assert box.count == 1, "that pulse was fired, and its picture belongs to no known pulse"
    assert (await trigger.fire()).count == 2, "after a person looked, its own count since the restart"


async def test_21_unplugged_says_lost(box: SimulatedTriggerBox, trigger: SerialTrigger) -> None:
    box.unplug()
    with raises("trigger-lost"):
        await trigger.fire()
    with raises("trigger-port"):
        await trigger.fire()


@pytest.mark.parametrize("fault", [{"product": "coffee-machine"}, {"silent": True}])
async def test_21_another_or_a_silent_device_on_the_port_is_refused(
    box: SimulatedTriggerBox, fault: dict[str, Any]
) -> None:
    vars(box).update(fault)
    with raises("no-trigger-box"):
        await SerialTrigger(TriggerConfig(port=box.port)).open()


async def test_21_a_box_that_falls_silent_is_lost(box: SimulatedTriggerBox, trigger: SerialTrigger) -> None:
    box.silent = True
    with raises("trigger-lost"):
        await trigger.fire()


@pytest.mark.parametrize("garbage", [b"\xff\x00\xfe*ZZ\nFIRED 1 2 3*00\n", b"x" * 500 + b"\n", b"\n\n"])
async def test_22_garbage_before_every_answer_costs_no_pulse(
    box: SimulatedTriggerBox, trigger: SerialTrigger, garbage: bytes
) -> None:
    box.garbage = garbage
    assert [(await trigger.fire()).count for _ in range(3)] == [1, 2, 3]


async def test_22_an_answer_cut_short_is_settled_by_the_boxs_own_count(
    box: SimulatedTriggerBox, trigger: SerialTrigger
) -> None:
    await trigger.fire()
    box.cut_answers = 1
    assert (await trigger.fire()).count == 2, "it did fire: the status says so"
    assert (await trigger.fire()).count == 3


def test_checksum_of_a_known_sentence() -> None:
    assert checksum("GPGLL,5300.97914,N,00259.98174,E,125926,A") == "28"  # NMEA 0183's usual example


@given(st.text(st.characters(codec="ascii", exclude_characters="\r\n*"), min_size=1, max_size=60), st.data())
def test_a_line_is_read_as_sent_and_a_changed_byte_is_noticed(text: str, data: st.DataObject) -> None:
    line = bytearray(frame(text))
    assert unframe(bytes(line)) == text == unframe(bytes(line[:-1]) + b"\r\n")
    line[data.draw(st.integers(0, len(line) - 2))] ^= 1 << data.draw(st.integers(0, 6))
    assert unframe(bytes(line)) is None
