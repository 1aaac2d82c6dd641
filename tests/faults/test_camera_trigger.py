"""Faults 20 to 22: a trigger box that wraps, restarts, vanishes, is another device or talks garbage."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator, Iterator

import pytest

from station.cell.config import TriggerConfig
from station.devices import serial_trigger
from station.devices.serial_trigger import SerialTrigger
from station.simulation.trigger import SimulatedTriggerBox
from tests.codes import raises


@pytest.fixture
def box() -> Iterator[SimulatedTriggerBox]:
    with SimulatedTriggerBox() as simulated:
        yield simulated


@pytest.fixture
async def trigger(box: SimulatedTriggerBox, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[SerialTrigger]:
    monkeypatch.setattr(serial_trigger, "HANDSHAKE_TIMEOUT_S", 0.2)
    monkeypatch.setattr(SerialTrigger._ask, "__defaults__", (0.2,))
    device = SerialTrigger(TriggerConfig(port=box.port))
    yield device
    await device.close()


async def test_20_the_count_wraps_without_a_gap(box: SimulatedTriggerBox, trigger: SerialTrigger) -> None:
    box.count = 2**32 - 2
    await trigger.open()
    counts = [(await trigger.fire()).count for _ in range(4)]
    assert counts == list(range(2**32 - 1, 2**32 + 3)) and box.count == 2


async def test_20_a_restarted_box_is_a_fault_not_a_negative_gap(
    box: SimulatedTriggerBox, trigger: SerialTrigger
) -> None:
    await trigger.open()
    await trigger.fire()
    box.reset()
    with raises("trigger-restarted"):
        await trigger.fire()
    assert box.count == 1, "that pulse was fired, and its picture belongs to no known pulse"
    assert (await trigger.fire()).count == 2, "after a person looked, its own count since the restart"


async def test_21_unplugged_says_lost_within_a_second(
    box: SimulatedTriggerBox, trigger: SerialTrigger
) -> None:
    await trigger.open()
    box.unplug()
    with raises("trigger-lost"):
        await trigger.fire()
    with raises("trigger-port"):
        await trigger.fire()


async def test_21_another_device_on_the_port_is_refused(
    box: SimulatedTriggerBox, trigger: SerialTrigger
) -> None:
    box.product = "coffee-machine"
    with raises("no-trigger-box"):
        await trigger.open()


async def test_21_a_silent_device_is_refused_in_time(
    box: SimulatedTriggerBox, trigger: SerialTrigger
) -> None:
    box.silent = True
    with raises("no-trigger-box"):
        await trigger.open()


async def test_21_a_box_that_falls_silent_is_lost(box: SimulatedTriggerBox, trigger: SerialTrigger) -> None:
    await trigger.open()
    box.silent = True
    with raises("trigger-lost"):
        await trigger.fire()


async def test_22_garbage_before_every_answer_is_skipped_and_counted(
    box: SimulatedTriggerBox, trigger: SerialTrigger
) -> None:
    box.garbage = b"\xff\x00\xfe*ZZ\nFIRED 1 2 3*00\n"
    await trigger.open()
    assert [(await trigger.fire()).count for _ in range(3)] == [1, 2, 3]
    assert trigger.bad_lines >= 6


async def test_22_a_half_line_does_not_hide_the_next_answer(
    box: SimulatedTriggerBox, trigger: SerialTrigger
) -> None:
    await trigger.open()
    box.cut_answers = 1
    assert (await trigger.fire()).count == 1
    assert (await trigger.fire()).count == 2


async def test_22_too_much_garbage_is_a_fault(box: SimulatedTriggerBox, trigger: SerialTrigger) -> None:
    await trigger.open()
    box.garbage = b"".join(os.urandom(20).replace(b"\n", b"") + b"\n" for _ in range(60))
    with raises("garbled-lines"):
        await trigger.fire()
