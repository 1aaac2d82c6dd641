"""Faults 17 to 19: missing, dropped and surplus frames never shift a picture to another pose."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from station.cell.errors import CameraError
from station.devices.frame_ids import LAST_BLOCK_ID, FrameIds, frames_between
from station.devices.frames import FrameCounter
from station.simulation.camera import RenderedCamera
from tests.codes import raises


@pytest.mark.process
@pytest.mark.parametrize("fault", ["missed-trigger", "lost-frame"])
async def test_17_18_a_trigger_without_a_frame_costs_one_pose_and_no_more(
    camera: RenderedCamera, fault: str
) -> None:
    await camera.capture()
    await camera.inject(fault)
    with raises("no-image", limit_s=0.5):
        await camera.capture(timeout_s=0.5)
    again = await camera.capture()
    assert again.sequence == 1 and camera.counter.missing == 1


@pytest.mark.process
async def test_19_a_second_frame_for_one_trigger_is_never_taken_for_the_next_pose(
    camera: RenderedCamera,
) -> None:
    await camera.inject("double-frame")
    first = await camera.capture()
    with raises("surplus-frames", frames=1):
        await camera.capture()
    third = await camera.capture()
    assert first.frame_id and third.frame_id and frames_between(first.frame_id, third.frame_id) == 2


def test_18_a_gap_in_the_frame_ids_is_an_error_even_where_a_picture_came() -> None:
    counter = FrameCounter(FrameIds.BLOCK)
    counter.accept(LAST_BLOCK_ID)
    with raises("frames-lost"):
        counter.accept(3)
    assert counter.missing == 2 and counter.accept(4) == 1
    with raises("frame-twice"):
        counter.accept(4)


@given(st.integers(1, LAST_BLOCK_ID), st.lists(st.sampled_from(["good", "lost", "extra pulse"]), max_size=40))
def test_whatever_happens_only_undisturbed_pictures_are_accepted(first_id: int, events: list[str]) -> None:
    """A camera and a box that miscount at random: no accepted picture follows an unnoticed disturbance."""
    counter, frame_id, pulse = FrameCounter(FrameIds.BLOCK), first_id, 50
    counter.accept(frame_id, pulse)
    accepted = 1
    for event in events:
        frame_id, pulse = frame_id % LAST_BLOCK_ID + 1, pulse + 1
        if event == "lost":  # this trigger's frame never comes; the driver says so and goes on
            counter.lost(pulse)
            continue
        if event == "extra pulse":
            pulse += 1
            with pytest.raises(CameraError):
                counter.accept(frame_id, pulse)
            continue
        assert counter.accept(frame_id, pulse) == accepted
        accepted += 1
